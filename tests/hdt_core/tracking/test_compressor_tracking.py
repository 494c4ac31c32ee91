"""Compressor health: known losses recovered, renewals and gaps survived."""

from datetime import timedelta

import numpy as np
import polars as pl
from seen import NO_LOG, seen_flights

from hdt_core.tracking.compressor_tracking import compressor_parameters
from hdt_core.tracking.sensor_shifts import corrections

N = 150


def machine_flights(model, loss: np.ndarray, *, level: float = 0.0, seed: int = 0) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    efficiency = model.compressor.efficiency * np.exp(level) * (1.0 - loss) * np.exp(0.005 * rng.standard_normal(N))
    diameter = 0.16 * np.sqrt(1.0 - loss) * np.exp(0.01 * rng.standard_normal(N))
    return seen_flights(model, np.zeros(N)).with_columns(
        efficiency=pl.Series(efficiency),
        diameter_m=pl.Series(diameter),
        expected_diameter_m=pl.lit(0.16),
        cc_n_samples=pl.lit(8, pl.Int32),
    )


def parameter(rows: pl.DataFrame, name: str) -> pl.DataFrame:
    return rows.filter(pl.col("parameter") == name).sort("departed_at")


def test_efficiency_loss_is_followed_whatever_the_machine_was_built_like(model):
    loss = np.linspace(0.0, 0.12, N)
    for level in (-0.01, 0.01):
        flights = machine_flights(model, loss, level=level)
        found = parameter(compressor_parameters(flights, NO_LOG, model), "cc_efficiency_loss")
        off = found["value"].to_numpy() - loss
        assert np.abs(off[20:]).mean() < 0.015
        assert np.mean(np.abs(off) < 1.645 * found["sd"].to_numpy()) > 0.8


def test_a_replaced_machine_starts_again(model):
    flights = machine_flights(model, np.r_[np.linspace(0.0, 0.12, 100), np.zeros(N - 100)])
    row = flights.row(99, named=True)
    told = {"component": "CC", "action": "REPLACED", "done_on": row["departed_at"].date()}
    log = pl.DataFrame([{c: row[c] for c in ("operator", "tail", "pack")} | told], schema=NO_LOG.schema)
    found = parameter(compressor_parameters(flights, log, model), "cc_efficiency_loss")["value"].to_numpy()
    assert found[95] > 0.08
    assert np.abs(found[105:]).max() < 0.03


def test_an_exchangers_replacement_is_no_compressors(model):
    flights = machine_flights(model, np.full(N, 0.1))
    row = flights.row(99, named=True)
    told = {"component": "HX", "action": "REPLACED", "done_on": row["departed_at"].date()}
    log = pl.DataFrame([{c: row[c] for c in ("operator", "tail", "pack")} | told], schema=NO_LOG.schema)
    with_log, without = (compressor_parameters(flights, entries, model) for entries in (log, NO_LOG))
    assert with_log.equals(without)


def test_exit_temperature_not_recorded(model):
    flights = machine_flights(model, np.zeros(N)).with_columns(efficiency=pl.lit(None, pl.Float64))
    found = parameter(compressor_parameters(flights, NO_LOG, model), "cc_efficiency_loss")
    assert found["status"].unique().to_list() == ["not_recorded"]
    assert found["value"].null_count() == found["sd"].null_count() == N


def test_diameter_is_the_flights_own_and_more_samples_are_surer(model):
    few = machine_flights(model, np.zeros(N)).with_columns(cc_n_samples=pl.lit(1, pl.Int32))
    many = few.with_columns(cc_n_samples=pl.lit(30, pl.Int32))
    a, b = (parameter(compressor_parameters(f, NO_LOG, model), "cc_effective_diameter_m") for f in (few, many))
    assert a["value"].equals(few["diameter_m"].rename("value"))
    assert (a["sd"] > b["sd"]).all()


def test_a_sensor_that_steps_with_its_witness_is_taken_out(model):
    seen = seen_flights(model, np.full(80, 0.05))
    step = (pl.int_range(pl.len()) >= 40).cast(pl.Float64)
    rng = np.random.default_rng(5)
    faulty = seen.with_columns(
        exit_apart_k=pl.Series(0.2 * rng.standard_normal(80)) + 4.0 * step,
        ratio_per_exit_k=pl.lit(-0.03),
        ln_ua_ratio=pl.col("ln_ua_ratio") - 0.12 * step,
    )
    found = corrections(faulty)
    assert not found.fault[:40].any()
    assert found.fault[42:].all()
    np.testing.assert_allclose(found.shift[50:], -0.12, atol=0.03)
    # the same step of the conductance, and no witness that departs: nobody may call it a sensor
    alone = faulty.with_columns(exit_apart_k=pl.lit(0.0))
    assert not corrections(alone).fault.any()


def test_corrections_use_the_past_only(model):
    seen = seen_flights(model, np.full(60, 0.05))
    step = (pl.int_range(pl.len()) >= 30).cast(pl.Float64)
    faulty = seen.with_columns(
        exit_apart_k=4.0 * step, ratio_per_exit_k=pl.lit(-0.03), ln_ua_ratio=pl.col("ln_ua_ratio") - 0.12 * step
    )
    cut = faulty["departed_at"].min() + timedelta(days=45)
    whole, part = corrections(faulty), corrections(faulty.filter(pl.col("departed_at") < cut))
    np.testing.assert_array_equal(whole.shift[:45], part.shift)
