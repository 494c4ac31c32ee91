"""Level one: every leg judged once, by its own record, for a reason; each rule at its edges."""

from datetime import UTC, datetime, timedelta

import polars as pl
import pytest

from hdt_core.flight.legs import BLEED, REASONS, judge_legs, prepare_samples, reject_odd_bleed
from hdt_core.records.keys import LEG
from hdt_core.tables.raw import RawReports


@pytest.fixture(scope="module")
def one_tail(fleet):
    tail = fleet.snapshots["tail"].unique().sort()[0]
    mine = fleet.snapshots.filter(pl.col("tail") == tail)
    some = mine["flight_id"].unique().sort()[:40]
    logged = mine.filter(pl.col("source") == "cpl")["flight_id"].unique()
    return mine.filter(pl.col("flight_id").is_in(pl.concat([some, logged]).implode()))


@pytest.fixture(scope="module")
def legs_and_samples(one_tail):
    return judge_legs(one_tail)


def test_every_leg_is_judged_once(one_tail, legs_and_samples):
    legs, _ = legs_and_samples
    assert legs.select(LEG).sort(LEG).equals(one_tail.select(LEG).unique().sort(LEG))
    assert set(legs["reason"]) <= {"", *REASONS}
    assert (legs["admitted"] == (legs["reason"] == "")).all()
    legs, samples = legs_and_samples
    nominal = samples.filter("nominal").join(legs.select(*LEG, "admitted"), on=LEG)
    assert nominal["monitored"].all()
    assert nominal["admitted"].all()
    assert set(nominal["phase"]) == {"cruise"}
    assert nominal.height > 100
    both = legs.filter(pl.col("source") == "both")
    assert both.height > 0
    averaged = samples.filter(pl.col("source") == "cpl")
    assert averaged["n_averaged"].is_between(45, 60).all()
    assert averaged["monitored"].any()
    assert (samples.filter(pl.col("source") == "acms")["n_averaged"] == 1).all()


def test_verdict_ignores_row_order(one_tail, legs_and_samples):
    shuffled = pl.concat([one_tail, one_tail.head(500)]).sample(fraction=1.0, shuffle=True, seed=5)
    legs, samples = judge_legs(shuffled)
    assert legs.equals(legs_and_samples[0])
    assert samples.height == legs_and_samples[1].height
    flight = one_tail["flight_id"].unique().sort()[20]
    alone, _ = judge_legs(one_tail.filter(pl.col("flight_id") == flight))
    among = legs_and_samples[0].filter(pl.col("flight_id") == flight)
    same = ["n_samples", "n_nominal", "departed_at", "reason"]
    assert alone.select(same).equals(among.select(same))
    legs, samples = judge_legs(one_tail.clear())
    assert legs.is_empty()
    assert samples.is_empty()
    assert {"admitted", "reason", "n_nominal", "cruise_minutes"} <= set(legs.columns)


def _altered(rows: pl.DataFrame, pack: int, **new: pl.Expr) -> pl.DataFrame:
    mine = (pl.col("pack") == pack) & (pl.col("source") == "acms")
    return rows.with_columns(pl.when(mine).then(value).otherwise(name).alias(name) for name, value in new.items())


@pytest.mark.parametrize(
    ("new", "reason"),
    [
        ({"pack_flow_kg_s": pl.lit(0.7711)}, "SENSOR_FROZEN"),
        ({"hx_out_k": pl.when(pl.int_range(pl.len()) ** 3 % 31 > 9).then("hx_out_k")}, "SENSOR_MISSING"),
        ({"pack_flow_kg_s": 0.001 * pl.col("pack_flow_kg_s")}, "PACK_OFF"),
        ({"ram_door_open": 0.4 + 0.01 * (pl.col("ram_door_open") - 0.3)}, "DOOR_STILL"),
        ({"altitude_m": 1_500.0 + 0.1 * pl.col("altitude_m")}, "NO_CRUISE"),
    ],
    ids=["frozen", "dropout", "pack off", "door still", "no cruise"],
)
def test_planted_fault_has_reason(one_tail, legs_and_samples, new, reason):
    sound = legs_and_samples[0].filter(pl.col("admitted").all().over("flight_id") & (pl.col("source") == "acms"))
    flight = sound["flight_id"][10]
    sick = _altered(one_tail.filter(pl.col("flight_id") == flight), 2, **new)
    rest = one_tail.filter(pl.col("flight_id") != flight)
    legs, _ = judge_legs(pl.concat([rest, sick]))
    mine = legs.filter((pl.col("flight_id") == flight) & (pl.col("pack") == 2))
    assert mine["reason"].to_list() == [reason]


FLOWN = {
    "altitude_m": 11_000.0, "mach": 0.82, "tat_k": 250.0, "total_pressure_pa": 35_000.0, "hx_in_k": 405.0,
    "hx_out_k": 296.0, "ram_door_open": 0.3, "pack_flow_kg_s": 0.77, "ram_out_k": 335.0, "cc_speed_rad_s": 3_600.0,
    "cc_in_k": 251.0, "cc_in_pa": 33_500.0, "cc_out_k": 365.0, "cc_out_pa": 93_000.0, "cc_flow_kg_s": 0.8,
    "vda_counts": 400.0,
}  # fmt: skip


