"""Views over small fleets made by hand, with answers that can be counted on fingers."""

import datetime as dt

import duckdb
import polars as pl
import pytest
from answers import CHECKS, rows
from scipy.stats import binomtest
from small_catalog import OWN, START, alert, catalog, fill, flight, fouling, message, replaced

from hdt_core.alerts.cases import UNOBSERVED
from hdt_core.components import component_rows
from hdt_core.records.unit_index import UTC, date_entries, number_units
from pipelines.storage.view_headers import views


def flights(n: int) -> list[dict]:
    return [flight(k) for k in range(n)]


def recovery(before: float, after: float, at: int = 50) -> list[dict]:
    """Health of a pack whose loss falls from one flight to the next."""
    return [fouling(k, before if k < at else after) for k in range(80)]


def test_lead_counts_from_units_first_alert():
    con = catalog(
        raw_flights=flights(60),
        raw_maintenance=[replaced(20)],
        raw_messages=[message(19), message(50), message(51), message(30, "21-51-CCFLOW")],
        features_alerts=[alert("old", 5, closed=21), alert("new", 40), alert("door", 41, component="RAM_DOOR")],
    )
    question = "select component, alert_id, lead_flights, n_messages from alert_lead_times order by message_time"
    leads = rows(con, question)
    assert leads == [("HX", "old", 14, 1), ("CC", None, None, 1), ("HX", "new", 10, 2)]


def test_alert_of_former_unit_leads_nothing():
    con = catalog(
        raw_flights=flights(60),
        raw_maintenance=[replaced(20)],
        raw_messages=[message(50)],
        features_alerts=[alert("old", 5, closed=21)],
    )
    assert rows(con, "select alert_id, lead_flights from alert_lead_times") == [(None, None)]


def judged_work(n: int, *, is_shown: bool, **more: object) -> dict:
    """A replacement without a finding, and the record's judgement of it."""
    work = replaced(n, None)
    verdict = {"verdict": "logged", "in_force": True, "position": 1, "is_shown": is_shown}
    return work | verdict | {"flown_from": work["counts_from"], "known_from": work["counts_from"]} | more


def ended(name: str, n: int, closed: int, reason: str = "renewed", **more: object) -> dict:
    return alert(name, n, closed, **more) | {"closed_reason": reason}


OUTCOMES = {
    "found": "found", "answered": "answered", "unseen": "not_yet_known", "told": "message", "late": "message",
    "clean": "no_fault_found", "gone": "recovered", "still": "open", "door": "recovered",
}  # fmt: skip


def judged_fleet() -> duckdb.DuckDBPyConnection:
    """One alert of each outcome: `late` closed by itself two days before its message."""
    judgements = [judged_work(30, is_shown=True), judged_work(40, is_shown=False)]
    return catalog(
        raw_flights=flights(120),
        raw_maintenance=[replaced(10), replaced(30, None), replaced(40, None), inspected(84)],
        features_work=judgements,
        raw_messages=[message(56), message(72)],
        features_alerts=[
            ended("found", 8, 11), ended("answered", 25, 31), ended("unseen", 35, 41),
            ended("told", 55, 57, "recovered"), ended("late", 65, 70, "recovered"),
            ended("clean", 80, 85, "found_clean"), ended("gone", 90, 95, "recovered"),
            ended("door", 101, 103, "recovered", component="RAM_DOOR"), alert("still", 100),
        ],
    )  # fmt: skip


def test_every_alert_has_one_outcome():
    outcomes = dict(rows(judged_fleet(), "select alert_id, outcome from alert_outcomes"))
    assert outcomes == OUTCOMES


def test_false_alarms_are_wrong_alerts():
    wrong = rows(judged_fleet(), "select alert_id, open_days from false_alarms order by alert_id")
    assert wrong == [("clean", 5.0), ("door", 2.0), ("gone", 5.0)]


def test_lead_times_need_messages():
    leads = rows(judged_fleet(), "select alert_id, lead_flights from alert_lead_times order by message_time")
    assert leads == [("told", 1)]  # the second message is of the same unit


