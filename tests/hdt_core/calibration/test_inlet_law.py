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
    flown = cruise_samples(fleet_with_truth(1, 14, seed=3).samples).sort("pack", "flight_id", "time_utc")
    rng = np.random.default_rng(1)
    return flown.with_columns(cc_out_k=pl.Series(440.0 + 12.0 * rng.standard_normal(flown.height)),
                              ram_door_open=pl.Series(rng.uniform(0.1, 0.9, flown.height)))  # fmt: skip


def terms(rows: pl.DataFrame, discharge_k, *, ram_out_k=None, door=None) -> np.ndarray:
    """Discharge, ram outlet, ln of both flows, and the two streams' difference times each."""
    s = hx.without_bias({n: rows[n].to_numpy().astype(float) for n in hx.SIGNALS}, np.tile(BIAS, rows.height))
    ram = clean_ram_flow_kg_s(s if door is None else s | {"ram_door_open": np.full(rows.height, door)}, DSM.design)
    if ram_out_k is None:
        ram_out_k = s["tat_k"] + s["pack_flow_kg_s"] / ram * (s["hx_in_k"] - s["hx_out_k"])
    ln_ram, ln_flow, apart = np.log(ram), np.log(s["pack_flow_kg_s"]), discharge_k - ram_out_k
    return np.stack([discharge_k, ram_out_k, ln_ram, ln_flow, apart * ln_ram, apart * ln_flow], axis=1)


def test_inlet_excess_is_median_residual(cruise):
    bias = np.tile(BIAS, cruise.height)
    above_law = inlet_above_law(cruise, SLOPES, DSM.design, bias).sort("pack", "flight_id")
    above = cruise["hx_in_k"].to_numpy() - terms(cruise, cruise["cc_out_k"].to_numpy()) @ SLOPES
    rows = cruise.with_columns(a=pl.Series(above))
    want = rows.group_by("pack", "flight_id", maintain_order=True).agg(pl.col("a").median())
    np.testing.assert_allclose(above_law["inlet_apart_k"], want["a"])
    stuck = cruise.with_columns(ram_door_open=pl.lit(0.96))
    assert inlet_above_law(stuck, SLOPES, DSM.design, bias).is_empty()


def test_pressure_ratio_replaces_discharge_temperature(cruise):
    """At an efficiency of 0.75, for flights that have none at all."""
    bias, one = np.tile(BIAS, cruise.height), cruise["flight_id"] == cruise["flight_id"][0]
    silent = cruise.with_columns(pl.when(~one).then("cc_out_k").alias("cc_out_k"))
    ratio = (silent["cc_out_pa"] / silent["cc_in_pa"]).to_numpy()
    by_ratio = silent["tat_k"].to_numpy() * (1.0 + (ratio ** (0.4 / 1.4) - 1.0) / 0.75)
    discharge = np.where(one, by_ratio, cruise["cc_out_k"])
    above = cruise["hx_in_k"].to_numpy() - terms(cruise, discharge) @ SLOPES
    above_law = inlet_above_law(silent, SLOPES, DSM.design, bias).sort("pack", "flight_id")["inlet_apart_k"]
    assert above_law[0] == pytest.approx(np.median(above[(one & (cruise["pack"] == 1)).to_numpy()]), rel=2e-3)


def test_slopes_are_huber_about_medians(cruise):
    """A weak ridge of 1e-4; a twentieth of the samples is far off and pulls as if it were 1.345 deviations."""
    bias, rng = np.tile(BIAS, cruise.height), np.random.default_rng(2)
    x = terms(cruise, cruise["cc_out_k"].to_numpy())
    pack = cruise["pack"].to_numpy()
    y = x @ SLOPES + 30.0 * pack + 0.5 * rng.standard_normal(len(x)) + np.where(rng.random(len(x)) < 0.05, 20.0, 0.0)
    # the law's own ram outlet follows from the inlet, so the terms are made anew
    rows = cruise.with_columns(hx_in_k=pl.Series(y.copy()))
    x = terms(rows, cruise["cc_out_k"].to_numpy())
    for side in (1, 2):
        own = pack == side
        x[own], y[own] = x[own] - np.median(x[own], axis=0), y[own] - np.median(y[own])
    unit, weight = x / x.std(axis=0), np.ones(len(y))
    for _ in range(8):
        slopes = np.linalg.solve(unit.T * weight @ unit + 1e-4 * len(y) * np.eye(6), unit.T @ (weight * y))
        miss = np.abs(y - unit @ slopes)
        weight = np.minimum(1.0, 1.345 * 1.4826 * np.median(miss) / miss)
    learned = learn_inlet(rows, DSM.design, bias)
    np.testing.assert_allclose(learned, slopes / x.std(axis=0), rtol=1e-6)
    assert learn_inlet(rows.head(200), DSM.design, bias[:, :200]) != ()
    assert learn_inlet(rows.head(199), DSM.design, bias[:, :199]) == ()


