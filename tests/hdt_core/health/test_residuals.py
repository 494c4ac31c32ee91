"""Residuals: three differences of three things, and what wear does to them."""

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.health.features import residual_column
from hdt_core.health.residuals import KINDS, SIGNALS, residuals
from hdt_core.health.virtual_sensors import virtual_sensors
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.tables.residuals import Residuals

KEY = ["operator", "tail", "flight_id", "pack"]
LOSS = 0.2


@pytest.fixture(scope="module")
def model(fly, nothing_done) -> Dsm:
    """A model that rests on its priors: no flight is admitted."""
    empty = fly(2).clear().with_columns(pl.lit(True).alias("monitored"))
    return calibrate(empty, pl.DataFrame(), nothing_done)


@pytest.fixture(scope="module")
def flown(fly, model) -> pl.DataFrame:
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
def twin(flown, model) -> pl.DataFrame:
    return estimate_flights(flown, model)


@pytest.fixture(scope="module")
def found(flown, twin, model) -> pl.DataFrame:
    return residuals(flown, twin, model)


def means(found: pl.DataFrame, signal: str, kind: str, pack: int) -> np.ndarray:
    rows = found.filter((pl.col("signal") == signal) & (pl.col("kind") == kind) & (pl.col("pack") == pack))
    return rows["mean"].to_numpy()


def test_honours_the_contract(found) -> None:
    assert Residuals.faults(Residuals.conform(found)) == []
    assert set(found["kind"]) == set(KINDS)
    assert set(found["signal"]) == set(SIGNALS)
    assert found["mean"].is_nan().sum() == 0


def test_the_three_add_up(found) -> None:
    wide = found.pivot("kind", index=[*KEY, "signal"], values="mean").drop_nulls()
    assert wide.height > 20
    total = wide["sensor_minus_dsm"] + wide["dsm_minus_twin"]
    scale = wide["sensor_minus_dsm"].abs() + wide["dsm_minus_twin"].abs() + 1e-9
    assert ((total - wide["sensor_minus_twin"]).abs() / scale).max() < 1e-6


def test_as_built_unit_agrees_with_model_and_twin(found) -> None:
    for kind in KINDS:
        np.testing.assert_allclose(means(found, "hx_out_k", kind, 1), 0.0, atol=1e-6)


def test_lost_conductance_shows_against_the_model_and_not_against_the_twin(found) -> None:
    assert means(found, "hx_out_k", "sensor_minus_dsm", 2).min() > 3.0
    np.testing.assert_allclose(means(found, "hx_out_k", "sensor_minus_twin", 2), 0.0, atol=0.02)
    # heat that the hot side keeps the cold side misses
    assert means(found, "ram_out_k", "sensor_minus_dsm", 2).max() < -1.0


def test_virtual_sensors_obey_the_heat_balance(flown, twin, model) -> None:
    virtual = virtual_sensors(twin)
    measured = flown.filter("monitored").group_by(KEY).agg(pl.col("ram_out_k").median())
    both = virtual.join(measured, on=KEY)
    np.testing.assert_allclose(both["ram_outlet_k"], both["ram_out_k"], atol=0.3)
    np.testing.assert_allclose(both["ram_flow_loss"], 0.0, atol=1e-3)
    worn = both.filter(pl.col("pack") == 2)["hx_fouling_flight"].to_numpy()
    sound = both.filter(pl.col("pack") == 1)["hx_fouling_flight"].to_numpy()
    np.testing.assert_allclose((1 - worn) / (1 - sound), 1 - LOSS, rtol=1e-3)
    for name in ("ram_flow_kg_s", "ram_outlet_k", "effectiveness", "ua_w_k"):
        assert (both[f"{name}_sd"] > 0).all()


def test_every_residual_has_a_feature_name() -> None:
    names = {residual_column(s, k) for s in SIGNALS for k in KINDS}
    assert len(names) == len(SIGNALS) * len(KINDS)