def test_precision_has_both_measures():
    counts = "n_alerts, n_judged, n_right, n_message, n_open, n_unjudged"
    con = judged_fleet()
    (row,) = rows(con, f"select {counts} from alert_hit_rates where component = 'HX'")
    assert row == (8, 6, 4, 2, 1, 1)
    (ends,) = rows(con, "select columns('_rate$|_rate_') from alert_hit_rates where component = 'HX'")
    assert ends == pytest.approx((4 / 6, *proportion_interval(4, 6), 2 / 6, *proportion_interval(2, 6)), abs=1e-3)


def test_unlogged_recovery_answers_alert():
    con = catalog(twin_health=recovery(0.2, 0.01), features_alerts=[ended("a", 40, 65, "recovered")])
    assert rows(con, "select outcome from alert_outcomes") == [("answered",)]


def test_doubtful_sensor_explains_recovery():
    alerts = [ended("a", 40, 65, "recovered"), ended("s", 45, 55, "recovered", component="SENSOR")]
    con = catalog(twin_health=recovery(0.2, 0.01), features_alerts=alerts)
    assert rows(con, "select outcome from alert_outcomes order by 1") == [("not_yet_known",), ("recovered",)]


def proportion_interval(right: int, n: int) -> tuple[float, float]:
    """Wilson's interval of 90 %, as SciPy has it."""
    interval = binomtest(right, n).proportion_ci(0.9, "wilson")
    return interval.low, interval.high


def test_lives_have_their_slopes():
    first = [fouling(n, 0.002 * n) for n in range(40)]
    second = [fouling(40 + n, 0.004 * n) for n in range(40)]
    other = [fouling(n, 0.001 * n, tail="T-2") for n in range(40)]
    con = catalog(twin_health=first + second + other, raw_maintenance=[replaced(39)])
    question = "select tail, unit, n_flights, removed_on, fouling_per_100_flights from exchanger_lives order by 1, 2"
    lives = rows(con, question)
    day = (START + dt.timedelta(days=39)).date()
    assert [f[:4] for f in lives] == [("T-1", 0, 40, day), ("T-1", 1, 40, None), ("T-2", 0, 40, None)]
    assert [f[4] for f in lives] == pytest.approx([0.2, 0.4, 0.1])
    assert rows(con, "select tail, unit, round(above_fleet, 9) from fouling_fast") == [("T-1", 1, 0.2)]


@pytest.mark.parametrize(("hour", "unit"), [(None, 0), (5, 1), (7, 0)])
def test_views_number_units_as_core(hour, unit):
    """Flight 40 left at six on the day of the log; a day counts from its end, a time from itself."""
    at = None if hour is None else START.replace(hour=hour) + dt.timedelta(days=40)
    log = pl.DataFrame([replaced(40) | {"counts_from": at}], schema_overrides={"pack": pl.Int32, "counts_from": UTC})
    flown = [fouling(n, 0.01) for n in range(80)]
    con = catalog(twin_health=flown, raw_maintenance=date_entries(log).to_dicts())
    lives = rows(con, "select unit, n_flights from exchanger_lives order by unit")
    assert lives == [(0, 41 - unit), (1, 39 + unit)]
    flights = pl.DataFrame(flown).drop("unit").cast({"pack": pl.Int32, "departed_at": UTC})
    assert number_units(flights, log)["unit"].value_counts().sort("unit").rows() == lives


def test_work_is_compared_with_before():
    con = catalog(twin_health=recovery(0.4, 0.01), raw_maintenance=[replaced(52)])
    assert rows(con, "select before_work, after_work, round(moved_by, 9) from before_and_after") == [(0.4, 0.01, -0.39)]


def test_empty_catalog_answers():
    con = catalog()
    counts = {name: rows(con, f"select count(*)::int from {name}")[0][0] for name in views()}
    assert counts == dict.fromkeys(views(), 0) | {"start_here": 6}
    assert all(rows(con, sql) == [] for sql in CHECKS.values())


