"""Steady snapshots, windows about the log's entries, and legs of a declared component, at their edges."""

from dataclasses import replace
from datetime import UTC, date, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.components import components
from hdt_core.flight.component_legs import component_legs, component_samples
from hdt_core.flight.legs import AROUND_MAINTENANCE, AROUND_MESSAGE, baseline_flights, flag_windows, number_flights
from hdt_core.flight.quality import SIGNALS
from hdt_core.flight.steady import DRIVERS, average_log, drift_free, steady_snapshots


def log(drift: dict[str, float], seed: int = 4) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    second = np.arange(600)
    signals = {
        s: 1.0 + drift.get(s, 0.0) * second + DRIVERS.get(s, (0.0, 0.01))[1] * rng.normal(size=600) for s in SIGNALS
    }
    times = [datetime(2024, 3, 1, tzinfo=UTC) + timedelta(seconds=k) for k in range(600)]
    own = {"tail": "A", "time_utc": times, "phase": "cruise", "level": True, "climb_rate_m_s": 0.0, "n_spikes": 0}
    return pl.DataFrame(signals | own).cast({"n_spikes": pl.Int32, "time_utc": pl.Datetime("us", "UTC")})


def average(rows: pl.DataFrame) -> pl.DataFrame:
    return average_log(rows, by=("tail",))


