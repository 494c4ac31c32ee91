"""The hot inlet's law: recovered beside the core's film and biased sensors; its terms and slopes in numbers."""

import numpy as np
import polars as pl
import pytest
from by_hand import DSM
from known_fleet import fleet_with_truth

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.inlet_law import full_open_inlet_k, inlet_above_law, learn_inlet
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s

BIAS = np.array([[0.01], [0.5], [-0.4], [0.3], [0.005], [0.0]])
SLOPES = (0.6, 0.35, 4.0, -6.0, 0.05, -0.04)


@pytest.fixture(scope="module")
def cruise() -> pl.DataFrame:
    rows = cruise_samples(fleet_with_truth(1, 14, seed=3).samples).sort("pack", "flight_id", "time_utc")
    rng = np.random.default_rng(1)
    return rows.with_columns(cc_out_k=pl.Series(440.0 + 12.0 * rng.standard_normal(rows.height)),
                             ram_door_open=pl.Series(rng.uniform(0.1, 0.9, rows.height)))  # fmt: skip


def without_bias(rows: pl.DataFrame) -> dict[str, np.ndarray]:
    """Signals without the sensors' errors."""
    return hx.without_bias({n: rows[n].to_numpy().astype(float) for n in hx.SIGNALS}, bias_of(rows))


def bias_of(rows: pl.DataFrame) -> np.ndarray:
    return np.tile(BIAS, rows.height)


def terms(rows: pl.DataFrame, discharge_k, *, ram_out_k=None, door=None) -> np.ndarray:
    """Discharge, ram outlet, ln of both flows, and the two streams' difference times each."""
    s = without_bias(rows)
    ram = clean_ram_flow_kg_s(s if door is None else s | {"ram_door_open": np.full(rows.height, door)}, DSM.design)
    if ram_out_k is None:
        ram_out_k = s["tat_k"] + s["pack_flow_kg_s"] / ram * (s["hx_in_k"] - s["hx_out_k"])
    ln_ram = np.log(ram)
    ln_flow = np.log(s["pack_flow_kg_s"])
    apart = discharge_k - ram_out_k
    return np.stack([discharge_k, ram_out_k, ln_ram, ln_flow, apart * ln_ram, apart * ln_flow], axis=1)


def test_inlet_excess_is_median_residual(cruise):
    above_law = inlet_above_law(cruise, SLOPES, DSM.design, bias_of(cruise)).sort("pack", "flight_id")
    residual = cruise["hx_in_k"].to_numpy() - terms(cruise, cruise["cc_out_k"].to_numpy()) @ SLOPES
    rows = cruise.with_columns(a=pl.Series(residual))
    want = rows.group_by("pack", "flight_id", maintain_order=True).agg(pl.col("a").median())
    np.testing.assert_allclose(above_law["inlet_apart_k"], want["a"])


def test_open_door_gives_no_excess(cruise):
    """At its stop a door has no authority."""
    stuck = cruise.with_columns(ram_door_open=pl.lit(0.96))
    assert inlet_above_law(stuck, SLOPES, DSM.design, bias_of(cruise)).is_empty()


def test_pressure_ratio_replaces_discharge_temperature(cruise):
    """At an efficiency of 0.75, for flights that have none at all."""
    one = cruise["flight_id"] == cruise["flight_id"][0]
    silent = cruise.with_columns(pl.when(~one).then("cc_out_k").alias("cc_out_k"))
    ratio = (silent["cc_out_pa"] / silent["cc_in_pa"]).to_numpy()
    by_ratio = silent["tat_k"].to_numpy() * (1.0 + (ratio ** (0.4 / 1.4) - 1.0) / 0.75)
    discharge = np.where(one, by_ratio, cruise["cc_out_k"])
    residual = cruise["hx_in_k"].to_numpy() - terms(cruise, discharge) @ SLOPES
    above_law = inlet_above_law(silent, SLOPES, DSM.design, bias_of(cruise)).sort("pack", "flight_id")["inlet_apart_k"]
    assert above_law[0] == pytest.approx(np.median(residual[(one & (cruise["pack"] == 1)).to_numpy()]), rel=2e-3)


@pytest.fixture(scope="module")
def scattered(cruise) -> pl.DataFrame:
    """Inlets that scatter about the law and packs' own levels; a twentieth of the samples is far off."""
    rng = np.random.default_rng(2)
    y = terms(cruise, cruise["cc_out_k"].to_numpy()) @ SLOPES + 30.0 * cruise["pack"].to_numpy()
    y = y + 0.5 * rng.standard_normal(y.size) + np.where(rng.random(y.size) < 0.05, 20.0, 0.0)
    return cruise.with_columns(hx_in_k=pl.Series(y))