def test_some_statuses_are_not_observed():
    statuses = ("ok", "few_samples", "sensor_corrected", *UNOBSERVED)
    con = catalog(twin_health=[fouling(n, 0.1) | {"status": s} for n, s in enumerate(statuses)])
    assert {s for (s,) in rows(con, "select status from health_parameters where not is_observed")} == set(UNOBSERVED)


@pytest.mark.parametrize(
    ("after", "sd", "log", "n"),
    [
        (0.05, 0.01, [], 1),
        (0.151, 0.01, [], 0),  # less than a twentieth
        (0.15, 0.01, [], 1),
        (0.05, 0.036, [], 0),  # a difference of 2.9 standard deviations
        (0.05, 0.035, [], 1),
        (0.05, 0.01, [replaced(57)], 0),
        (0.05, 0.01, [replaced(58)], 1),  # entered for a later day than a week after
        (0.05, 0.01, [replaced(33)], 0),
        (0.05, 0.01, [replaced(32)], 1),
        (0.05, 0.01, [replaced(50, component="CC"), replaced(50) | {"pack": 2}], 1),
        (0.05, 0.01, [replaced(50) | {"action": "INSPECTED"}], 1),
    ],
)
def test_unlogged_recovery_is_listed_once(after, sd, log, n):
    con = catalog(twin_health=[f | {"sd": sd} for f in recovery(0.2, after)], raw_maintenance=log)
    expected = [("T-1", 1, "HX", flight(50)["flight_id"], 0.2, after)] * n
    assert rows(con, "select tail, pack, component, flight_id, loss_before, loss from unlogged_work") == expected


def test_sensor_health_counts_lost_values():
    def sample(k: int, value: float | None) -> dict:
        rest = {"source": "acms", "phase": "cruise", "nominal": True, "monitored": True, "n_averaged": 1, "file": "f"}
        at = {"time_utc": START + dt.timedelta(minutes=k), "hx_out_k": value}
        return OWN | {"flight_id": flight(0)["flight_id"]} | rest | at

    recorded = [sample(k, None if k < 2 else 300.0) for k in range(10)]
    left = [sample(k, None if k < 4 else 300.0) for k in range(10)]
    con = catalog(raw_snapshots=recorded, legs_samples=left)
    shares = rows(con, "select recorded_share, believed_share from sensor_health where signal = 'hx_out_k'")
    assert shares == [(0.8, 0.75)]
    assert rows(con, "select count(*), min(recorded_share) from sensor_health") == [(16, 0.0)]


def test_ranking_puts_urgent_units_first():
    health = [fouling(1, loss, tail=t) for t, loss in (("T-1", 0.1), ("T-2", 0.3), ("T-3", 0.2), ("T-4", 0.01))]
    prognosis = {
        "component": "HX", "rul_flights": 10.0, "rul_low": 1.0, "rul_high": 20.0, "model_version": "m",
        "split": "live",
    }  # fmt: skip
    outlook = [
        flight(1, tail=t) | prognosis | {"pack": 1, "p_event_50": p}
        for t, p in (("T-2", 0.05), ("T-3", 0.7), ("T-4", 0.01))
    ]
    con = catalog(twin_health=health, prognoses=outlook, features_alerts=[alert("a", 1) | {"severity": "high"}])
    ranking = rows(con, "select tail, urgency from fleet_ranking order by place")
    assert ranking == [("T-3", "act"), ("T-1", "act"), ("T-2", "none"), ("T-4", "none")]


def inspected(n: int, finding: str | None = "NO_FAULT_FOUND", **more: object) -> dict:
    return replaced(n, finding) | {"action": "INSPECTED", "reference": f"WO{n}"} | more


CLEAN = {"closed_reason": "found_clean"}