def test_average_is_mean_of_minute():
    averaged = average(log({}))
    expected = log({}).select(SIGNALS).to_numpy().reshape(10, 60, -1).mean(axis=1)
    assert averaged["n_averaged"].to_list() == [60] * 10
    np.testing.assert_allclose(averaged.select(SIGNALS).to_numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("times", [0.0, 0.2])
def test_slow_drift_is_steady(times):
    assert average(log({s: times * rate for s, (rate, _) in DRIVERS.items()}))["steady"].all()


def test_harmful_drifts_are_as_declared():
    assert DRIVERS == {
        "altitude_m": (1.524, 5.0), "mach": (4.0e-4, 1.5e-3), "tat_k": (0.03, 0.35), "hx_in_k": (0.08, 0.6),
        "pack_flow_kg_s": (1.5e-3, 0.012), "ram_door_open": (2.0e-3, 0.012),
    }  # fmt: skip


@pytest.mark.parametrize("signal", DRIVERS)
def test_drifting_minute_is_unsteady(signal):
    assert not average(log({signal: 4.0 * DRIVERS[signal][0]}))["steady"].any()


@pytest.mark.parametrize("signal", DRIVERS)
@pytest.mark.parametrize("every_s", [60.9, 600.9])
@pytest.mark.parametrize(("times", "steady"), [(0.999, True), (1.001, False)])
def test_snapshot_is_steady_by_nearer_neighbour(signal, every_s, times, steady):
    rate, noise = DRIVERS[signal]
    most = max(rate * every_s, 4.0 * 2.0**0.5 * noise)
    for shape in ([0.0, times, 3.0], [0.0, -times, -9.0], [9.0, 0.0, times]):
        assert steady_flags(signal, [most * value for value in shape], every_s)[1] is steady


@pytest.mark.parametrize(("seconds", "averaged"), [(45, 1), (44, 0)])
def test_minute_needs_45_seconds(seconds, averaged):
    assert average(log({}).head(seconds)).height == averaged


@pytest.mark.parametrize(("n", "has_value"), [(31, True), (30, False)])
def test_signal_needs_half_its_minute(n, has_value):
    half = log({}).head(60).with_columns(mach=pl.when(pl.int_range(pl.len()) < n).then("mach"))
    assert (average(half)["mach"][0] is not None) is has_value


def test_minute_counts_its_seconds():
    minute = log({}).head(60).with_columns(level=pl.int_range(pl.len()) != 3, n_spikes=pl.lit(2))
    assert average(minute).select("level", "n_spikes", "n_averaged").rows() == [(False, 120, 60)]


@pytest.mark.parametrize(
    ("values", "columns", "steady"),
    [([0.0, 0.5], {"phase": ["climb", "cruise"]}, [True, True]), ([0.0, 0.0], {"level": [False, True]}, [False, True])],
    ids=["phase", "level"],
)
def test_neighbour_is_of_own_phase(values, columns, steady):
    """And only level flight is steady."""
    assert steady_flags("mach", values, 60, **columns) == steady


SECOND = np.arange(10.0)


@pytest.mark.parametrize(
    ("t", "times", "free"), [(4.05, 1.01, False), (3.95, 1.01, True), (4.05, 0.99, True), (-4.05, 1.01, False)]
)
def test_drift_is_significant_harmful_slope(t, times, free):
    """Student's t of the line through ten readings, 4 at most, or a drift below what does harm."""
    noise = np.random.default_rng(1).normal(size=10)
    noise -= np.polyval(np.polyfit(SECOND, noise, 1), SECOND)
    slope = t * np.sqrt((noise**2).sum() / 8.0 / ((SECOND - 4.5) ** 2).sum())
    rows = pl.DataFrame({"s": SECOND, "x": noise + slope * SECOND})
    assert rows.select(drift_free(pl.col("s"), "x", abs(slope) / times)).item() is free


def test_empty_signal_has_no_drift():
    gap = pl.DataFrame({"s": SECOND, "x": [None] * 10}, schema_overrides={"x": pl.Float64})
    assert gap.select(drift_free(pl.col("s"), "x", 1.0)).item() is True


def steady_flags(signal: str, values: list[float], every_s: float, **more: object) -> list[bool]:
    start = datetime(2024, 3, 1, tzinfo=UTC)
    rows = {
        "tail": "A", "time_utc": [start + timedelta(seconds=every_s * k) for k in range(len(values))], "level": True,
        "phase": "cruise",
    }  # fmt: skip
    frame = pl.DataFrame(rows | dict.fromkeys(DRIVERS, 1.0) | {signal: values} | more)
    return steady_snapshots(frame, by=("tail",))["steady"].to_list()


START = datetime(2024, 3, 1, 6, tzinfo=UTC)


def legs(n: int = 60) -> pl.DataFrame:
    flown = [(tail, pack, k) for tail in ("A", "B") for pack in (1, 2) for k in range(n)]
    rows = [{"operator": "AQX", "tail": t, "pack": p, "departed_at": START + timedelta(days=k)} for t, p, k in flown]
    typed = pl.DataFrame(rows, schema_overrides={"pack": pl.Int32, "departed_at": pl.Datetime("us", "UTC")})
    return number_flights(typed.with_columns(pl.lit("x").alias("flight_id")))


def work_log(component: str, action: str = "REPLACED", on: date = date(2024, 3, 31)) -> pl.DataFrame:
    own = {"operator": ["AQX"], "tail": "A", "done_on": on, "pack": 2}
    return pl.DataFrame(own | {"component": component, "action": action})


def message_log(code: str) -> pl.DataFrame:
    at = START + timedelta(days=30, hours=1)
    return pl.DataFrame({"operator": ["AQX"], "tail": "A", "message_time": at, "pack": 1, "code": code})


NO_WORK = work_log("HX").clear()
NO_MESSAGE = message_log("21-52-HXTEMP").clear()


def flights_near(work: pl.DataFrame = NO_WORK, message: pl.DataFrame = NO_MESSAGE) -> list[int]:
    """Numbers of the flights near maintenance or a message."""
    flagged = flag_windows(legs(), work, message)
    return flagged.filter(pl.col("near_maintenance") | pl.col("near_message"))["flight_number"].to_list()


def window(about: int, reach: tuple[int, int]) -> list[int]:
    before, after = reach
    return list(range(about - before, about + after + 1))


@pytest.mark.parametrize("component", AROUND_MAINTENANCE)
def test_maintenance_window_is_as_declared(component):
    """Flight 29 left on the 30th of March, the last before the entry."""
    assert flights_near(work_log(component)) == window(29, AROUND_MAINTENANCE[component])


@pytest.mark.parametrize("component", AROUND_MAINTENANCE)
def test_maintenance_window_is_of_pack(component):
    flagged = flag_windows(legs(), work_log(component), NO_MESSAGE).filter("near_maintenance")
    assert flagged.select("tail", "pack").unique().rows() == [("A", 2)]


def test_window_opens_at_time_of_work():
    """The flight of six o'clock had left when the work was done at noon."""
    noon = work_log("HX").with_columns(done_at=pl.lit(datetime(2024, 3, 31, 12, tzinfo=UTC)))
    assert flights_near(noon) == window(30, AROUND_MAINTENANCE["HX"])


def test_packs_share_flight_numbers():
    counts = legs().group_by("tail", "departed_at").agg(pl.col("flight_number").n_unique())
    assert set(counts["flight_number"]) == {1}


def test_other_message_opens_no_window():
    assert flights_near(message=message_log("21-61-TRIM")) == []


@pytest.mark.parametrize("action", ["INSPECTED", "CLEANED"])
def test_other_work_opens_no_window(action):
    assert flights_near(work_log("HX", action)) == []


@pytest.mark.parametrize("code", ["21-52-HXTEMP", "21-51-CCFLOW"])
def test_message_opens_window(code):
    """Of exchanger or compressor."""
    assert flights_near(message=message_log(code)) == window(30, AROUND_MESSAGE[code[:5]])


@pytest.mark.parametrize("on", [date(2023, 1, 1), date(2025, 1, 1)])
def test_entry_outside_record_flags_nothing(on):
    flagged = flag_windows(legs(), work_log("HX", on=on), NO_MESSAGE)
    assert (flagged.height, flagged["near_maintenance"].sum()) == (legs().height, 0)


def test_windows_are_as_declared():
    assert AROUND_MAINTENANCE["RAM_DOOR"] == AROUND_MAINTENANCE["SENSOR"] == (15, 1)
    assert AROUND_MESSAGE == {"21-52": (10, 5), "21-51": (10, 5)}


@pytest.mark.parametrize(
    ("n_flights", "reached"),
    [
        (3, 3), (9, 9), (10, 10), (12, 10), (19, 10), (20, 20), (25, 20), (40, 40), (79, 40), (80, 80), (159, 80),
        (160, 160), (400, 160),
    ],
)  # fmt: skip
def test_baseline_grows_by_milestones(n_flights, reached):
    first = legs(n_flights).filter(tail="A", pack=1)
    first = first.with_columns(flight_id=pl.col("flight_number").cast(pl.String).str.zfill(3))
    assert baseline_flights(first.reverse()) == [f"{k:03d}" for k in range(reached)]


@pytest.mark.parametrize(("days", "reached"), [(21, True), (22, False)])
def test_entry_reaches_back_three_weeks(days, reached):
    assert bool(flights_near(work_log("HX", on=(START + timedelta(days=59 + days)).date()))) == reached


HXT = components()["HXT"]
MORNING = datetime(2024, 3, 1, 6, tzinfo=UTC)
MINUTE = timedelta(minutes=1)
FLOWN = {"hot_in_k": 400.0, "hot_out_k": 300.0, "tat_k": 250.0, "altitude_m": 10_000.0, "mach": 0.8, "fan_rad_s": 300.0}


def signals(rows: int = 6, code: str = "HXT", **changed: object) -> pl.DataFrame:
    """A flight's signals in the long form; a signal whose value is None is not recorded."""
    recorded = FLOWN | changed
    own = {"operator": "TST", "tail": "T", "flight_id": "F", "pack": 1, "component": code}
    lines = [
        own
        | {"signal": name, "value": value[k] if isinstance(value, list) else value, "time_utc": MORNING + k * MINUTE}
        for name, value in recorded.items()
        for k in range(rows)
    ]
    frame = pl.DataFrame(lines, schema_overrides={"value": pl.Float64, "pack": pl.Int32})
    return frame.filter(pl.col("value").is_not_null())


def leg(component=HXT, **changed: object) -> dict[str, object]:
    return component_legs(component_samples(signals(**changed), component), component).row(0, named=True)


def test_leg_of_six_samples_is_admitted():
    facts = {"reason": "", "component": "HXT", "n_samples": 6, "n_nominal": 6, "departed_at": MORNING}
    row = leg()
    assert {name: row[name] for name in facts} == facts


def test_samples_are_of_own_component():
    """In one column a channel, whether recorded or not."""
    wide = component_samples(pl.concat([signals(), signals(code="OTHER", mach=0.1)]), HXT)
    assert wide["mach"].to_list() == [0.8] * 6
    assert wide["ram_exit_open"].null_count() == 6


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"hot_out_k": None}, "NOT_RECORDED"), ({"fan_rad_s": None}, ""),
        ({"hot_out_k": [300.0] + [None] * 5}, "FEW_SAMPLES"),
    ],
)  # fmt: skip
def test_leg_needs_its_channels(changed, reason):
    assert leg(**changed)["reason"] == reason


