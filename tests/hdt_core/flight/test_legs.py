"""Level one: every leg judged once, by its own record, for a reason; each rule at its edges."""

from datetime import UTC, datetime, timedelta

import polars as pl
import pytest
from alter import alter
from cruise import CRUISE

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
def judgement(one_tail):
    return judge_legs(one_tail)


@pytest.fixture(scope="module")
def tail_legs(judgement) -> pl.DataFrame:
    return judgement[0]


@pytest.fixture(scope="module")
def tail_samples(judgement) -> pl.DataFrame:
    return judgement[1]


def test_every_leg_is_judged_once(one_tail, tail_legs):
    assert tail_legs.select(LEG).sort(LEG).equals(one_tail.select(LEG).unique().sort(LEG))
    assert set(tail_legs["reason"]) <= {"", *REASONS}
    assert (tail_legs["admitted"] == (tail_legs["reason"] == "")).all()


def test_nominal_samples_are_of_admitted_legs(tail_legs, tail_samples):
    nominal = tail_samples.filter("nominal").join(tail_legs.select(*LEG, "admitted"), on=LEG)
    assert nominal.height > 100
    assert nominal.select(pl.col("monitored", "admitted").all()).row(0) == (True, True)
    assert set(nominal["phase"]) == {"cruise"}


def test_log_samples_are_averages(tail_legs, tail_samples):
    averaged = tail_samples.filter(source="cpl")
    assert tail_legs.filter(source="both").height > 0
    assert averaged["n_averaged"].is_between(45, 60).all()
    assert averaged["monitored"].any()
    assert (tail_samples.filter(source="acms")["n_averaged"] == 1).all()


def test_verdict_ignores_row_order(one_tail, tail_legs, tail_samples):
    """And repeated rows."""
    shuffled = pl.concat([one_tail, one_tail.head(500)]).sample(fraction=1.0, shuffle=True, seed=5)
    legs, samples = judge_legs(shuffled)
    assert legs.equals(tail_legs)
    assert samples.height == tail_samples.height


def test_verdict_ignores_other_flights(one_tail, tail_legs):
    one = pl.col("flight_id") == one_tail["flight_id"].unique().sort()[20]
    same = ["n_samples", "n_nominal", "departed_at", "reason"]
    assert judge_legs(one_tail.filter(one))[0].select(same).equals(tail_legs.filter(one).select(same))


def test_no_samples_have_no_legs(one_tail):
    legs, samples = judge_legs(one_tail.clear())
    assert (legs.height, samples.height) == (0, 0)
    assert {"admitted", "reason", "n_nominal", "cruise_minutes"} <= set(legs.columns)


@pytest.mark.parametrize(
    ("new", "reason"),
    [
        ({"pack_flow_kg_s": 0.7711}, "SENSOR_FROZEN"),
        ({"hx_out_k": pl.when(pl.int_range(pl.len()) ** 3 % 31 > 9).then("hx_out_k")}, "SENSOR_MISSING"),
        ({"pack_flow_kg_s": 0.001 * pl.col("pack_flow_kg_s")}, "PACK_OFF"),
        ({"ram_door_open": 0.4 + 0.01 * (pl.col("ram_door_open") - 0.3)}, "DOOR_STILL"),
        ({"altitude_m": 1_500.0 + 0.1 * pl.col("altitude_m")}, "NO_CRUISE"),
    ],
    ids=["frozen", "dropout", "pack off", "door still", "no cruise"],
)
def test_planted_fault_has_reason(one_tail, tail_legs, new, reason):
    sound = tail_legs.filter(pl.col("admitted").all().over("flight_id") & (pl.col("source") == "acms"))
    one = pl.col("flight_id") == sound["flight_id"][10]
    sick = alter(one_tail.filter(one), (pl.col("pack") == 2) & (pl.col("source") == "acms"), **new)
    legs, _ = judge_legs(pl.concat([one_tail.filter(~one), sick]))
    assert legs.filter(one, pack=2)["reason"].to_list() == [reason]


def leg(pack: int = 1, rows: int = 12, **changed: object) -> pl.DataFrame:
    """A cruise of snapshots three minutes apart, the noisy signals in motion."""
    wobble = [0.001 * (k % 3) for k in range(rows)]
    moving = ("pack_flow_kg_s", "cc_flow_kg_s", "cc_speed_rad_s")
    signals = CRUISE | {s: [CRUISE[s] * (1.0 + w) for w in wobble] for s in moving}
    at = [datetime(2024, 3, 1, 6, tzinfo=UTC) + timedelta(minutes=3 * k) for k in range(rows)]
    key = {"operator": "TST", "tail": "T", "flight_id": "F", "pack": pack, "source": "acms", "phase_code": None}
    frame = pl.DataFrame(key | {"time_utc": at} | signals | changed, strict=False)
    typed = {"pack": pl.Int32, "time_utc": pl.Datetime("us", "UTC"), "phase_code": pl.String}
    return frame.cast(typed | dict.fromkeys(CRUISE, pl.Float64))