def test_slopes_are_huber_about_medians(scattered):
    """A weak ridge of 1e-4; what is far off pulls as if it were 1.345 deviations."""
    # the law's own ram outlet follows from the inlet, so the terms are made anew
    x = terms(scattered, scattered["cc_out_k"].to_numpy())
    y = scattered["hx_in_k"].to_numpy().copy()
    for side in (1, 2):
        own = scattered["pack"].to_numpy() == side
        x[own] -= np.median(x[own], axis=0)
        y[own] -= np.median(y[own])
    unit = x / x.std(axis=0)
    weight = np.ones(len(y))
    for _ in range(8):
        slopes = np.linalg.solve(unit.T * weight @ unit + 1e-4 * len(y) * np.eye(6), unit.T @ (weight * y))
        miss = np.abs(y - unit @ slopes)
        weight = np.minimum(1.0, 1.345 * 1.4826 * np.median(miss) / miss)
    learned = learn_inlet(scattered, DSM.design, bias_of(scattered))
    np.testing.assert_allclose(learned, slopes / x.std(axis=0), rtol=1e-6)


@pytest.mark.parametrize(("n", "n_slopes"), [(200, 6), (199, 0)])
def test_law_needs_200_samples(scattered, n, n_slopes):
    few = scattered.head(n)
    assert len(learn_inlet(few, DSM.design, bias_of(few))) == n_slopes


EXIT_K = np.full(6, 296.0)


@pytest.fixture(scope="module")
def six(cruise) -> pl.DataFrame:
    """Six samples of it."""
    return cruise.head(6)


def full_ram_of(signals: dict[str, np.ndarray]) -> np.ndarray:
    """Ram flow through an open door."""
    return clean_ram_flow_kg_s(signals | {"ram_door_open": np.ones(6)}, DSM.design)


def inlet_at(rows: pl.DataFrame, slopes: tuple, ram_out_k: np.ndarray) -> np.ndarray:
    """Inlet behind an open door whose ram outlet is so warm, without its sensor's 0.5 K."""
    discharge = rows["cc_out_k"].to_numpy()
    own = rows["hx_in_k"].to_numpy() - 0.5 - terms(rows, discharge) @ slopes
    return own + terms(rows, discharge, ram_out_k=ram_out_k, door=1.0) @ slopes


def test_open_door_cools_inlet(six):
    """Linear in the ram outlet, which is linear in the inlet: solved for the inlet by iteration."""
    s = without_bias(six)
    full_ram = full_ram_of(s)
    share = SLOPES[1] - SLOPES[4] * np.log(full_ram) - SLOPES[5] * np.log(s["pack_flow_kg_s"])
    assert (share < 0.8).all() and (share > 0.0).all()  # noqa: PT018
    inlet = np.full(6, 400.0)
    for _ in range(200):
        inlet = inlet_at(six, SLOPES, s["tat_k"] + s["pack_flow_kg_s"] / full_ram * (inlet - EXIT_K))
    result = full_open_inlet_k(six, SLOPES, DSM.design, bias_of(six), EXIT_K)
    np.testing.assert_allclose(result, inlet + 0.5, rtol=1e-9)


def test_first_exchanger_takes_no_heat(six):
    rising = (0.6, -0.5, 4.0, -6.0, 0.0, 0.0)
    result = full_open_inlet_k(six, rising, DSM.design, bias_of(six), EXIT_K)
    np.testing.assert_allclose(result - 0.5, inlet_at(six, rising, without_bias(six)["tat_k"]))


def test_first_exchanger_gives_four_fifths(six):
    """Of its heat, at most."""
    steep = (0.6, 1.5, 4.0, -6.0, 0.0, 0.0)
    s = without_bias(six)
    capped = full_open_inlet_k(six, steep, DSM.design, bias_of(six), EXIT_K)
    above_exit = inlet_at(six, steep, s["tat_k"]) - EXIT_K
    np.testing.assert_allclose(capped - 0.5 - EXIT_K, above_exit / (1.0 - 0.8 * s["pack_flow_kg_s"] / full_ram_of(s)))


EFFECTIVENESS = 0.4