@pytest.mark.parametrize(
    ("work", "alerts", "credits"),
    [
        (
            [inspected(42)],
            {"old": alert("", 10, 30), "open": alert("", 38, 43) | CLEAN},
            {"old": ("recovered", None), "open": ("no_fault_found", "WO42")},
        ),
        (
            [inspected(42)],
            {"older": alert("", 10, 32), "last": alert("", 33, 38), "long": alert("", 5, 20)},
            {"older": ("recovered", None), "last": ("no_fault_found", "WO42"), "long": ("recovered", None)},
        ),
        ([replaced(30), inspected(40)], {"one": ended("", 10, 31)}, {"one": ("found", "WO30")}),
        (
            [inspected(42, "FOULED", closes_alert_id="mine")],
            {"mine": alert("", 38), "beside": alert("", 30)},
            {"mine": ("found", "WO42"), "beside": ("open", None)},
        ),
        (
            [inspected(30), replaced(33, "CLOGGED")],
            {"one": alert("", 10, 31) | CLEAN},
            {"one": ("found", "WO30, WO33")},
        ),
    ],
    ids=["open", "last closed", "closed by it", "named", "both"],
)
def test_work_is_credited_to_alert(work, alerts, credits):
    """That is open or closed last of its unit; not one that had closed twelve days before."""
    con = catalog(raw_maintenance=work, features_alerts=[a | {"alert_id": n} for n, a in alerts.items()])
    assert {n: of for n, *of in rows(con, "select alert_id, outcome, work_orders from alert_outcomes")} == {
        n: list(of) for n, of in credits.items()
    }


def test_hit_rate_follows_findings():
    closed_alerts = [alert(f"a{n}", 10 * n, 10 * n + 5) | {"closed_reason": "found_clean"} for n in range(1, 5)]
    work = [inspected(10 * n + 4, "FOULED" if n < 4 else "NO_FAULT_FOUND") for n in range(1, 5)]
    con = catalog(raw_maintenance=work, features_alerts=[*closed_alerts, alert("open", 59)])
    ((n, still, hits, misses, rate, low, high),) = rows(
        con,
        """select n_alerts, n_open, n_right, n_judged - n_right, hit_rate, hit_rate_low, hit_rate_high
        from alert_hit_rates""",
    )
    assert (n, still, hits, misses, rate) == (5, 1, 3, 1, 0.75)
    assert (low, high) == pytest.approx((0.356, 0.942), abs=1e-3), "Wilson's interval at 90 %"


def test_renewal_ends_contradiction_of_prognosis():
    """By an inspection that found nothing."""
    con = catalog(
        raw_flights=flights(60),
        twin_health=[fouling(n, 0.2) for n in range(60)],
        prognoses=[f | {"pack": 1, "component": "HX", "p_event_50": 0.9} for f in flights(60)],
        features_alerts=[alert("a", 10, 20) | CLEAN],
        raw_maintenance=[replaced(39)],
    )
    by_status = rows(con, "select status, count(*)::int from prognoses group by 1 order by 1")
    assert [f[:2] for f in by_status] == [("contradicted", 20), ("ok", 40)]
    assert rows(con, "select urgency from fleet_ranking") == [("act",)]
    con.execute("delete from tables.raw_maintenance")
    assert rows(con, "select urgency from fleet_ranking") == [("plan",)]


def routes_flown(**more: list[dict]) -> list[tuple]:
    """Thirty flights to the hot place gain 1 % each, thirty to the cold one nothing; a new exchanger in between."""
    hot = [flight(n) | {"origin": "AAAA", "destination": "HHHH"} for n in range(30)]
    cold = [flight(n) | {"origin": "AAAA", "destination": "CCCC"} for n in range(30, 60)]
    warm = {"tat_cruise_k": 291.0, "hx_margin_k": 5.0}
    cool = {"tat_cruise_k": 262.0, "hx_margin_k": 25.0}
    features = [f | warm | {"pack": 1, "hx_fouling": 0.01 * n} for n, f in enumerate(hot)]
    features += [f | cool | {"pack": 1, "hx_fouling": 0.0} for f in cold]
    con = catalog(raw_flights=[*hot, *cold], features=features, **more)
    columns = "destination, ambient_k, n_flights, round(gained_per_100_flights, 6), margin_k"
    return rows(con, f"select {columns} from routes order by destination")


ON_ROUTES = [("CCCC", 260.0, 30, 0.0, 25.0), ("HHHH", 290.0, 30, 1.0, 5.0)]


