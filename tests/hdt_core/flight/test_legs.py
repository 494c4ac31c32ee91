"""Level one: every leg judged once, by its own record, for a reason."""

from datetime import UTC, datetime, timedelta

import polars as pl
import pytest

from hdt_core.flight.legs import REASONS, judge_legs, prepare_samples
from hdt_core.flight.phases import LEG_KEY


@pytest.fixture(scope="module")
def one_tail(fleet):
    tail = fleet.snapshots["tail"].unique().sort()[0]
    mine = fleet.snapshots.filter(pl.col("tail") == tail)
    some = mine["flight_id"].unique().sort()[:40]
    logged = mine.filter(pl.col("source") == "cpl")["flight_id"].unique()
    return mine.filter(pl.col("flight_id").is_in(pl.concat([some, logged]).implode()))


@pytest.fixture(scope="module")
def no_log(fleet):
    return fleet.maintenance.clear(), fleet.messages.clear()


@pytest.fixture(scope="module")
def judged(one_tail, no_log):
    return judge_legs(one_tail, *no_log)


def test_every_flight_and_pack_is_judged_once_with_a_known_reason(one_tail, judged):
    legs, _ = judged
    assert legs.select(LEG_KEY).sort(LEG_KEY).equals(one_tail.select(LEG_KEY).unique().sort(LEG_KEY))
    assert set(legs["reason"]) <= {"", *REASONS}
    assert (legs["admitted"] == (legs["reason"] == "")).all()


def test_nominal_samples_are_monitored_samples_of_admitted_legs(judged):
    legs, samples = judged
    nominal = samples.filter("nominal").join(legs.select(*LEG_KEY, "admitted"), on=LEG_KEY)
    assert nominal["monitored"].all()
    assert nominal["admitted"].all()
    assert set(nominal["phase"]) == {"cruise"}
    assert nominal.height > 100


def test_order_and_repetition_of_rows_change_nothing(one_tail, no_log, judged):
    shuffled = pl.concat([one_tail, one_tail.head(500)]).sample(fraction=1.0, shuffle=True, seed=5)
    legs, samples = judge_legs(shuffled, *no_log)
    assert legs.equals(judged[0])
    assert samples.height == judged[1].height


def test_verdict_on_a_flight_does_not_depend_on_the_others(one_tail, no_log, judged):
    flight = one_tail["flight_id"].unique().sort()[20]
    alone, _ = judge_legs(one_tail.filter(pl.col("flight_id") == flight), *no_log)
    among = judged[0].filter(pl.col("flight_id") == flight)
    same = ["n_samples", "n_nominal", "departed_at", "reason"]
    assert alone.select(same).equals(among.select(same))


def test_log_and_messages_move_the_verdict_but_never_what_is_monitored(fleet):
    quiet = judge_legs(fleet.snapshots, fleet.maintenance.clear(), fleet.messages.clear())
    logged = judge_legs(fleet.snapshots, fleet.maintenance, fleet.messages)
    assert quiet[1]["monitored"].equals(logged[1]["monitored"])
    assert logged[0]["admitted"].sum() < quiet[0]["admitted"].sum()
    assert {"MAINTENANCE", "MESSAGE"} <= set(logged[0]["reason"])


def test_log_of_one_hertz_becomes_averaged_minutes_beside_the_snapshots(judged):
    legs, samples = judged
    both = legs.filter(pl.col("source") == "both")
    assert both.height > 0
    averaged = samples.filter(pl.col("source") == "cpl")
    assert averaged["n_averaged"].is_between(45, 60).all()
    assert averaged["monitored"].any()
    assert (samples.filter(pl.col("source") == "acms")["n_averaged"] == 1).all()


def _altered(rows: pl.DataFrame, pack: int, **new: pl.Expr) -> pl.DataFrame:
    mine = (pl.col("pack") == pack) & (pl.col("source") == "acms")
    return rows.with_columns(
        pl.when(mine).then(value).otherwise(pl.col(name)).alias(name) for name, value in new.items()
    )


@pytest.mark.parametrize(
    ("new", "reason"),
    [
        ({"pack_flow_kg_s": pl.lit(0.7711)}, "SENSOR_FROZEN"),
        ({"hx_out_k": pl.when(pl.int_range(pl.len()) % 3 > 0).then("hx_out_k")}, "SENSOR_MISSING"),
        ({"pack_flow_kg_s": 0.001 * pl.col("pack_flow_kg_s")}, "PACK_OFF"),
        ({"ram_door_open": 0.4 + 0.01 * (pl.col("ram_door_open") - 0.3)}, "DOOR_STILL"),
        ({"altitude_m": 1_500.0 + 0.1 * pl.col("altitude_m")}, "NO_CRUISE"),
    ],
    ids=["frozen", "dropout", "pack off", "door still", "no cruise"],
)
def test_planted_fault_is_given_its_reason(one_tail, no_log, judged, new, reason):
    sound = judged[0].filter(pl.col("admitted").all().over("flight_id") & (pl.col("source") == "acms"))
    flight = sound["flight_id"][10]
    sick = _altered(one_tail.filter(pl.col("flight_id") == flight), 2, **new)
    rest = one_tail.filter(pl.col("flight_id") != flight)
    legs, _ = judge_legs(pl.concat([rest, sick]), *no_log)
    mine = legs.filter((pl.col("flight_id") == flight) & (pl.col("pack") == 2))
    assert mine["reason"].to_list() == [reason]


