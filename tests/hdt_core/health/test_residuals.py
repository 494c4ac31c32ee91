"""Residuals: three differences of three things, and what wear does to them."""

import numpy as np
import polars as pl
import pytest
from hand_pack import DSM, FLIGHT

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.compressor import compressor_samples
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.components.unmetered_exchanger import UNMETERED
from hdt_core.health.features import residual_column, virtual_sensors
from hdt_core.health.residuals import KINDS, SIGNALS, component_residuals, residuals
from hdt_core.physics.compressor import exit_temperature_k, inlet_flow_kg_s, pressure_ratio
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.tables.twin import Residuals

KEY = ["operator", "tail", "flight_id", "pack"]
LOSS = 0.2


@pytest.fixture(scope="module")
def model(fly, nothing_done) -> Dsm:
    """A model that rests on its priors: no flight is admitted."""
    empty = fly(2).clear().with_columns(pl.lit(True).alias("monitored"))
    return calibrate(empty, empty.select(*KEY, admitted=pl.lit(True)), nothing_done)


@pytest.fixture(scope="module")
def model_samples(fly, model) -> pl.DataFrame:
    """Samples that obey the model: pack 1 as built, pack 2 with a fifth of its conductance lost, no sensor errors."""
    samples = fly(6).with_columns(monitored=pl.col("phase") == "cruise", ram_door_open=pl.lit(0.4))
    signals = {n: samples[n].to_numpy().astype(float) for n in (*hx.SIGNALS, "ram_out_k")}
    clean = hx.without_bias(signals, model.bias_of(samples))
    ram = clean_ram_flow_kg_s(clean, model.design)
    left = np.where(samples["pack"].to_numpy() == 2, 1.0 - LOSS, 1.0)
    ua = left * np.exp(ln_clean_conductance(clean, ram, model.design) + model.clean_level)
    hot, cold = outlets_k(clean["pack_flow_kg_s"], ram, clean["hx_in_k"], clean["tat_k"], ua)
    return samples.with_columns(pl.Series("hx_out_k", hot), pl.Series("ram_out_k", cold))


@pytest.fixture(scope="module")
def twin(model_samples, model) -> pl.DataFrame:
    return estimate_flights(model_samples, model)


@pytest.fixture(scope="module")
def residual_rows(model_samples, twin, model) -> pl.DataFrame:
    return residuals(model_samples, twin, model)


def means(residual_rows: pl.DataFrame, signal: str, kind: str, pack: int) -> np.ndarray:
    rows = residual_rows.filter((pl.col("signal") == signal) & (pl.col("kind") == kind) & (pl.col("pack") == pack))
    return rows["mean"].to_numpy()


def test_residual_table_is_as_declared(residual_rows):
    assert Residuals.faults(Residuals.conform(residual_rows)) == []
    assert set(residual_rows["kind"]) == set(KINDS)
    assert set(residual_rows["signal"]) == set(SIGNALS)
    assert residual_rows["mean"].is_nan().sum() == 0


def test_residuals_add_up(residual_rows):
    wide = residual_rows.pivot("kind", index=[*KEY, "signal"], values="mean").drop_nulls()
    assert wide.height > 20
    total = wide["sensor_minus_dsm"] + wide["dsm_minus_twin"]
    scale = wide["sensor_minus_dsm"].abs() + wide["dsm_minus_twin"].abs() + 1e-9
    assert ((total - wide["sensor_minus_twin"]).abs() / scale).max() < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_sound_pack_has_no_residual(residual_rows, kind):
    np.testing.assert_allclose(means(residual_rows, "hx_out_k", kind, 1), 0.0, atol=1e-6)


def test_wear_leaves_model_not_twin(residual_rows):
    assert means(residual_rows, "hx_out_k", "sensor_minus_dsm", 2).min() > 3.0
    np.testing.assert_allclose(means(residual_rows, "hx_out_k", "sensor_minus_twin", 2), 0.0, atol=0.02)
    # heat that the hot side keeps the cold side misses
    assert means(residual_rows, "ram_out_k", "sensor_minus_dsm", 2).max() < -1.0


def test_virtual_sensors_obey_heat_balance(model_samples, twin):
    measured = model_samples.filter("monitored").group_by(KEY).agg(pl.col("ram_out_k").median())
    both = virtual_sensors(twin).join(measured, on=KEY)
    np.testing.assert_allclose(both["ram_outlet_k"], both["ram_out_k"], atol=0.3)
    np.testing.assert_allclose(both["ram_flow_loss"], 0.0, atol=1e-3)


def test_virtual_sensors_show_loss(twin):
    virtual = virtual_sensors(twin)
    sound, worn = (virtual.filter(pack=pack)["hx_fouling_flight"].to_numpy() for pack in (1, 2))
    np.testing.assert_allclose((1 - worn) / (1 - sound), 1 - LOSS, rtol=1e-3)