def test_routes_show_loss_by_air():
    assert routes_flown(raw_maintenance=[replaced(29)]) == ON_ROUTES


def test_late_logged_swap_is_no_gain():
    assert routes_flown(raw_maintenance=[replaced(35)]) == ON_ROUTES


def test_unlogged_swap_is_no_gain():
    assert routes_flown(twin_health=[fouling(n, 0.01 * n if n < 30 else 0.0) for n in range(60)]) == ON_ROUTES


@pytest.mark.parametrize("log", [[replaced(58)], []])
def test_comparison_ends_at_other_work(log):
    """Flight 56 has another unit, by the log later or not at all."""
    con = catalog(twin_health=recovery(0.4, 0.01, at=56), raw_maintenance=[inspected(49), *log])
    assert rows(con, "select after_work from before_and_after where reference = 'WO49'") == [(0.4,)]


PROGNOSIS = {"component": "HX", "rul_flights": 126.0, "rul_low": 9.0, "rul_high": 300.0, "p_event_50": 0.22, "pack": 1}


def unobserved(n: int, *, tail: str = "T-1") -> dict:
    return fouling(n, 0.15, tail=tail) | {"sd": 0.3, "status": "predicted"}


@pytest.fixture
def unknown_unit():
    """T-1 has shown nothing, T-2 little."""
    legs = [flight(n, tail=t) | {"pack": 1, "admitted": False, "reason": "NO_CRUISE", "n_samples": 9, "n_nominal": 0}
            for n in range(4) for t in ("T-1", "T-2")]  # fmt: skip
    return catalog(
        raw_flights=[flight(n, tail=t) for n in range(4) for t in ("T-1", "T-2")],
        legs_verdicts=legs,
        twin_health=[
            *(unobserved(n) for n in range(4)),
            *(unobserved(n, tail="T-2") | ({"status": "ok"} if n == 1 else {}) for n in range(4)),
        ],
        features=[flight(n) | {"pack": 1, "mach_lost_share": 1.0, "tat_k_lost_share": 0.1} for n in range(4)],
        prognoses=[flight(n, tail=t) | PROGNOSIS for n in range(4) for t in ("T-1", "T-2")],
    )


def test_missing_information_is_no_plan(unknown_unit):
    """What is believed of any unit ranks none."""
    columns = "tail, urgency, hx_fouling, rul_flights, p_event_50, missing_reason, missing_columns"
    assert rows(unknown_unit, f"select {columns} from fleet_ranking order by place") == [
        ("T-2", "plan", 0.15, 126.0, 0.22, None, None),
        ("T-1", "unknown", None, None, None, "NO_CRUISE", "mach"),
    ]


def test_prognosis_by_prior_has_status(unknown_unit):
    assert rows(unknown_unit, "select tail, status, count(*)::int from prognoses group by all order by all") == [
        ("T-1", "prior_only", 4), ("T-2", "ok", 3), ("T-2", "prior_only", 1)
    ]  # fmt: skip
    assert rows(unknown_unit, "select distinct rul_flights from prognoses") == [(126.0,)]  # an estimate all the same


@pytest.mark.parametrize("view", ["due_dates", "next_stop", "(from unit_rows where chance is not null)"])
def test_unknown_unit_has_no_date(unknown_unit, view):
    assert {tail for (tail,) in rows(unknown_unit, f"select distinct tail from {view}")} <= {"T-2"}


def test_health_by_prior_is_not_observed(unknown_unit):
    assert rows(unknown_unit, "select distinct is_observed from health_parameters where tail = 'T-1'") == [(False,)]


@pytest.mark.parametrize(("last", "ranked"), [("predicted", ("unknown", None)), ("ok", ("plan", 0.15))])
def test_new_unit_is_unknown(last, ranked):
    """Until it was observed: what was seen of the former one is not its own."""
    health = [*(fouling(n, 0.2) for n in range(3)), unobserved(3), unobserved(4), unobserved(5) | {"status": last}]
    con = catalog(twin_health=health, raw_maintenance=[replaced(2)], prognoses=[flight(5) | PROGNOSIS])
    assert rows(con, "select urgency, hx_fouling from fleet_ranking") == [ranked]