def leg(pack: int = 1, rows: int = 12, **changed: object) -> pl.DataFrame:
    """A cruise of snapshots three minutes apart, the noisy signals in motion."""
    wobble = [0.001 * (k % 3) for k in range(rows)]
    moving = ("pack_flow_kg_s", "cc_flow_kg_s", "cc_speed_rad_s")
    signals = FLOWN | {s: [FLOWN[s] * (1.0 + w) for w in wobble] for s in moving}
    at = [datetime(2024, 3, 1, 6, tzinfo=UTC) + timedelta(minutes=3 * k) for k in range(rows)]
    key = {"operator": "TST", "tail": "T", "flight_id": "F", "pack": pack, "source": "acms", "phase_code": None}
    frame = pl.DataFrame(key | {"time_utc": at} | signals | changed, strict=False)
    typed = {"pack": pl.Int32, "time_utc": pl.Datetime("us", "UTC"), "phase_code": pl.String}
    return frame.cast(typed | dict.fromkeys(FLOWN, pl.Float64))


def reasons(*packs: pl.DataFrame) -> list[str]:
    return judge_legs(pl.concat(packs))[0].sort("pack")["reason"].to_list()


def some(value: float, n: int, rest: float, rows: int = 12) -> list[float]:
    return [value] * n + [rest] * (rows - n)


def test_sound_cruise_is_admitted():
    legs, samples = judge_legs(leg())
    row = legs.row(0, named=True)
    assert (row["reason"], row["admitted"], row["source"]) == ("", True, "acms")
    assert (row["n_samples"], row["n_snapshots"], row["n_monitored"], row["n_nominal"]) == (12, 12, 12, 12)
    assert row["cruise_minutes"] == 33.0
    assert samples["nominal"].all()
    for left, reason in ((2, ""), (1, "ICING")):
        assert reasons(leg(altitude_m=6000.0, tat_k=some(270.0, 12 - left, 250.0))) == [reason]
    for steady, reason in ((2, "NO_CRUISE"), (3, "")):
        height = [9000.0 + 200.0 * k for k in range(12 - steady)] + [11_500.0] * steady
        pa = {name: [42_000.0 - 700.0 * k for k in range(12)] for name in ("total_pressure_pa", "cc_in_pa")}
        assert reasons(leg(altitude_m=height, **pa)) == [reason]
    twice = pl.concat([leg(), leg()])
    assert prepare_samples(twice).height == 12
    assert prepare_samples(pl.concat([leg(rows=1), leg(2, rows=1)])).height == 2
    holed = prepare_samples(leg(hx_out_k=[None] + [296.0] * 11))
    assert holed["monitored"].to_list() == [False] + [True] * 11
    assert prepare_samples(leg(vda_counts=None))["monitored"].all()


@pytest.mark.parametrize(("flow", "reason"), [(0.1999, "PACK_OFF"), (0.2, "NO_CRUISE"), (0.21, "")])
def test_pack_is_off_below_flow(flow, reason):
    at_rest = [flow * (1.0 + 1e-7 * k) for k in range(12)]
    codes = reasons(leg(pack_flow_kg_s=at_rest), leg(2))
    assert codes == [reason if flow != 0.2 else "", "OTHER_PACK_OFF" if reason == "PACK_OFF" else ""]


def test_samples_in_icing_are_not_nominal():
    _, samples = judge_legs(leg(altitude_m=6000.0, tat_k=some(270.0, 4, 250.0)))

    assert samples.sort("time_utc")["nominal"].to_list() == [False] * 4 + [True] * 8


@pytest.mark.parametrize(
    ("rows", "n", "missing"), [(24, 3, True), (20, 2, False), (26, 3, False), (25, 3, False), (17, 2, False)]
)
def test_gap_limit_is_twelve_percent(rows, n, missing):
    """And three readings."""
    gaps = [None] * n + [335.0] * (rows - n)
    assert reasons(leg(rows=rows, ram_out_k=gaps)) == ["SENSOR_MISSING" if missing else ""]
    assert reasons(leg(rows=rows, ram_out_k=None), leg(2, rows=rows, ram_out_k=None)) == ["", ""]
    assert reasons(leg(rows=rows, ram_out_k=None), leg(2, rows=rows)) == ["SENSOR_MISSING", ""]


@pytest.mark.parametrize(
    ("tat_k", "altitude_m", "icing"),
    [(268.15, 6699.0, 1), (268.14, 6699.0, 0), (283.15, 6699.0, 1), (283.16, 6699.0, 0), (270.0, 6700.0, 0)],
)
def test_icing_is_cold_air_below_fl220(tat_k, altitude_m, icing):
    codes = reasons(leg(tat_k=tat_k, altitude_m=altitude_m))
    assert codes == ["ICING" if icing else ""]