def test_open_door_cools_inlet(cruise):
    """Linear in the ram outlet, which is linear in the inlet: solved for the inlet by iteration."""
    rows = cruise.head(6)
    bias, discharge = np.tile(BIAS, rows.height), rows["cc_out_k"].to_numpy()
    s = hx.without_bias({n: rows[n].to_numpy().astype(float) for n in hx.SIGNALS}, bias)
    exit_k = np.full(6, 296.0)
    full_ram = clean_ram_flow_kg_s(s | {"ram_door_open": np.ones(6)}, DSM.design)
    own = rows["hx_in_k"].to_numpy() - 0.5 - terms(rows, discharge) @ SLOPES
    share = SLOPES[1] - SLOPES[4] * np.log(full_ram) - SLOPES[5] * np.log(s["pack_flow_kg_s"])
    assert (share < 0.8).all() and (share > 0.0).all()  # noqa: PT018
    inlet = np.full(6, 400.0)
    for _ in range(200):
        ram_out = s["tat_k"] + s["pack_flow_kg_s"] / full_ram * (inlet - exit_k)
        inlet = own + terms(rows, discharge, ram_out_k=ram_out, door=1.0) @ SLOPES
    result = full_open_inlet_k(rows, SLOPES, DSM.design, bias, exit_k)
    np.testing.assert_allclose(result, inlet + 0.5, rtol=1e-9)
    # no exchanger gives up more than 0.8 of its heat, and none takes any in
    steep = (0.6, 1.5, 4.0, -6.0, 0.0, 0.0)
    capped = full_open_inlet_k(rows, steep, DSM.design, bias, exit_k)
    rising = (0.6, -0.5, 4.0, -6.0, 0.0, 0.0)
    own = rows["hx_in_k"].to_numpy() - 0.5 - terms(rows, discharge) @ rising
    at_tat = own + terms(rows, discharge, ram_out_k=s["tat_k"], door=1.0) @ rising
    np.testing.assert_allclose(full_open_inlet_k(rows, rising, DSM.design, bias, exit_k) - 0.5, at_tat)
    own = rows["hx_in_k"].to_numpy() - 0.5 - terms(rows, discharge) @ steep
    at_tat = own + terms(rows, discharge, ram_out_k=s["tat_k"], door=1.0) @ steep
    np.testing.assert_allclose(capped - 0.5 - exit_k, (at_tat - exit_k) / (1.0 - 0.8 * s["pack_flow_kg_s"] / full_ram))


EFFECTIVENESS = 0.4


@pytest.fixture(scope="module")
def flown(fleet, model):
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
def slopes(flown, model):
    return learn_inlet(flown, model.design, model.bias_of(flown))


def test_recovers_inlet_law(flown, model, slopes):
    assert slopes[0] == pytest.approx(1.0 - EFFECTIVENESS, abs=0.1)
    assert spread(above(flown, model, slopes)) < 0.5
    silent = flown.with_columns(cc_out_k=pl.lit(None, pl.Float64))
    assert above(silent, model, slopes)["inlet_apart_k"].is_not_null().all()
    bias = model.bias_of(flown)
    signals = hx.without_bias({n: flown[n].to_numpy().astype(float) for n in hx.SIGNALS}, bias)
    full = signals | {"ram_door_open": np.ones(flown.height)}
    truth_k = behind_first_exchanger(full, flown["cc_out_k"].to_numpy(), model)
    found_k = full_open_inlet_k(flown, slopes, model.design, bias, signals["hx_out_k"])
    found_k = found_k - bias[hx.BIASES.index("hx_in_k")]
    shut = signals["ram_door_open"] < 0.5
    assert np.median(signals["hx_in_k"][shut] - truth_k[shut]) > 8.0, "what is at stake"
    assert np.median(np.abs(found_k - truth_k)) < 2.0
    assert np.quantile(np.abs(found_k - truth_k)[shut], 0.9) < 5.0
    bias, held_k = model.bias_of(flown), flown["hx_out_k"].to_numpy()
    recorded = flown["hx_in_k"].to_numpy()
    np.testing.assert_array_equal(full_open_inlet_k(flown, (), model.design, bias, held_k), recorded)
    blind = flown.with_columns(cc_out_k=pl.lit(None, pl.Float64), cc_out_pa=pl.lit(None, pl.Float64))
    np.testing.assert_array_equal(full_open_inlet_k(blind, slopes, model.design, bias, held_k), recorded)
    assert learn_inlet(flown.head(20), model.design, model.bias_of(flown.head(20))) == ()
    assert above(flown, model, ())["inlet_apart_k"].is_null().all()


@pytest.mark.parametrize(("sensor", "error", "least"), [("hx_in_k", 4.0, 1.5), ("cc_out_k", -4.0, 1.5)])
def test_biased_sensor_leaves_law(flown, model, slopes, sensor, error, least):
    above_law = above(flown.with_columns(pl.col(sensor) + error), model, slopes)
    shift = above_law["inlet_apart_k"] - above(flown, model, slopes)["inlet_apart_k"]
    assert shift.median() > least
