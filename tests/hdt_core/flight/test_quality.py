"""Screens of single values: what is planted is found, and nothing else."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from alter import alter
from cruise import CRUISE

from hdt_core.flight.quality import FROZEN_RISE_M, NOISY, SIGNALS, flow_steps, null_bad_values

BY = ("tail", "pack")
NOISE = {
    "pack_flow_kg_s": 0.008, "cc_flow_kg_s": 0.012, "cc_speed_rad_s": 80.0, "vda_counts": 40.0, "ram_door_open": 0.01,
}  # fmt: skip


def make_record(n: int = 40, seed: int = 1) -> pl.DataFrame:
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


def screen(rows: pl.DataFrame) -> pl.DataFrame:
    return null_bad_values(rows, by=BY)


def test_sound_record_passes():
    screened = screen(make_record())
    assert screened.select(SIGNALS).equals(make_record().select(SIGNALS))
    assert screened.select(pl.sum_horizontal("n_out_of_range", "n_spikes", "n_frozen").sum()).item() == 0


def test_lasting_step_is_no_spike():
    late = pl.col("time_utc").rank("dense") > 20
    stepped = alter(make_record(), late, hx_out_k=pl.col("hx_out_k") + 25.0)
    assert screen(stepped)["hx_out_k"].null_count() == 0


def test_empty_column_is_in_range():
    without = make_record().with_columns(pl.lit(None, pl.Float64).alias("ram_out_k"))
    assert screen(without)["n_out_of_range"].sum() == 0


PAPER = """
altitude_m -500 15500 1500, mach 0 1 0.06, tat_k 200 335 8, total_pressure_pa 12000 130000 8000, hx_in_k 240 560 15,
hx_out_k 240 450 8, ram_door_open -0.02 1.02 0.35, pack_flow_kg_s 0 3 0.15, ram_out_k 220 500 12,
cc_speed_rad_s 0 8000 700, cc_in_k 200 345 8, cc_in_pa 8000 130000 8000, cc_out_k 220 560 20,
cc_out_pa 30000 300000 8000, cc_flow_kg_s 0 3 0.2, vda_counts -1 4200 400
"""
"""Lowest and highest physical value of each signal, and the largest jump out of and back to its neighbours."""
LINES = (line.split() for line in PAPER.replace("\n", " ").split(","))
LIMIT = {name: tuple(map(float, limits)) for name, *limits in LINES}


def read(signal: str, values: dict[int, float]) -> pl.DataFrame:
    """A record whose signal reads some values in some rows."""
    rows = make_record()
    column = rows[signal].scatter(list(values), list(values.values()))
    return screen(rows.with_columns(column))


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


def spikes(signal: str, shape: dict[int, float]) -> list[int]:
    """Spikes in rows 60 and 61 of a calm signal that leaves its middle by so many allowed jumps."""
    low, high, jump = LIMIT[signal]
    readings = {k: 0.5 * (low + high) + jump * shape.get(k, 0.0) for k in range(55, 66)}
    return read(signal, readings)["n_spikes"][60:62].to_list()


@pytest.mark.parametrize("signal", LIMIT)
@pytest.mark.parametrize("times", [-1.001, -0.999, 0.999, 1.001])
def test_spike_leaves_both_neighbours(signal, times):
    """By more than a sound sensor can."""
    assert spikes(signal, {60: times}) == [int(abs(times) > 1.0), 0]


@pytest.mark.parametrize("signal", LIMIT)
@pytest.mark.parametrize("times", [-1.5, 1.5])
@pytest.mark.parametrize("rows", [range(60, 66), range(60, 62)], ids=["step", "two samples agree"])
def test_lasting_jump_is_no_spike(signal, times, rows):
    assert spikes(signal, dict.fromkeys(rows, times)) == [0, 0]


@pytest.mark.parametrize("signal", NOISY)
@pytest.mark.parametrize(
    ("n", "share", "every_s", "frozen"),
    [(6, 0.051, 180, True), (5, 0.051, 180, False), (6, 0.05, 180, False), (6, 0.3, 24, True), (6, 0.3, 23, False)],
)
def test_repeated_noisy_reading_is_frozen(signal, n, share, every_s, frozen):
    """Six times over two minutes."""
    high = LIMIT[signal][1]
    later = datetime(2024, 3, 1, tzinfo=UTC) + pl.int_range(pl.len()).over("pack") * timedelta(seconds=every_s)
    calm = make_record().with_columns(0.3 * high + 1e-3 * pl.col(signal), time_utc=later)
    stuck = alter(calm, pl.int_range(pl.len()).is_between(50, 49 + n), **{signal: share * high})
    assert (screen(stuck)["n_frozen"].sum() == n) is frozen


@pytest.mark.parametrize("signal", FROZEN_RISE_M)
def test_frozen_limit_is_as_declared(signal):
    assert FROZEN_RISE_M[signal] == (1000.0 if signal.endswith("_pa") else 6000.0)


@pytest.mark.parametrize("signal", FROZEN_RISE_M)
@pytest.mark.parametrize(("beyond_m", "n"), [(0.0, 0), (1.0, 10)])
def test_frozen_air_reading_ignores_altitude(signal, beyond_m, n):
    rise_m = FROZEN_RISE_M[signal] + beyond_m
    falling = make_record().with_columns(altitude_m=10_000.0 - rise_m * (pl.int_range(pl.len()) - 60).clip(0, 9) / 9.0)
    stuck = alter(falling, pl.int_range(pl.len()).is_between(60, 69), **{signal: CRUISE[signal]})
    assert screen(stuck)["n_frozen"].sum() == n


def every(nth: int) -> pl.Expr:
    """One reading in so many, of 40."""
    return pl.when(pl.int_range(pl.len()) % nth == 0).then(0.42)


def door_readings(value: float | pl.Expr, pack: int = 1, rise_m: float = 6_001.0, step: float = 0.001) -> int:
    """How many door readings are taken out where a pack's are `value`, and the others in steps."""
    flown = make_record().with_columns(
        pl.col("altitude_m") / 11_000.0 * rise_m, pl.col("ram_door_open").truediv(step).round() * step
    )
    return screen(alter(flown, pl.col("pack") == pack, ram_door_open=value))["n_frozen"].sum()


