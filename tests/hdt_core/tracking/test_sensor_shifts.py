"""A sensor that drifts slowly is taken out where a witness speaks that needs no step, and wear is left alone."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.tracking.sensor_shifts import corrections

N, ONSET = 240, 90
PER_TAT_K = 0.026


def flights(rng: np.random.Generator, wear: float = 0.0) -> pl.DataFrame:
    """Two packs of one aircraft with sound sensors; pack 1 wears by so much a flight."""
    start = datetime(2024, 1, 1, tzinfo=UTC)
    packs = []
    for pack in (1, 2):
        level = 0.1 - (wear * np.arange(N) if pack == 1 else 0.0)
        packs.append(
            pl.DataFrame(
                {
                    "operator": "TST", "tail": "T-01", "pack": pack, "flight_id": [f"T-01_{k}" for k in range(N)],
                    "departed_at": [start + timedelta(hours=6 * k) for k in range(N)],
                    "ln_ua_ratio": level + 0.016 * rng.standard_normal(N),
                    "tat_apart_k": 0.7 * pack + 0.26 * rng.standard_normal(N),
                    "door_apart_ln": 0.018 * rng.standard_normal(N),
                    "ratio_per_tat_k": np.full(N, PER_TAT_K),
                },
                schema_overrides={"pack": pl.Int32},
            )
        )  # fmt: skip
    return pl.concat(packs)


def drift(size: float) -> pl.Expr:
    """Nothing until the onset, then evenly up to `size` at the end."""
    since = pl.int_range(pl.len()).over("pack") - ONSET
    return size * since.clip(0, None) / (N - ONSET)


def test_tat_that_drifts_on_both_packs_is_taken_out() -> None:
    sound = flights(np.random.default_rng(1), wear=5e-4)
    off = drift(-5.0)
    seen = sound.with_columns(pl.col("tat_apart_k") + off, pl.col("ln_ua_ratio") + PER_TAT_K * off)
    found = corrections(seen)
    late = seen.select((pl.int_range(pl.len()).over("pack") >= N - 40).alias("late"))["late"].to_numpy()
    true = seen.select(PER_TAT_K * off).to_series().to_numpy()
    assert np.abs(found.shift - true)[late].mean() < 0.2 * np.abs(true[late]).mean()
    assert found.fault[late].mean() > 0.9


def test_one_compressors_inlet_that_drifts_is_not_tat() -> None:
    seen = flights(np.random.default_rng(2)).with_columns(
        pl.when(pl.col("pack") == 1)
        .then(pl.col("tat_apart_k") + drift(-5.0))
        .otherwise("tat_apart_k")
        .alias("tat_apart_k")
    )
    assert corrections(seen).fault.mean() < 0.05


@pytest.mark.parametrize("size", [-0.15, 0.15])
def test_a_door_that_reads_wrong_is_taken_out_however_slowly_it_began(size: float) -> None:
    off = pl.when(pl.col("pack") == 2).then(drift(size)).otherwise(0.0)
    seen = flights(np.random.default_rng(3)).with_columns(pl.col("door_apart_ln") + off, pl.col("ln_ua_ratio") + off)
    found, true = corrections(seen).shift, seen.select(off).to_series().to_numpy()
    late = (seen["pack"] == 2).to_numpy() & (np.abs(true) > 0.7 * abs(size))
    assert np.abs(found - true)[late].mean() < 0.3 * abs(size)


def test_wear_is_nobodys_fault() -> None:
    assert corrections(flights(np.random.default_rng(4), wear=2e-3)).fault.mean() < 0.01