@pytest.mark.parametrize("name", ["ram_flow_kg_s", "ram_outlet_k", "effectiveness", "ua_w_k"])
def test_virtual_sensors_have_deviations(twin, name):
    assert (virtual_sensors(twin)[f"{name}_sd"] > 0).all()


def test_flight_statistics_by_hand():
    twin = FLIGHT.select(KEY).unique().with_columns(
        ln_ua_ratio=pl.lit(-0.15), diameter_m=pl.lit(0.160), expected_diameter_m=pl.lit(0.163),
        efficiency=pl.lit(0.71), group_m3=pl.lit(9.2e-4),
    )  # fmt: skip
    table = residuals(FLIGHT, twin, DSM)
    s = {name: FLIGHT[name].to_numpy() for name in FLIGHT.columns}
    # the flow reads 1 % high, the temperatures .5, -.4, .3 and .2 K, the door .01; the compressor's inlet .2 K and .2 %
    true = s | {"pack_flow_kg_s": s["pack_flow_kg_s"] * np.exp(-0.01), "hx_in_k": s["hx_in_k"] - 0.5}
    true |= {"tat_k": s["tat_k"] - 0.3, "ram_door_open": s["ram_door_open"] - 0.01}
    ram = clean_ram_flow_kg_s(true, DSM.design)
    clean = ln_clean_conductance(true, ram, DSM.design)
    air = true["pack_flow_kg_s"], ram, true["hx_in_k"], true["tat_k"]
    rows = compressor_samples(cruise_samples(FLIGHT), DSM.pack_table())
    inlet_k = s["cc_in_k"] - 0.2
    inlet_pa = s["cc_in_pa"] * np.exp(-0.002)
    built_m = 0.175 - 2.8e-5 * s["vda_counts"]
    of = inlet_k, s["cc_speed_rad_s"]
    by_model, by_twin = (outlets_k(*air, np.exp(clean + ln)) for ln in (0.05, -0.15))
    by_hand = {
        "hx_out_k": (s["hx_out_k"] + 0.4, by_model[0], by_twin[0]),
        "ram_out_k": (s["ram_out_k"] - 0.2, by_model[1], by_twin[1]),
        "cc_effective_diameter_m": (rows["diameter_m"].to_numpy(), built_m, built_m - 0.003),
        "cc_out_pa": (s["cc_out_pa"], *(inlet_pa * pressure_ratio(d, *of) for d in (built_m, built_m - 0.003))),
        "cc_out_k": (
            s["cc_out_k"], *(exit_temperature_k(inlet_k, s["cc_out_pa"] / inlet_pa, e) for e in (0.74, 0.71))
        ),
        "cc_flow_kg_s": (s["cc_flow_kg_s"], *(inlet_flow_kg_s(g, inlet_pa, *of) for g in (9.4e-4, 9.2e-4))),
    }  # fmt: skip
    for signal, (sensor, model, own) in by_hand.items():
        for kind, d in zip(KINDS, (sensor - model, model - own, sensor - own), strict=True):
            row = table.row(by_predicate=(pl.col("signal") == signal) & (pl.col("kind") == kind), named=True)
            expected = {"mean": d.mean(), "sd": d.std(ddof=1), "rms": np.sqrt((d**2).mean()), "n": 6}
            assert {name: row[name] for name in expected} == pytest.approx(expected, rel=1e-6, abs=1e-9), (signal, kind)
            assert row["component"] == ("CC" if signal.startswith("cc_") else "HX")


def test_kinds_share_measured_samples():
    """A declared component; its fourth reading is missing."""
    time = pl.datetime(2024, 1, 1, time_zone="UTC")
    key = dict(zip(KEY, (pl.lit("TST"), pl.lit("T"), pl.lit("F"), pl.lit(1, pl.Int32)), strict=True))
    air = {"hot_in_k": 400.0, "tat_k": 290.0, "total_pressure_pa": 90e3}
    flux = pl.DataFrame({"ram_flux_kg_s_m2": [90.0, 110.0, 120.0, 150.0], "hot_out_k": [320.0, 318.0, 315.0, None]})
    rows = flux.with_columns(**key, time_utc=time, **{name: pl.lit(value) for name, value in air.items()})
    table = component_residuals(rows, rows.select(KEY).unique().with_columns(hxt_loss=0.2), UNMETERED, "HXT")
    sound, own = (290.0 + 110.0 * np.exp(-left * 1.6 * np.array([0.9, 1.1, 1.2]) ** 0.27) for left in (1.0, 0.8))
    sensor = np.array([320.0, 318.0, 315.0])
    for kind, d in zip(KINDS, (sensor - sound, sound - own, sensor - own), strict=True):
        row = table.row(by_predicate=pl.col("kind") == kind, named=True)
        assert (row["component"], row["signal"], row["n"]) == ("HXT", "hot_out_k", 3)
        assert row["mean"] == pytest.approx(d.mean())


def test_every_residual_has_a_feature_name():
    names = {residual_column(s, k) for s in SIGNALS for k in KINDS}
    assert len(names) == len(SIGNALS) * len(KINDS)
