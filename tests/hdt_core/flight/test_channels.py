"""Channels as the recorder delivers them: steps, rates, gaps, one channel for both packs, and none at all."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from alter import alter
from cruise import CRUISE

from hdt_core.flight.channels import OWN_SIGNALS, find_channels, regular_gaps
from hdt_core.flight.legs import judge_legs
from hdt_core.flight.quality import READING_SD
from hdt_core.tables.raw import RawSnapshots

LB_MIN = 0.45359237 / 60.0
AT_GROUND = {
    "altitude_m": 0.0, "tat_k": 288.0, "total_pressure_pa": 101_000.0, "hx_in_k": 470.0, "hx_out_k": 320.0,
    "ram_door_open": 0.9, "ram_out_k": 360.0, "cc_speed_rad_s": 2_500.0, "cc_in_k": 289.0, "cc_in_pa": 100_000.0,
    "cc_out_k": 420.0, "cc_out_pa": 200_000.0,
}  # fmt: skip


def fly(n: int = 40, every_s: float = 180.0, source: str = "acms") -> pl.DataFrame:
    """A climb, a cruise and a descent of both packs, with the noise of a reading."""
    rng = np.random.default_rng(1)
    share = np.clip(np.minimum(np.arange(n), n - 1 - np.arange(n)) / (0.2 * n), 0.0, 1.0)
    times = [datetime(2024, 3, 1, tzinfo=UTC) + timedelta(seconds=every_s * k) for k in range(n)]
    keys = {"operator": "OPA", "tail": "T1", "flight_id": "T1_20240301_01", "source": source, "file": "f"}
    packs = []
    for pack in (1, 2):
        signals = {}
        for name, value in CRUISE.items():
            mean = AT_GROUND.get(name, value) * (1.0 - share) + value * share
            signals[name] = mean + READING_SD.get(name, 0.0) * rng.standard_normal(n)
        packs.append(pl.DataFrame(keys | {"pack": pack, "time_utc": times} | signals))
    return RawSnapshots.conform(pl.concat(packs))


def in_steps(records: pl.DataFrame, signal: str, step: float) -> pl.DataFrame:
    return records.with_columns((pl.col(signal) / step).round() * step)


def reasons(records: pl.DataFrame) -> list[str]:
    return judge_legs(records)[0]["reason"].to_list()


STEPS = [
    *(("pack_flow_kg_s", k * LB_MIN) for k in (0.25, 1.0, 2.0, 5.0, 13.2, 50.0)),
    *(("cc_flow_kg_s", k * LB_MIN) for k in (0.25, 1.0, 2.0, 5.0, 13.2, 50.0)),
    *(("cc_speed_rad_s", k) for k in (1.0, 10.0, 100.0)),
    *(("total_pressure_pa", k) for k in (70.0, 700.0, 7_000.0)),
    *((t, k) for t in ("tat_k", "hx_in_k", "hx_out_k", "cc_out_k") for k in (0.25, 1.0, 5.0)),
    *(("ram_door_open", k) for k in (0.005, 0.05, 0.1)),
]


@pytest.mark.parametrize(("signal", "step"), STEPS)
def test_coarse_step_is_no_frozen_sensor(signal, step):
    assert reasons(in_steps(fly(), signal, step)) == ["", ""]


@pytest.mark.parametrize("step", [0.25, 1.0, 2.0])
def test_frozen_flow_is_flagged_beside_steps(step):
    stepped = in_steps(fly(), "pack_flow_kg_s", step * LB_MIN)
    assert reasons(alter(stepped, pl.col("pack") == 2, pack_flow_kg_s=100 * LB_MIN)) == ["", "SENSOR_FROZEN"]


PATTERNS = [(period, is_value) for period in (2, 3, 4) for is_value in (True, False)]


def with_gaps(records: pl.DataFrame, signal: str, period: int, *, one_is_kept: bool) -> pl.DataFrame:
    chosen = pl.int_range(pl.len()).over("pack") % period == 1
    return records.with_columns(pl.when(chosen if one_is_kept else ~chosen).then(signal).alias(signal))


@pytest.mark.parametrize(("period", "one_is_kept"), PATTERNS)
def test_regular_gap_is_a_lower_rate(period, one_is_kept):
    records = with_gaps(fly(), "hx_out_k", period, one_is_kept=one_is_kept)

    assert find_channels(records).select("signal", "reason").rows() == [("hx_out_k", "lower_rate")] * 2
    assert reasons(records) == ["", ""]


@pytest.mark.parametrize("value", [-999.0, 32_767.0])
def test_code_for_no_value_is_gap(value):
    assert reasons(alter(fly(), pl.int_range(pl.len()).over("pack") % 3 == 1, vda_counts=value)) == ["", ""]


def test_chance_gaps_are_irregular():
    """Every eighth of 24 readings, as one in sixty of all triples has some period."""
    empty = np.isin(np.arange(24), (7, 15, 23))

    assert regular_gaps(empty, np.arange(24)) == 0


def test_random_gaps_are_missing():
    gaps = (pl.int_range(pl.len()).over("pack") ** 3 % 31 < 9) & (pl.col("pack") == 2)
    assert reasons(alter(fly(), gaps, hx_out_k=None)) == ["", "SENSOR_MISSING"]


def of_pack_one(records: pl.DataFrame, signals: list[str]) -> pl.DataFrame:
    one = records.filter(pack=1).select("time_utc", *signals)
    two = records.filter(pack=2).drop(signals).join(one, on="time_utc", how="left", validate="1:1")
    return pl.concat([records.filter(pack=1), two.select(records.columns)])


@pytest.mark.parametrize("signals", [OWN_SIGNALS, *([s] for s in OWN_SIGNALS)], ids=lambda s: "all" if s[1:] else s[0])
def test_shared_channel_is_reported(signals):
    channels = find_channels(of_pack_one(in_steps(fly(), "hx_out_k", 0.25), signals))

    assert set(channels.select("pack", "signal", "reason").rows()) == {
        (pack, signal, "one_channel") for pack in (1, 2) for signal in signals
    }


def test_shared_channel_admits_neither_pack():
    legs, samples = judge_legs(of_pack_one(fly(), OWN_SIGNALS))
    assert legs["reason"].to_list() == ["ONE_CHANNEL"] * 2
    assert not samples["monitored"].any()


@pytest.mark.parametrize("step", [0.25, 1.0, 5.0, 13.2])
def test_equal_steps_are_two_channels(step):
    assert find_channels(in_steps(fly(), "pack_flow_kg_s", step * LB_MIN)).is_empty()


@pytest.mark.parametrize("signal", ["ram_out_k", "cc_out_k", "cc_flow_kg_s", "cc_speed_rad_s", "vda_counts"])
def test_zero_on_both_packs_is_unfitted(signal):
    zero = 273.15 if signal.endswith("_k") else 0.0
    records = fly().with_columns(pl.lit(zero).alias(signal))
    assert find_channels(records).select("signal", "reason").rows() == [(signal, "not_fitted")] * 2
    assert reasons(records) == ["", ""]


RATES_HZ = [0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0]


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_log_is_averaged_to_minutes(rate_hz):
    log = fly(int(3_600 * rate_hz), 1.0 / rate_hz, "cpl")

    samples = judge_legs(log)[1].filter(pack=1)

    assert samples["n_averaged"].max() <= 60
    assert samples.height == pytest.approx(60, abs=6)
    assert samples["monitored"].sum() > 25


@pytest.mark.parametrize("period", [2, 4, 8])
def test_slow_log_channel_is_averaged(period):
    log = with_gaps(fly(3_600, 1.0, "cpl"), "hx_out_k", period, one_is_kept=True)
    assert judge_legs(log)[1]["hx_out_k"].is_not_null().all()
