"""Screens of single values: what is planted is found, and nothing else."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.quality import FROZEN_RISE_M, LIMITS, NOISY, SIGNALS, null_bad_values

BY = ("tail", "pack")
CRUISE = {
    "altitude_m": 11_000.0, "mach": 0.82, "tat_k": 251.0, "total_pressure_pa": 35_000.0, "hx_in_k": 405.0,
    "hx_out_k": 296.0, "ram_door_open": 0.3, "pack_flow_kg_s": 0.77, "ram_out_k": 335.0, "cc_speed_rad_s": 3_600.0,
    "cc_in_k": 252.0,
    "cc_in_pa": 33_500.0, "cc_out_k": 365.0, "cc_out_pa": 93_000.0, "cc_flow_kg_s": 0.8, "vda_counts": 400.0,
}  # fmt: skip
NOISE = {
    "pack_flow_kg_s": 0.008,
    "cc_flow_kg_s": 0.012,
    "cc_speed_rad_s": 80.0,
    "vda_counts": 40.0,
    "ram_door_open": 0.01,
}


def recorded(n: int = 40, seed: int = 1) -> pl.DataFrame:
    """Two packs in cruise after a climb, noise as sensors have it."""
    rng = np.random.default_rng(seed)
    share = np.clip(np.arange(n) / 8.0, 0.0, 1.0)
    packs = []
    for pack in (1, 2):
        signals = {s: v + NOISE.get(s, 1e-3 * v) * rng.normal(size=n) for s, v in CRUISE.items()}
        signals["altitude_m"] = 11_000.0 * share
        for s in ("total_pressure_pa", "cc_in_pa"):
            signals[s] = signals[s] + 60_000.0 * (1.0 - share)
        times = [datetime(2024, 3, 1, tzinfo=UTC) + timedelta(seconds=180 * k) for k in range(n)]
        packs.append(pl.DataFrame({"tail": "A", "pack": pack, "time_utc": times, **signals}))
    return pl.concat(packs)


def test_sound_record_passes_untouched():
    screened = null_bad_values(recorded(), by=BY)
    assert screened.select(SIGNALS).equals(recorded().select(SIGNALS))
    assert screened.select(pl.sum_horizontal("n_out_of_range", "n_spikes", "n_frozen").sum()).item() == 0


@pytest.mark.parametrize("signal", SIGNALS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_single_spike_is_nulled_and_counted(signal, sign):
    whole = recorded()
    row = 60
    jumped = pl.col(signal) + sign * 1.5 * LIMITS[signal][2]
    here = pl.int_range(pl.len()) == row
    spiked = whole.with_columns(pl.when(here).then(jumped).otherwise(pl.col(signal)).alias(signal))
    screened = null_bad_values(spiked, by=BY)
    assert screened[signal][row] is None
    assert screened[signal].null_count() == 1
    assert screened.select(pl.sum_horizontal("n_out_of_range", "n_spikes").sum()).item() == 1


@pytest.mark.parametrize("signal", SIGNALS)
def test_what_no_sensor_can_read_is_nulled(signal):
    low, high, _ = LIMITS[signal]
    absurd = recorded().with_columns(
        pl.when(pl.col("pack") == 1).then(high + (high - low)).otherwise(pl.col(signal)).alias(signal)
    )
    screened = null_bad_values(absurd, by=BY)
    assert screened.filter(pl.col("pack") == 1)[signal].null_count() == 40
    assert screened.filter(pl.col("pack") == 2)[signal].null_count() == 0


@pytest.mark.parametrize("signal", sorted({*NOISY, *FROZEN_RISE_M}))
def test_frozen_sensor_is_nulled_on_its_pack_alone(signal):
    frozen = recorded().with_columns(
        pl.when(pl.col("pack") == 2).then(CRUISE[signal]).otherwise(pl.col(signal)).alias(signal)
    )
    screened = null_bad_values(frozen, by=BY)
    assert screened.filter(pl.col("pack") == 2)[signal].null_count() == 40
    assert screened.filter(pl.col("pack") == 2)["n_frozen"].min() == 1
    assert screened.filter(pl.col("pack") == 1)["n_frozen"].sum() == 0


def test_step_that_stays_is_no_spike():
    stepped = recorded().with_columns(
        pl.when(pl.col("time_utc").rank("dense") > 20)
        .then(pl.col("hx_out_k") + 25.0)
        .otherwise(pl.col("hx_out_k"))
        .alias("hx_out_k")
    )
    assert null_bad_values(stepped, by=BY)["hx_out_k"].null_count() == 0


def test_column_that_nobody_records_stays_empty_and_uncounted():
    without = recorded().with_columns(pl.lit(None, pl.Float64).alias("ram_out_k"))
    assert null_bad_values(without, by=BY)["n_out_of_range"].sum() == 0