def reasons(*packs: pl.DataFrame) -> list[str]:
    return judge_legs(pl.concat(packs))[0].sort("pack")["reason"].to_list()


def some(value: float | None, n: int, rest: float, rows: int = 12) -> list[float | None]:
    return [value] * n + [rest] * (rows - n)


def test_sound_cruise_is_admitted():
    legs, samples = judge_legs(leg())
    figures = {
        "reason": "", "admitted": True, "source": "acms", "n_samples": 12, "n_snapshots": 12, "n_monitored": 12,
        "n_nominal": 12, "cruise_minutes": 33.0,
    }  # fmt: skip
    assert legs.select(*figures).to_dicts() == [figures]
    assert samples["nominal"].all()


@pytest.mark.parametrize(("left", "reason"), [(2, ""), (1, "ICING")])
def test_leg_needs_two_nominal_samples(left, reason):
    assert reasons(leg(altitude_m=6000.0, tat_k=some(270.0, 12 - left, 250.0))) == [reason]


@pytest.mark.parametrize(("steady", "reason"), [(2, "NO_CRUISE"), (3, "")])
def test_cruise_needs_three_level_samples(steady, reason):
    height = [9000.0 + 200.0 * k for k in range(12 - steady)] + [11_500.0] * steady
    pa = {name: [42_000.0 - 700.0 * k for k in range(12)] for name in ("total_pressure_pa", "cc_in_pa")}
    assert reasons(leg(altitude_m=height, **pa)) == [reason]


@pytest.mark.parametrize(("packs", "height"), [((leg(), leg()), 12), ((leg(rows=1), leg(2, rows=1)), 2)])
def test_repeated_samples_count_once(packs, height):
    assert prepare_samples(pl.concat(packs)).height == height


@pytest.mark.parametrize(
    ("readings", "monitored"),
    [({"hx_out_k": [None] + [296.0] * 11}, [False] + [True] * 11), ({"vda_counts": None}, [True] * 12)],
    ids=["outlet", "diffuser"],
)
def test_monitored_sample_needs_its_readings(readings, monitored):
    assert prepare_samples(leg(**readings))["monitored"].to_list() == monitored


@pytest.mark.parametrize(
    ("flow", "codes"), [(0.1999, ["PACK_OFF", "OTHER_PACK_OFF"]), (0.2, ["", ""]), (0.21, ["", ""])]
)
def test_pack_is_off_below_flow(flow, codes):
    at_rest = [flow * (1.0 + 1e-7 * k) for k in range(12)]
    assert reasons(leg(pack_flow_kg_s=at_rest), leg(2)) == codes


def test_packs_land_together():
    legs, _ = judge_legs(pl.concat([leg(), leg(2, rows=14)]))

    assert legs["landed_at"].n_unique() == 1


def test_samples_in_icing_are_not_nominal():
    _, samples = judge_legs(leg(altitude_m=6000.0, tat_k=some(270.0, 4, 250.0)))

    assert samples.sort("time_utc")["nominal"].to_list() == [False] * 4 + [True] * 8


@pytest.mark.parametrize(
    ("rows", "n", "reason"),
    [(24, 3, "SENSOR_MISSING"), (20, 2, ""), (26, 3, ""), (25, 3, ""), (17, 2, "")],
)
def test_gap_limit_is_twelve_percent(rows, n, reason):
    """And three readings."""
    assert reasons(leg(rows=rows, ram_out_k=some(None, n, 335.0, rows))) == [reason]


@pytest.mark.parametrize(("of_second", "codes"), [({"ram_out_k": None}, ["", ""]), ({}, ["SENSOR_MISSING", ""])])
@pytest.mark.parametrize("rows", [17, 20, 24, 25, 26])
def test_sensor_of_one_pack_is_missing(rows, of_second, codes):
    assert reasons(leg(rows=rows, ram_out_k=None), leg(2, rows=rows, **of_second)) == codes


@pytest.mark.parametrize(
    ("tat_k", "altitude_m", "reason"),
    [
        (268.15, 6699.0, "ICING"), (268.14, 6699.0, ""), (283.15, 6699.0, "ICING"), (283.16, 6699.0, ""),
        (270.0, 6700.0, ""),
    ],
)  # fmt: skip
def test_icing_is_cold_air_below_fl220(tat_k, altitude_m, reason):
    """Cold and wet."""
    assert reasons(leg(tat_k=tat_k, altitude_m=altitude_m)) == [reason]


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
    pa = {name: [60_000.0, 47_000.0] + [CRUISE[name]] * (rows - 2) for name in ("total_pressure_pa", "cc_in_pa")}
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
    expected = {
        "reason": [BLEED, "ICING", "", "", "", ""], "admitted": [False, False, True, True, True, True],
        "n_nominal": [0, 7, 7, 7, 7, 7],
    }  # fmt: skip
    assert rows.select(*expected).to_dict(as_series=False) == expected
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


@pytest.mark.parametrize("hours", [30.0, -1.0])
def test_report_outside_flights_rejects_nothing(legs, hours):
    assert reject_odd_bleed(legs, reports(hours, crossfeed_open=True)).equals(legs)