def with_channel(signal: str, **changed: object):
    """The component where a channel of its record is declared otherwise."""
    channels = (replace(c, **changed) if c.signal == signal else c for c in HXT.record.channels)
    return replace(HXT, record=replace(HXT.record, channels=tuple(channels)))


def test_model_needs_no_other_channel():
    """Though it is declared as needed."""
    assert leg(with_channel("fan_rad_s", needed=True), fan_rad_s=None)["reason"] == ""


def test_legs_are_ordered_by_departure():
    later = signals().with_columns(flight_id=pl.lit("A"), time_utc=pl.col("time_utc") + timedelta(hours=9))
    wide = component_samples(pl.concat([later, signals()]), HXT)
    assert component_legs(wide, HXT)["flight_id"].to_list() == ["F", "A"]


def test_component_without_record_is_an_error():
    with pytest.raises(ValueError, match="HX has no record"):
        component_samples(signals(), components()["HX"])


@pytest.mark.parametrize(("slow", "reason"), [(1, ""), (2, "FEW_SAMPLES")])
def test_leg_needs_five_nominal_samples(slow, reason):
    row = leg(mach=[0.15] * slow + [0.151] * (6 - slow))
    assert (row["n_nominal"], row["reason"]) == (6 - slow, reason)


@pytest.mark.parametrize(("harmful", "reason"), [(0.009, "UNSTEADY"), (0.011, "")])
def test_drifting_signal_is_unsteady(harmful, reason):
    """A kelvin every hundred seconds."""
    tat = [250.0 + 0.6 * k + 0.001 * (k % 2) for k in range(6)]
    assert leg(with_channel("tat_k", harmful_per_s=harmful), tat_k=tat)["reason"] == reason