def test_unknown_unit_ranks_last():
    health = [fouling(1, 0.0, tail="T-9"), unobserved(1, tail="T-1")]
    con = catalog(twin_health=health, prognoses=[flight(1, tail="T-9") | PROGNOSIS | {"p_event_50": 0.01}])
    ranking = rows(con, "select tail, urgency from fleet_ranking order by place")
    assert ranking == [("T-9", "none"), ("T-1", "unknown")]


TAILS = ("T-1", "T-2", "T-3")
WORKED_ON = {
    "raw_flights": [flight(n, tail=t) for n in range(6) for t in TAILS],
    "twin_health": [fouling(n, 0.3, tail=t) for n in range(6) for t in TAILS],
    "prognoses": [flight(5, tail=t) | PROGNOSIS | {"p_event_50": 0.7} for t in TAILS],
    "raw_maintenance": [
        replaced(5) | {"action": "CLEANED", "tail": "T-1"},
        replaced(5) | {"tail": "T-2"},
        replaced(3) | {"tail": "T-3", "component": "CC"},
    ],
}
"""T-1 was washed and T-2's exchanger replaced after the last flight; of T-3 it was another component."""
RANKING = "select tail, urgency, hx_fouling, rul_flights, work_action from fleet_ranking order by tail"
UNTOUCHED = ("T-3", "act", 0.3, 126.0, None)


def test_work_after_last_flight_counts():
    washed = ("T-1", "none", None, None, "CLEANED")
    renewed = ("T-2", "none", None, None, "REPLACED")
    assert rows(catalog(**WORKED_ON), RANKING) == [washed, renewed, UNTOUCHED]


@pytest.mark.parametrize("view", ["due_dates", "next_stop"])
def test_work_after_last_flight_ends_dates(view):
    con = catalog(**WORKED_ON)
    assert {tail for (tail,) in rows(con, f"select distinct tail from {view}")} <= {"T-3"}


def test_flight_after_work_counts_again():
    later = {"raw_flights": flight(9), "twin_health": fouling(9, 0.02), "prognoses": flight(9) | PROGNOSIS}
    con = catalog(**WORKED_ON | {name: [*WORKED_ON[name], row] for name, row in later.items()})
    assert rows(con, RANKING)[::2] == [("T-1", "plan", 0.02, 126.0, None), UNTOUCHED]


def flown_with(*messages: int, n: int = 80, **tables: list[dict]) -> duckdb.DuckDBPyConnection:
    """Eighty flights of a pack, and messages on some of them."""
    flown = {"twin_health": [fouling(k, 0.01) for k in range(n)], "raw_flights": flights(n)}
    return catalog(**flown, raw_messages=[message(k) for k in messages], **tables)


@pytest.mark.parametrize(
    ("messages", "urgency", "is_listed"),
    [
        ((78, 79), "act", True),
        ((79,), "none", True),
        ((20,), "none", False),
        ((20, 21), "act", True),
        ((), "none", False),
    ],
    ids=["on two flights", "on one", "lapsed", "on two long ago", "none"],
)
def test_message_makes_pack_urgent(messages, urgency, is_listed):
    con = flown_with(*messages)

    ranked = rows(con, "select urgency, message_at is not null from fleet_ranking")

    assert ranked == [(urgency, is_listed)]


@pytest.mark.parametrize(
    ("after", "n_flights"),
    [((1.0, 1.1), 1), ((1.0, 23.9), 1), ((1.0, 25.0), 2), ((-30.0, -31.0), 2)],
    ids=["sent twice", "on the flight's day", "on two flights", "of flights not on record"],
)
def test_messages_without_flight_count_by_flight(after, n_flights):
    """Flights depart a day apart; hours after one are given."""
    first = flight(0)["departed_at"]
    sent = [message(0) | {"flight_id": None, "message_time": first + dt.timedelta(hours=h)} for h in after]
    con = flown_with(n=20)
    fill(con, raw_messages=sent)

    assert rows(con, "select n_flights from open_messages") == [(n_flights,)]


