"""Compressor health: the filter by matrices, its numbers written out; renewals, gaps and what was not recorded."""

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, flights, log

from hdt_core.tracking.compressor_tracking import compressor_parameters, filter_loss

LOSSES = {"cc_efficiency_loss": (np.hypot(0.008, 0.01), 0.006), "cc_diameter_loss": (0.04, 0.02)}
"""Spread of a pack's level, of unit and of what the model was built from; scatter of a flight."""


def by_matrices(observed: list[float], renewed: list[int], level_sd: float, scatter: float) -> np.ndarray:
    """Kalman's filter of level and loss, seen as their sum; a residual beyond three deviations counts for less."""
    x, p, result = np.array([0.0, 0.005]), np.diag([level_sd**2, 0.015**2]), []
    h = np.ones(2)
    for value, new in zip(observed, renewed, strict=True):
        if new:
            x, p = np.array([0.0, 0.003]), np.diag([level_sd**2, 0.005**2])
        p = p + np.diag([0.0, 0.001**2])
        if np.isfinite(value):
            s = h @ p @ h + scatter**2
            far = abs(value - h @ x) / (3.0 * np.sqrt(s))
            s *= max(1.0, far) ** 2
            gain = p @ h / s
            x, p = x + gain * (value - h @ x), p - np.outer(gain, h @ p)
        seen_before = np.isfinite(value) or (result and np.isfinite(result[-1][0]))
        ratio = np.exp(-x[1])
        result.append((1.0 - ratio, ratio * np.sqrt(p[1, 1])) if seen_before else (np.nan, np.nan))
    return np.array(result)


def parameter(rows: pl.DataFrame, name: str) -> pl.DataFrame:
    return rows.filter(pl.col("parameter") == name).sort("tail", "departed_at")


@pytest.fixture
def machine() -> pl.DataFrame:
    """A machine that loses, jumps, falls silent and is replaced before its eleventh flight."""
    wear = [None, 0.01, 0.012, 0.2, 0.013, None, 0.02, 0.022, 0.025, 0.03, -0.01, 0.0]
    ratio = np.exp(-np.array(wear, float))
    return flights(
        12, efficiency=pl.Series(0.8 * ratio, nan_to_null=True).fill_nan(None).to_list(),
        diameter_m=pl.Series(0.17 * ratio).fill_nan(None).to_list(), expected_diameter_m=0.17,
        cc_n_samples=pl.Series([0, *[9] * 4, 0, *[9] * 6]).to_list(),
    )  # fmt: skip


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_is_filtered_as_by_matrices(machine, loss):
    wear = [np.nan, 0.01, 0.012, 0.2, 0.013, np.nan, 0.02, 0.022, 0.025, 0.03, -0.01, 0.0]
    expected = by_matrices(wear, [0] * 10 + [1, 0], *LOSSES[loss])
    rows = parameter(compressor_parameters(machine, log(("T-1", 1, "CC", "REPLACED", 9)), DSM), loss)
    np.testing.assert_allclose(rows.select("value", "sd").to_numpy().astype(float), expected, rtol=1e-9)
    assert rows["status"].to_list() == ["not_recorded", *["ok"] * 4, "predicted", *["ok"] * 6]
    assert rows.select("component", "unit", "estimator").unique().rows() == [("CC", "-", "kalman_filtered")]


def test_each_pack_is_filtered_by_itself(machine):
    two = pl.concat([machine, machine.with_columns(pack=pl.lit(2, pl.Int32))])
    wear = np.tile(np.linspace(0.0, 0.1, 12), 2)
    loss, sd = filter_loss(two, wear, np.zeros(24), 0.006, 0.01, 0.001)
    assert loss[:12].equals(loss[12:])
    assert sd[:12].equals(sd[12:])
    assert filter_loss(two.clear(), np.zeros(0), np.zeros(0), 0.006, 0.01, 0.001)[0].is_empty()


def test_an_exchangers_replacement_is_no_compressors(machine):
    with_log, without = (
        compressor_parameters(machine, entries, DSM) for entries in (log(("T-1", 1, "HX", "REPLACED", 9)), log())
    )
    assert with_log.equals(without)


def test_a_reading_that_no_machine_gives_is_none(machine):
    odd = machine.with_columns(pl.when(pl.int_range(12) == 4).then(-1.0).otherwise("efficiency").alias("efficiency"))
    blank = odd.with_columns(pl.when(pl.col("efficiency") > 0).then("efficiency").alias("efficiency"))
    assert compressor_parameters(odd, log(), DSM).equals(compressor_parameters(blank, log(), DSM))
    never = compressor_parameters(machine.with_columns(efficiency=pl.lit(None, pl.Float64)), log(), DSM)
    rows = parameter(never, "cc_efficiency_loss")
    assert rows["status"].unique().to_list() == ["not_recorded"]
    assert rows["value"].null_count() == rows["sd"].null_count() == 12


def test_diameter_is_the_flights_own_and_more_samples_are_surer():
    """A quarter of a per cent by the probes, and the error of a median of so many samples of 0.3 %."""
    twin = flights(3, efficiency=0.8, diameter_m=0.16, expected_diameter_m=0.17, cc_n_samples=[0, 1, 30])
    rows = parameter(compressor_parameters(twin, log(), DSM), "cc_effective_diameter_m")
    assert rows["value"].to_list() == [0.16] * 3
    noise = 0.003 * 1.2533 / np.sqrt([1.0, 1.0, 30.0])
    np.testing.assert_allclose(rows["sd"], 0.16 * np.hypot(0.0025, noise), rtol=1e-9)
    assert rows["status"].to_list() == ["predicted", "ok", "ok"]
    assert rows.select("unit", "estimator").unique().rows() == [("m", "closed_form")]
