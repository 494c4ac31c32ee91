"""Screens of single values: what is planted is found, and nothing else."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.samples import FROZEN_RISE_M, NOISY, SIGNALS, null_bad_values

BY = ("tail", "pack")
CRUISE = {
    "altitude_m": 11_000.0, "mach": 0.82, "tat_k": 251.0, "total_pressure_pa": 35_000.0, "hx_in_k": 405.0,
    "hx_out_k": 296.0, "ram_door_open": 0.3, "pack_flow_kg_s": 0.77, "ram_out_k": 335.0, "cc_speed_rad_s": 3_600.0,
    "cc_in_k": 252.0,
    "cc_in_pa": 33_500.0, "cc_out_k": 365.0, "cc_out_pa": 93_000.0, "cc_flow_kg_s": 0.8, "vda_counts": 400.0,
}  # fmt: skip
NOISE = {
    "pack_flow_kg_s": 0.008, "cc_flow_kg_s": 0.012, "cc_speed_rad_s": 80.0, "vda_counts": 40.0, "ram_door_open": 0.01,
}  # fmt: skip


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


def test_sound_record_passes():
    screened = null_bad_values(recorded(), by=BY)
    assert screened.select(SIGNALS).equals(recorded().select(SIGNALS))
    assert screened.select(pl.sum_horizontal("n_out_of_range", "n_spikes", "n_frozen").sum()).item() == 0
    late = pl.col("time_utc").rank("dense") > 20
    stepped = recorded().with_columns(
        pl.when(late).then(pl.col("hx_out_k") + 25.0).otherwise("hx_out_k").alias("hx_out_k")
    )
    assert null_bad_values(stepped, by=BY)["hx_out_k"].null_count() == 0
    without = recorded().with_columns(pl.lit(None, pl.Float64).alias("ram_out_k"))
    assert null_bad_values(without, by=BY)["n_out_of_range"].sum() == 0


PAPER = """
altitude_m -500 15500 1500, mach 0 1 0.06, tat_k 200 335 8, total_pressure_pa 12000 130000 8000, hx_in_k 240 560 15,
hx_out_k 240 450 8, ram_door_open -0.02 1.02 0.35, pack_flow_kg_s 0 3 0.15, ram_out_k 220 500 12,
cc_speed_rad_s 0 8000 700, cc_in_k 200 345 8, cc_in_pa 8000 130000 8000, cc_out_k 220 560 20,
cc_out_pa 30000 300000 8000, cc_flow_kg_s 0 3 0.2, vda_counts -1 4200 400
"""
"""Lowest and highest physical value of each signal, and the largest jump out of and back to its neighbours."""
LINES = (line.split() for line in PAPER.replace("\n", " ").split(","))
LIMIT = {name: tuple(map(float, limits)) for name, *limits in LINES}


def read(signal: str, values: dict[int, float], **more: object) -> pl.DataFrame:
    """A record whose signal reads some values in some rows."""
    row = pl.int_range(pl.len())
    changed = pl.col(signal)
    for k, value in values.items():
        changed = pl.when(row == k).then(value).otherwise(changed)
    return null_bad_values(recorded().with_columns(changed.alias(signal)), by=BY)


@pytest.mark.parametrize("signal", LIMIT)
def test_values_beyond_limits_are_nulled(signal):
    low, high, _ = LIMIT[signal]
    margin = 0.02 * high if low == 0.0 else 0.0  # a few counts below zero
    hair = 1e-6 * (high - low)
    for value, beyond in ((low - margin, 0), (high, 0), (low - margin - hair, 1), (high + hair, 1), (np.nan, 1)):
        screened = read(signal, {60: value})
        assert screened["n_out_of_range"].to_list() == [beyond * (k == 60) for k in range(80)]
        if beyond:
            assert screened[signal][60] is None


@pytest.mark.parametrize("signal", LIMIT)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_spike_leaves_both_neighbours(signal, sign):
    low, high, jump = LIMIT[signal]
    level = 0.5 * (low + high)
    for times, spike in ((1.001, 1), (0.999, 0)):
        around = dict.fromkeys(range(55, 66), level) | {60: level + sign * times * jump}
        assert read(signal, around)["n_spikes"][60] == spike
    steps = dict.fromkeys(range(55, 60), level) | dict.fromkeys(range(60, 66), level + sign * 1.5 * jump)
    assert read(signal, steps)["n_spikes"][60] == 0
    pair = dict.fromkeys(range(55, 66), level) | dict.fromkeys((60, 61), level + sign * 1.5 * jump)
    assert read(signal, pair)["n_spikes"][60:62].to_list() == [0, 0]  # two samples agree


@pytest.mark.parametrize("signal", NOISY)
def test_repeated_noisy_reading_is_frozen(signal):
    """Six times over two minutes."""
    high = LIMIT[signal][1]
    for n, level, every_s, frozen in (
        (6, 0.051 * high, 180, True), (5, 0.051 * high, 180, False), (6, 0.05 * high, 180, False),
        (6, 0.3 * high, 24, True), (6, 0.3 * high, 23, False),
    ):  # fmt: skip
        same = pl.when(pl.int_range(pl.len()).is_between(50, 49 + n)).then(level)
        same = same.otherwise(0.3 * high + 1e-3 * pl.col(signal))
        row = pl.int_range(pl.len()).over("pack")
        later = datetime(2024, 3, 1, tzinfo=UTC) + row * timedelta(seconds=every_s)
        slow = recorded().with_columns(same.alias(signal), time_utc=later)
        assert (null_bad_values(slow, by=BY)["n_frozen"].sum() == n) is frozen


@pytest.mark.parametrize("signal", FROZEN_RISE_M)
def test_frozen_air_reading_ignores_altitude(signal):
    most_m = 1000.0 if signal.endswith("_pa") else 6000.0
    assert FROZEN_RISE_M[signal] == most_m
    row = (pl.int_range(pl.len()) - 60).clip(0, 9)
    for rise_m, n in ((most_m, 0), (most_m + 1.0, 10)):
        value = pl.when(pl.int_range(pl.len()).is_between(60, 69)).then(CRUISE[signal]).otherwise(signal)
        falling = recorded().with_columns(altitude_m=10_000.0 - rise_m * row / 9.0, **{signal: value})
        assert null_bad_values(falling, by=BY)["n_frozen"].sum() == n


@pytest.mark.parametrize("sign", [-8.0, 8.0])
@pytest.mark.parametrize("beside", [(345.0, 344.0), (344.0, 345.0), (345.0, 346.0), (346.0, 345.0)])
def test_allowed_jump_is_no_spike(sign, beside):
    around = {59: beside[0], 60: 345.0 + sign, 61: beside[1]}
    assert read("hx_out_k", dict.fromkeys(range(55, 66), 345.0) | around)["n_spikes"][60] == 0