@pytest.mark.parametrize(
    ("messages", "shown"),
    [((70, 79), (None, None, 9)), ((79,), (126.0, 9.0, None))],
    ids=["that asks for work", "that is in doubt"],
)
def test_no_flights_left_to_message_come(messages, shown):
    con = flown_with(*messages, prognoses=[flight(79) | PROGNOSIS | {"p_event_50": 0.01}])

    assert rows(con, "select rul_flights, rul_low, came_flights_ago from unit_rows") == [shown]


def test_no_day_for_message_come():
    con = flown_with(70, 79, prognoses=[flight(79) | PROGNOSIS])

    assert rows(con, "select due_on, due_low_on, is_overdue from unit_rows") == [(None, None, False)]


def test_message_come_decides_component_shown():
    compressor = message(78, "21-51-CCFLOW"), message(79, "21-51-CCFLOW")
    likelier = [flight(79) | PROGNOSIS, flight(79) | PROGNOSIS | {"component": "CC", "p_event_50": 0.02}]
    con = flown_with(prognoses=likelier)
    fill(con, raw_messages=list(compressor))

    assert rows(con, "select outlook_component from unit_rows") == [("CC",)]


def test_alert_has_day_of_message_come():
    now = flight(79)
    raised = alert("open", 60) | {"now_flight_id": now["flight_id"]}
    con = flown_with(70, 79, prognoses=[now | PROGNOSIS], features_alerts=[raised])

    assert rows(con, "select now_rul_flights, now_came_flights_ago from alert_states") == [(None, 9)]


@pytest.mark.parametrize("work", [replaced(79), replaced(79, "NO_FAULT_FOUND") | {"action": "INSPECTED"}])
def test_work_answers_message(work):
    con = flown_with(77, 78, raw_maintenance=[work])

    assert rows(con, "select message_at from fleet_ranking") == [(None,)]


def test_single_message_with_alert_is_urgent():
    con = flown_with(79, features_alerts=[alert("open", 60)])

    assert rows(con, "select is_supported, is_pressing from open_messages") == [(True, True)]


def test_pack_is_off_since_first_flight():
    off = [
        flight(k) | {"pack": 1, "source": "acms", "reason": "PACK_OFF" if k in (3, 7, 8, 9) else ""} for k in range(10)
    ]
    con = flown_with(n=10, legs_verdicts=off)

    assert rows(con, "select off_since from fleet_ranking") == [(START + dt.timedelta(days=7),)]


def urgency_of(statuses: list[str]) -> str:
    """Urgency of a unit hardly surer than its prior, by the status of its flights."""
    con = catalog(
        twin_health=[fouling(k, 0.04) | {"sd": 0.036, "status": s} for k, s in enumerate(statuses)],
        raw_flights=flights(len(statuses)),
        components=[c | {"prior_sd": 0.066} for c in component_rows()],
    )
    ((urgency,),) = rows(con, "select urgency from fleet_ranking")
    return urgency


@pytest.mark.parametrize(("observed", "urgency"), [(1, "unknown"), (5, "none")])
def test_barely_observed_unit_is_unknown(observed, urgency):
    assert urgency_of(["ok"] * observed + ["predicted"] * (20 - observed)) == urgency


@pytest.mark.parametrize(("every", "urgency"), [(3, "unknown"), (2, "none")])
def test_sparse_rows_leave_unit_unknown(every, urgency):
    assert urgency_of(["predicted" if k % every else "few_samples" for k in range(30)]) == urgency


def test_unconfirmed_log_line_is_noted():
    line = replaced(40) | {"position": 1, "flown_from": START, "known_from": START, "verdict": "not_seen"}
    con = catalog(raw_maintenance=[replaced(40)], features_work=[line | {"in_force": False, "is_shown": False}])

    noted = rows(con, "select in_force, note from maintenance")

    assert noted == [(False, "replacement of 2024-04-10 not seen in the ten flights since")]