@pytest.mark.parametrize(
    ("case", "n"),
    [
        ({"value": 0.42}, 40),
        ({"value": 0.42, "pack": 2}, 40),
        ({"value": 0.42, "rise_m": 6_000.0}, 0),
        ({"value": every(8)}, 0),
        ({"value": every(7)}, 6),
        ({"value": 0.02}, 0),
        ({"value": 0.021}, 40),
        ({"value": 0.98}, 0),
        ({"value": 0.979}, 40),
    ],
)
def test_door_that_never_moves_is_frozen(case, n):
    """Neither at a stop, where a sound one may stand, nor within a cruise."""
    assert door_readings(**case) == n


def test_jammed_door_still_flickers():
    assert door_readings(0.42 + 0.005 * (pl.int_range(pl.len()) == 20).cast(pl.Float64)) == 0


def test_coarse_step_hides_a_jammed_doors_flicker():
    assert door_readings(0.42, step=0.02) == 0


def test_two_doors_do_not_freeze_on_one_flight():
    still = make_record().with_columns(ram_door_open=0.42)
    assert screen(still)["n_frozen"].sum() == 0


@pytest.mark.parametrize("sign", [-8.0, 8.0])
@pytest.mark.parametrize("beside", [(345.0, 344.0), (344.0, 345.0), (345.0, 346.0), (346.0, 345.0)])
def test_allowed_jump_is_no_spike(sign, beside):
    around = {59: beside[0], 60: 345.0 + sign, 61: beside[1]}
    assert read("hx_out_k", dict.fromkeys(range(55, 66), 345.0) | around)["n_spikes"][60] == 0


FLOW = pl.col("pack_flow_kg_s")


@pytest.mark.parametrize(("step", "is_coarse"), [(0.038, False), (0.076, True)])
def test_coarse_flow_shows_its_step(step, is_coarse):
    """Rounding by 5 lb/min is less than the noise of a reading, by 10 more; one pack takes more air."""
    flow = FLOW + 0.1 * pl.col("pack")
    rows = make_record().with_columns((flow / step).round() * step, operator=pl.lit("O"), flight_id=pl.lit("F"))
    shown = flow_steps(rows.with_columns(source=pl.lit("acms")))["pack_flow_step_ln"].item()
    assert shown == pytest.approx(step / rows["pack_flow_kg_s"].median() if is_coarse else 0.0)


def test_few_readings_show_no_step():
    """Five, far apart."""
    rows = make_record().head(5).with_columns(FLOW + 0.1 * pl.int_range(5), operator=pl.lit("O"), flight_id=pl.lit("F"))
    assert flow_steps(rows.with_columns(source=pl.lit("acms")))["pack_flow_step_ln"].to_list() == [0.0]
