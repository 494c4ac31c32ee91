"""Logs that contradict the snapshots of their own flight."""

from datetime import timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.record.exchange import BETWEEN_PACKS
from hdt_core.record.judge import judge_flights
from hdt_core.record.two_sources import contradicted_logs, without_logs
from hdt_core.record.usable import usable_rows
from tests.support.flight_lists import NOW, START, flight, listed

LATER = timedelta(hours=5)
FLIGHT_S = 7_200
NO_DELIVERIES = pl.DataFrame(schema={"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date})
OFFSETS = np.array([3.0, -2.0, 1.5, 0.0, -1.2, 0.3, 2.0, 0.0])
"""How the packs differ, in standard deviations of a report."""


def recording(source: str, every_s: int, sign: float = 1.0) -> pl.DataFrame:
    """A flight of two hours with both packs: half an hour of climb, half an hour of descent."""
    second = np.arange(0, FLIGHT_S, every_s)
    rng = np.random.default_rng(every_s)
    altitude_m = 11_000.0 * np.interp(second, [0, 1_800, 5_400, 7_200], [0.0, 1.0, 1.0, 0.0])
    difference = sign * OFFSETS[:, None] + rng.normal(0.0, 1.0, (len(OFFSETS), len(second)))
    times = [START + timedelta(seconds=int(s)) for s in second]
    rows = pl.DataFrame({"time_utc": times, "altitude_m": altitude_m})
    first_pack = dict(zip(BETWEEN_PACKS.values(), difference, strict=True))
    packs = [
        rows.with_columns(pack=pl.lit(1), **{name: pl.Series(v) for name, v in first_pack.items()}),
        rows.with_columns(pack=pl.lit(2), **{name: pl.lit(0.0) for name in first_pack}),
    ]
    return pl.concat(packs).with_columns(
        operator=pl.lit("AQX"), tail=pl.lit("LX-AAA"), flight_id=pl.lit("LX-AAA_20240304_01"), source=pl.lit(source)
    )


@pytest.fixture(scope="module")
def reports() -> pl.DataFrame:
    return recording("acms", 180)


def later(rows: pl.DataFrame, minutes: float) -> pl.DataFrame:
    return rows.with_columns(pl.col("time_utc") + timedelta(minutes=minutes))


def faults(*recordings: pl.DataFrame) -> list[str]:
    return contradicted_logs(pl.concat(recordings))["log_fault"].to_list()


@pytest.mark.parametrize("every_s", [1, 8])
def test_agreeing_log_is_used(reports, every_s):
    assert faults(reports, recording("cpl", every_s)) == []


@pytest.mark.parametrize("minutes", [-60, 3, 60, 600])
def test_log_of_other_clock_is_found(reports, minutes):
    assert faults(reports, later(recording("cpl", 4), minutes)) == ["log_clock"]


@pytest.mark.parametrize("minutes", [0.05, -0.05])
def test_seconds_between_clocks_count_nothing(reports, minutes):
    assert faults(reports, later(recording("cpl", 4), minutes)) == []


def test_log_with_exchanged_packs_is_found(reports):
    assert faults(reports, recording("cpl", 4, sign=-1.0)) == ["log_packs"]


def test_exchange_needs_several_reports(reports):
    few = reports.filter(pl.col("time_utc") < START + timedelta(minutes=10))

    assert faults(few, recording("cpl", 4, sign=-1.0)) == []


def test_spiked_altitude_is_no_other_clock(reports):
    spiked = reports.with_columns(
        pl.when(pl.int_range(pl.len()) % 10 == 0).then(20_000.0).otherwise("altitude_m").alias("altitude_m")
    )

    assert faults(spiked, recording("cpl", 4)) == []


def test_log_alone_is_used():
    assert faults(recording("cpl", 4)) == []


def test_log_without_altitude_is_used(reports):
    unknown = recording("cpl", 4).with_columns(altitude_m=pl.lit(None, pl.Float64))

    assert faults(reports, unknown) == []


def test_only_contradicted_log_is_left_out(reports):
    other = recording("cpl", 60).with_columns(flight_id=pl.lit("LX-AAA_20240304_02"))
    rows = pl.concat([reports, later(recording("cpl", 60), 60), other])

    used = without_logs(rows, contradicted_logs(rows))

    assert used.equals(pl.concat([reports, other]))


def test_contradicted_flight_is_used_without_log():
    flights = listed([flight("LX-AA0", START, 1, log_fault="log_packs"), flight("LX-AA0", START + LATER, 2)])

    verdicts = judge_flights(flights, NO_DELIVERIES, NOW)

    assert verdicts.select("reason", "is_used", "without_log").rows() == [("log_contradicts", True, True)]


def test_contradicted_log_is_not_usable(reports):
    flights = listed([flight("LX-AAA", START, 1, log_fault="log_packs")])

    rows = usable_rows(pl.concat([reports, recording("cpl", 60)]), judge_flights(flights, NO_DELIVERIES, NOW))

    assert rows.equals(reports)


def test_ground_run_is_unused_whatever_its_log():
    ground = flight("LX-AA0", START, 1, log_fault="log_clock", highest_mach=0.0, highest_altitude_m=800.0)

    verdicts = judge_flights(listed([ground]), NO_DELIVERIES, NOW)

    assert verdicts.select("reason", "is_used").rows() == [("no_flight", False)]