def test_nothing_in_nothing_out(one_tail, no_log):
    legs, samples = judge_legs(one_tail.clear(), *no_log)
    assert legs.is_empty()
    assert samples.is_empty()
    assert {"admitted", "reason", "n_nominal", "cruise_minutes"} <= set(legs.columns)


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


def reasons(no_log, *packs: pl.DataFrame) -> list[str]:
    return judge_legs(pl.concat(packs), *no_log)[0].sort("pack")["reason"].to_list()


def some(value: float, n: int, rest: float, rows: int = 12) -> list[float]:
    return [value] * n + [rest] * (rows - n)


def test_a_sound_cruise_is_admitted_with_its_figures(no_log):
    legs, samples = judge_legs(leg(), *no_log)
    row = legs.row(0, named=True)
    assert (row["reason"], row["admitted"], row["source"]) == ("", True, "acms")
    assert (row["n_samples"], row["n_snapshots"], row["n_monitored"], row["n_nominal"]) == (12, 12, 12, 12)
    assert row["cruise_minutes"] == 33.0
    assert samples["nominal"].all()


@pytest.mark.parametrize(("flow", "reason"), [(0.0999, "PACK_OFF"), (0.1, "NO_CRUISE"), (0.11, "")])
def test_a_pack_is_off_below_a_tenth(no_log, flow, reason):
    at_rest = [flow * (1.0 + 1e-7 * k) for k in range(12)]
    found = reasons(no_log, leg(pack_flow_kg_s=at_rest), leg(2))
    assert found == [reason if flow != 0.1 else "", "OTHER_PACK_OFF" if reason == "PACK_OFF" else ""]


@pytest.mark.parametrize(
    ("rows", "n", "missing"), [(24, 3, True), (20, 2, False), (26, 3, False), (25, 3, False), (17, 2, False)]
)
def test_a_fitted_sensor_misses_three_readings_and_12_per_cent(no_log, rows, n, missing):
    gaps = [None] * n + [335.0] * (rows - n)
    assert reasons(no_log, leg(rows=rows, ram_out_k=gaps)) == ["SENSOR_MISSING" if missing else ""]
    assert reasons(no_log, leg(rows=rows, ram_out_k=None), leg(2, rows=rows, ram_out_k=None)) == ["", ""]
    assert reasons(no_log, leg(rows=rows, ram_out_k=None), leg(2, rows=rows)) == ["SENSOR_MISSING", ""]


@pytest.mark.parametrize(
    ("tat_k", "altitude_m", "icing"),
    [(268.15, 6699.0, 1), (268.14, 6699.0, 0), (283.15, 6699.0, 1), (283.16, 6699.0, 0), (270.0, 6700.0, 0)],
)
def test_icing_is_wet_cold_air_below_22000_feet(no_log, tat_k, altitude_m, icing):
    found = reasons(no_log, leg(tat_k=tat_k, altitude_m=altitude_m))
    assert found == ["ICING" if icing else ""]


def test_two_nominal_samples_make_a_leg(no_log):
    for left, reason in ((2, ""), (1, "ICING")):
        assert reasons(no_log, leg(altitude_m=6000.0, tat_k=some(270.0, 12 - left, 250.0))) == [reason]
    for steady, reason in ((2, "NO_CRUISE"), (3, "")):
        height = [9000.0 + 200.0 * k for k in range(12 - steady)] + [11_500.0] * steady
        pa = {name: [42_000.0 - 700.0 * k for k in range(12)] for name in ("total_pressure_pa", "cc_in_pa")}
        assert reasons(no_log, leg(altitude_m=height, **pa)) == [reason]


@pytest.mark.parametrize(
    ("span", "rise_m", "rows", "still"),
    [
        (0.029, 4100.0, 12, True), (0.031, 4100.0, 12, False), (0.029, 3900.0, 12, False), (0.029, 4100.0, 7, False),
        (0.029, 4100.0, 8, True),
    ],
)  # fmt: skip
def test_a_door_that_follows_no_climb_is_jammed(no_log, span, rise_m, rows, still):
    door = [0.3 + span * (k % 2) for k in range(rows)]
    height = [11_000.0 - rise_m, 11_000.0 - rise_m / 2.0] + [11_000.0] * (rows - 2)
    pa = {name: [60_000.0, 47_000.0] + [FLOWN[name]] * (rows - 2) for name in ("total_pressure_pa", "cc_in_pa")}
    assert reasons(no_log, leg(rows=rows, ram_door_open=door, altitude_m=height, **pa)) == [
        "DOOR_STILL" if still else ""
    ]


def test_a_row_recorded_twice_counts_once_and_a_gap_is_not_monitored():
    twice = pl.concat([leg(), leg()])
    assert prepare_samples(twice).height == 12
    holed = prepare_samples(leg(hx_out_k=[None] + [296.0] * 11))
    assert holed["monitored"].to_list() == [False] + [True] * 11
    assert prepare_samples(leg(vda_counts=None))["monitored"].all()