@pytest.mark.parametrize(
    ("span", "rise_m", "rows", "still"),
    [
        (0.034, 4100.0, 12, True), (0.036, 4100.0, 12, False), (0.034, 4000.0, 12, False), (0.034, 4100.0, 7, False),
        (0.034, 4100.0, 8, True),
    ],
)  # fmt: skip
def test_still_door_in_climb_is_rejected(span, rise_m, rows, still):
    door = [0.3 + span * (k % 2) for k in range(rows)]
    height = [11_000.0 - rise_m, 11_000.0 - rise_m / 2.0] + [11_000.0] * (rows - 2)
    pa = {name: [60_000.0, 47_000.0] + [FLOWN[name]] * (rows - 2) for name in ("total_pressure_pa", "cc_in_pa")}
    assert reasons(leg(rows=rows, ram_door_open=door, altitude_m=height, **pa)) == ["DOOR_STILL" if still else ""]


DAY = datetime(2026, 3, 5, 6, tzinfo=UTC)
SOUND = {"pack_1_flow_kg_s": 1.2, "pack_2_flow_kg_s": 1.2, "bleed_1_open": True, "bleed_2_open": True,
         "crossfeed_open": False, "altitude_m": 10_000.0, "report": "08", "file": "f", "file_version": "v",
         "operator": "AAA", "tail": "X-1"}  # fmt: skip


def reports(hours: float, **values: object) -> pl.DataFrame:
    """One report, so many hours after the first departure."""
    row = SOUND | {"reported_at": DAY + timedelta(hours=hours), "mach": 0.8} | values
    return pl.DataFrame([row], schema=dict(RawReports.create_empty().schema))


@pytest.fixture
def legs() -> pl.DataFrame:
    """Two flights of an aircraft and one of another, two packs each; one leg was turned away already."""
    flights = [("X-1", "a", 0), ("X-1", "b", 5), ("X-2", "c", 0)]
    rows = [("AAA", t, f, p, DAY + timedelta(hours=h)) for t, f, h in flights for p in (1, 2)]
    frame = pl.DataFrame(rows, schema=["operator", "tail", "flight_id", "pack", "departed_at"], orient="row")
    sick = (pl.col("flight_id") == "a") & (pl.col("pack") == 2)
    rows = frame.with_columns(reason=pl.when(sick).then(pl.lit("ICING")).otherwise(pl.lit("")))
    return rows.with_columns(admitted=pl.col("reason") == "", n_nominal=pl.lit(7, pl.Int64))


ODD = [{"bleed_2_open": False}, {"crossfeed_open": True}, {"pack_1_flow_kg_s": 0.02}]


@pytest.mark.parametrize("values", ODD)
def test_odd_bleed_rejects_both_packs(legs, values):
    """An earlier reason stays."""
    rows = reject_odd_bleed(legs, reports(1.5, **values))
    assert rows["reason"].to_list() == [BLEED, "ICING", "", "", "", ""]
    assert rows["admitted"].to_list() == [False, False, True, True, True, True]
    assert rows["n_nominal"].to_list() == [0, 7, 7, 7, 7, 7]
    assert rows.columns == legs.columns


@pytest.mark.parametrize(
    "values",
    [{}, {"crossfeed_open": True, "altitude_m": 3_000.0}, {"crossfeed_open": True, "altitude_m": None},
     {"crossfeed_open": True, "tail": "X-9"}, dict.fromkeys(("bleed_1_open", "crossfeed_open", "pack_2_flow_kg_s"))],
)  # fmt: skip
def test_normal_bleed_rejects_nothing(legs, values):
    assert reject_odd_bleed(legs, reports(1.5, **values)).equals(legs)


@pytest.mark.parametrize(
    ("values", "hours", "turned"),
    [
        ({"pack_1_flow_kg_s": 0.1999}, 1.0, 1), ({"pack_1_flow_kg_s": 0.2}, 1.0, 0),
        ({"crossfeed_open": True, "altitude_m": 4572.0}, 1.0, 0),
        ({"crossfeed_open": True, "altitude_m": 4572.1}, 1.0, 1),
        ({"crossfeed_open": True}, 25.0, 2), ({"crossfeed_open": True}, 25.1, 0),
    ],
)  # fmt: skip
def test_odd_bleed_limits(legs, values, hours, turned):
    rows = reject_odd_bleed(legs, reports(hours, **values))
    assert (rows["reason"] == BLEED).sum() == turned


def test_report_belongs_to_last_departure(legs):
    rows = reject_odd_bleed(legs, reports(6.0, crossfeed_open=True))
    assert rows.filter(reason=BLEED)["flight_id"].unique().to_list() == ["b"]
    assert reject_odd_bleed(legs, reports(30.0, crossfeed_open=True)).equals(legs)
    assert reject_odd_bleed(legs, reports(-1.0, crossfeed_open=True)).equals(legs)