@pytest.fixture(scope="module")
def fleet_cruise(fleet, model):
    """Cruise of a fleet whose hot inlet is what a first exchanger in the same ram air leaves of the discharge."""
    cruise = cruise_samples(fleet.samples).drop_nulls(list(hx.SIGNALS))
    rng = np.random.default_rng(5)
    bias = model.bias_of(cruise)
    signals = hx.without_bias({n: cruise[n].to_numpy().astype(float) for n in hx.SIGNALS}, bias)
    discharge_k = 470.0 + 0.8 * (signals["tat_k"] - 250.0) + 8.0 * rng.standard_normal(cruise.height)
    inlet_k = behind_first_exchanger(signals, discharge_k, model) + bias[hx.BIASES.index("hx_in_k")]
    noisy_k = inlet_k + 0.3 * rng.standard_normal(cruise.height)
    return cruise.with_columns(pl.Series("cc_out_k", discharge_k), pl.Series("hx_in_k", noisy_k))


def behind_first_exchanger(signals, discharge_k, model):
    """Inlet = (1 - e) discharge + e ram outlet + 40 K of the air cycle machine; the ram outlet holds the inlet."""
    share = signals["pack_flow_kg_s"] / clean_ram_flow_kg_s(signals, model.design)
    ram_less_inlet_k = signals["tat_k"] - share * signals["hx_out_k"]
    inlet_k = (1.0 - EFFECTIVENESS) * discharge_k + EFFECTIVENESS * ram_less_inlet_k + 40.0
    return inlet_k / (1.0 - EFFECTIVENESS * share)


def above(cruise, model, slopes):
    return inlet_above_law(cruise, slopes, model.design, model.bias_of(cruise)).sort("tail", "pack", "flight_id")


def spread(frame):
    value = pl.col("inlet_apart_k")
    return frame.select((value - value.median().over("tail", "pack")).abs().median()).item()


@pytest.fixture(scope="module")
def slopes(fleet_cruise, model):
    return learn_inlet(fleet_cruise, model.design, model.bias_of(fleet_cruise))


NO_READING = pl.lit(None, pl.Float64)


def test_recovers_inlet_law(fleet_cruise, model, slopes):
    assert slopes[0] == pytest.approx(1.0 - EFFECTIVENESS, abs=0.1)
    assert spread(above(fleet_cruise, model, slopes)) < 0.5


def test_law_holds_without_discharge_temperature(fleet_cruise, model, slopes):
    silent = fleet_cruise.with_columns(cc_out_k=NO_READING)
    assert above(silent, model, slopes)["inlet_apart_k"].is_not_null().all()


def test_recovers_inlet_with_open_door(fleet_cruise, model, slopes):
    bias = model.bias_of(fleet_cruise)
    signals = hx.without_bias({n: fleet_cruise[n].to_numpy().astype(float) for n in hx.SIGNALS}, bias)
    full = signals | {"ram_door_open": np.ones(fleet_cruise.height)}
    truth_k = behind_first_exchanger(full, fleet_cruise["cc_out_k"].to_numpy(), model)
    inlet_k = full_open_inlet_k(fleet_cruise, slopes, model.design, bias, signals["hx_out_k"])
    error_k = np.abs(inlet_k - bias[hx.BIASES.index("hx_in_k")] - truth_k)
    shut = signals["ram_door_open"] < 0.5
    assert np.median((signals["hx_in_k"] - truth_k)[shut]) > 8.0, "what is at stake"
    assert np.median(error_k) < 2.0
    assert np.quantile(error_k[shut], 0.9) < 5.0


def test_inlet_without_discharge_is_as_recorded(fleet_cruise, model, slopes):
    blind = fleet_cruise.with_columns(cc_out_k=NO_READING, cc_out_pa=NO_READING)
    inlet = full_open_inlet_k(
        blind, slopes, model.design, model.bias_of(fleet_cruise), fleet_cruise["hx_out_k"].to_numpy()
    )
    np.testing.assert_array_equal(inlet, fleet_cruise["hx_in_k"].to_numpy())


def test_no_law_gives_no_excess(fleet_cruise, model):
    assert above(fleet_cruise, model, ())["inlet_apart_k"].is_null().all()


@pytest.mark.parametrize(("sensor", "error", "least"), [("hx_in_k", 4.0, 1.5), ("cc_out_k", -4.0, 1.5)])
def test_biased_sensor_leaves_law(fleet_cruise, model, slopes, sensor, error, least):
    above_law = above(fleet_cruise.with_columns(pl.col(sensor) + error), model, slopes)
    shift = above_law["inlet_apart_k"] - above(fleet_cruise, model, slopes)["inlet_apart_k"]
    assert shift.median() > least
