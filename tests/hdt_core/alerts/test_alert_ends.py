"""An alert ends with its unit or by what an inspection finds, says what was true when raised and now."""

from datetime import UTC, datetime, timedelta
from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, START, alerts, departure, features, work, work_before

from hdt_core.alerts.alerts import Trial, trials
from hdt_core.alerts.answers import alerts_now
from hdt_core.alerts.cases import Case, Grid
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.endings import close_after_work
from hdt_core.alerts.evidence import ROLES
from hdt_core.records.unit_index import date_entries
from hdt_core.tables.raw import RawMaintenance

NOTHING = work(START).clear()
NO_LOG = RawMaintenance.create_empty()
FLIGHT = np.arange(FLIGHTS)
FOULING = features(np.linspace(0.0, 0.35, FLIGHTS))
"""A pack that loses 35 per cent over its flights."""


def closings(cases: pl.DataFrame) -> list[tuple[datetime | None, str | None]]:
    """When and why each alert ended."""
    return cases.select("closed_at", "closed_reason").rows()


@pytest.mark.parametrize("late", range(6))
@pytest.mark.parametrize("timed", [False, True])
def test_work_closes_alert_at_next_flight(late: int, timed: bool):
    """However late the log is, and even where the track goes on as if nothing had happened."""
    done = departure(60 + late) - timedelta(minutes=5)
    (alert,) = alerts(FOULING, work(done, timed=timed)).head(1).to_dicts()
    ends = done if timed else datetime(done.year, done.month, done.day, tzinfo=UTC) + timedelta(days=1)
    before = pl.col("departed_at") < ends
    assert alert["raised_at"] < done
    assert alert["closed_at"] == FOULING.filter(~before)["departed_at"][0]
    assert alert["now_flight_id"] == FOULING.filter(before)["flight_id"][-1]


AFTER_LAST = [departure(FLIGHTS - 1) + timedelta(days=days, hours=1) for days in (0, 3)]


@pytest.mark.parametrize("done", AFTER_LAST)
def test_work_after_last_flight_closes_alert(done: datetime):
    cases = alerts(FOULING, work(done, timed=True))
    assert cases.select("closed_at", "now_flight_id").rows() == [(done, FOULING["flight_id"][-1])]


@pytest.mark.parametrize("done", AFTER_LAST)
def test_other_packs_flights_keep_closing_time(done: datetime):
    busier = features(np.zeros(FLIGHTS + 5)).with_columns(pl.lit(2, pl.Int32).alias("pack"))
    both = pl.concat([FOULING, busier], how="diagonal")
    assert alerts(both, work(done, timed=True))["closed_at"].to_list() == [done]


def test_other_components_work_closes_nothing():
    assert alerts(FOULING, work(departure(FLIGHTS), "CC"))["closed_at"].to_list() == [None]


def test_new_unit_has_own_alert():
    """A clog's case is not carried on by the loss of the unit that came after it."""
    loss = np.where(FLIGHT < 40, 0.03, np.where(FLIGHT < 52, 0.28, 0.012 * np.maximum(FLIGHT - 52, 0)))
    out = alerts(features(loss), work_before(52))
    assert out.select("diagnosis", "closed_at").rows() == [("HX_SUDDEN_CLOG", departure(52)), ("HX_FOULING", None)]


def test_busier_aircraft_changes_no_alert():
    """A belief held at a pack's last flight raises no case on flights that only the other aircraft flew."""
    alone = np.concatenate([np.zeros(40), np.full(40, 0.3)])
    rows = features(np.zeros(80), hx_fouling_flight=alone).with_columns(hx_fouling_step_3=pl.lit(-0.2))
    busier = FOULING.with_columns(tail=pl.lit("T-BBB"))
    both = alerts(pl.concat([rows, busier], how="diagonal"), NOTHING)
    assert both.equals(pl.concat([alerts(rows, NOTHING), alerts(busier, NOTHING)]))


@pytest.mark.parametrize("code", DIAGNOSES)
def test_diagnosis_ends_with_own_component(code: str):
    own = DIAGNOSES[code].component
    grid = Grid.from_frame(features(np.zeros(FLIGHTS)))
    for component in ("HX", "CC", "RAM_DOOR", "SENSOR"):
        for action in ("REPLACED", "INSPECTED"):
            case = Case(0, own, code, 30, None)
            close_after_work(grid, work(departure(50), component, action, timed=True), [case])
            assert case.closed_flight == (50 if component == own and action == "REPLACED" else None)


def test_evidence_separates_raising_from_now():
    rows = features(np.linspace(0.0, 0.35, FLIGHTS), door_full_open_share=np.linspace(0.0, 0.4, FLIGHTS) ** 2)
    (alert,) = alerts(rows, NOTHING).to_dicts()
    raised = 100 * rows.filter(flight_id=alert["raised_flight_id"])["hx_fouling"].item()
    assert f"Heat transfer lost (hx_fouling) {raised:.0f} % ({raised - 1.6:.0f} to" in alert["evidence"]
    assert "Heat transfer lost (hx_fouling) 35 % (33 to 37)" in alert["evidence_now"]
    assert (alert["raised_severity"], alert["severity"]) == ("medium", "high")
    assert alert["now_flight_id"] == rows["flight_id"][-1]


def test_later_flights_keep_raised_evidence():
    stays = ["alert_id", "raised_at", "raised_severity", "evidence", "recommended_action"]
    whole, part = (alerts(rows, NOTHING).select(stays) for rows in (FOULING, FOULING.head(70)))
    assert part.equals(whole)


def role(text: str, phrase: str) -> str:
    """Role under which a paragraph of evidence tells of something."""
    before = text.partition(phrase)[0]
    return max((r for r in ROLES if f"{r}:" in before), key=lambda r: before.rfind(f"{r}:"))


def test_clog_with_ram_flow_is_contested():
    loss = np.where(FLIGHT < 60, 0.03, 0.3)
    (alert,) = alerts(features(loss, ram_flow_loss=0.0), NOTHING).to_dicts()
    assert alert["diagnosis"] == "HX_SUDDEN_CLOG"
    assert role(alert["evidence"], "no blockage") == "Against"


def test_diagnoses_name_their_task():
    assert all(d.code == code and d.name and "ATA 21-" in d.action for code, d in DIAGNOSES.items())


THREE_PACKS = pl.concat(
    features(np.linspace(0.0, most, FLIGHTS)).with_columns(tail=pl.lit(f"T-{k}"))
    for k, most in enumerate((0.12, 0.18, 0.35))
)
"""Packs that lose 12, 18 and 35 per cent over their flights."""


@pytest.fixture(scope="module")
def limit_trials() -> list[Trial]:
    """Alerts of three packs by each limit tried."""
    return list(trials(THREE_PACKS, NOTHING))


@pytest.fixture(scope="module")
def fouling_trials(limit_trials: list[Trial]) -> list[Trial]:
    """Those by each limit of fouling."""
    return [t for t in limit_trials if t.diagnosis == "HX_FOULING"]


TRIED = {code: kind.limit_values for code, kind in DIAGNOSES.items() if kind.limit_values}


def test_tried_limits_are_as_declared():
    assert TRIED == {
        "HX_FOULING": (0.10, 0.125, 0.15, 0.20, 0.25),
        "HX_SUDDEN_CLOG": (0.07, 0.10, 0.15, 0.20),
        "HX_LOW_MARGIN": (0.70, 0.80, 0.90, 0.95, 0.98),
        "CC_DEGRADED": (0.03, 0.04, 0.05, 0.07),
        "RAM_DOOR_FAULT": (0.9, 1.3, 1.8, 2.5),
    }


def test_limit_in_service_raises_same_alerts(limit_trials: list[Trial]):
    in_service = {t.diagnosis: t.alerts for t in limit_trials if t.in_service}
    expected = alerts(THREE_PACKS, NOTHING).sort("alert_id")
    assert set(in_service) == set(TRIED)
    assert all(in_service[code].sort("alert_id").equals(expected) for code in set(TRIED) - {"RAM_DOOR_FAULT"})


def test_lower_limit_raises_more_alerts(fouling_trials: list[Trial]):
    limits = [t.value for t in fouling_trials]
    packs = [set(t.alerts["tail"]) for t in fouling_trials]
    assert limits == sorted(limits)
    assert all(later <= earlier for earlier, later in pairwise(packs))
    assert len(packs[-1]) < len(packs[0])


def test_lower_limit_raises_earlier(fouling_trials: list[Trial]):
    raised = [t.alerts.filter(tail="T-2")["raised_at"].min() for t in fouling_trials]
    assert raised == sorted(raised)


LOOKED_AFTER = 60
"""Flights before an inspection."""
LOSS_THEN = 0.2 * 59 / 60
"""The loss that it looks at."""


def inspection(at: int = LOOKED_AFTER, finding: str | None = "NO_FAULT_FOUND", **more: object) -> pl.DataFrame:
    """An inspection of the exchanger just before a flight."""
    entry = work_before(at, action="INSPECTED")
    return entry.with_columns(pl.lit(finding).alias("finding"), *(pl.lit(v).alias(k) for k, v in more.items()))


def loss_growing_by(after: float) -> np.ndarray:
    """A loss that rises to 0.2 until the inspection, and by `after` in the flights that follow."""
    later = 0.2 + after * (FLIGHT - LOOKED_AFTER) / (FLIGHTS - 60)
    return np.where(FLIGHT < LOOKED_AFTER, 0.2 * FLIGHT / LOOKED_AFTER, later)


@pytest.mark.parametrize(
    ("at", "closed_at"),
    [(LOOKED_AFTER, departure(LOOKED_AFTER)), (FLIGHTS, departure(FLIGHTS) - timedelta(minutes=5))],
    ids=["before a flight", "after the last"],
)
def test_clean_finding_closes_alert(at: int, closed_at: datetime):
    """At once, and for as long as the loss stays."""
    assert closings(alerts(features(loss_growing_by(0.0)), inspection(at))) == [(closed_at, "found_clean")]


def test_clean_finding_changes_closing_only():
    rows = features(loss_growing_by(0.1)).head(LOOKED_AFTER)
    inspected, other = (alerts(rows, log).drop("closed_at", "closed_reason") for log in (inspection(), NOTHING))
    assert inspected.equals(other)


@pytest.fixture(scope="module")
def contradiction() -> list[dict[str, object]]:
    """Cases of a loss that grows on after a clean finding."""
    return alerts(features(loss_growing_by(0.1)), inspection()).to_dicts()


def test_growing_loss_returns_as_sensor_fault(contradiction: list[dict[str, object]]):
    first, second = contradiction
    expected = {
        "diagnosis": "SENSOR_FAULT", "component": "SENSOR", "follows": first["alert_id"], "closed_at": None,
        "severity": "medium",
    }  # fmt: skip
    assert (first["diagnosis"], first["closed_reason"]) == ("HX_FOULING", "found_clean")
    assert {name: second[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("column", "words"),
    [
        ("evidence", f"found clean on {departure(LOOKED_AFTER).date()}"), ("evidence", "check the sensors"),
        ("recommended_action", "neither wash nor new part yet"),
    ],
)  # fmt: skip
def test_contradiction_asks_for_sensor_check(contradiction, column: str, words: str):
    assert words in contradiction[1][column]


def test_growing_spell_is_one_case():
    cases = alerts(features(loss_growing_by(0.25)), inspection())
    assert cases["diagnosis"].to_list() == ["HX_FOULING", "SENSOR_FAULT"]


def test_growth_by_limit_is_wear():
    """After a gap in which the belief ends, and comes back higher."""
    loss = np.where((FLIGHT > LOOKED_AFTER) & (FLIGHT < LOOKED_AFTER + 30), 0.0, loss_growing_by(0.25))
    cases = alerts(features(loss).with_columns(hx_fouling_step_3=pl.lit(0.0)), inspection())
    assert cases["diagnosis"].to_list().count("HX_FOULING") == 2


@pytest.mark.parametrize(("growth", "n_contradictions"), [(0.031, 1), (0.029, 0)])
def test_three_points_contradict_inspection(growth: float, n_contradictions: int):
    """On three flights of four."""
    cases = alerts(
        features(np.where(FLIGHT < LOOKED_AFTER + 5, loss_growing_by(0.0), LOSS_THEN + growth)), inspection()
    )
    assert cases["diagnosis"].to_list() == ["HX_FOULING"] + ["SENSOR_FAULT"] * n_contradictions
    assert cases["raised_at"].to_list()[1:] == [departure(LOOKED_AFTER + 7)] * n_contradictions
    words = "at a loss of 20 %, and the loss has grown to 23 %"
    assert all(words in text for text in cases["evidence_now"].to_list()[1:])


@pytest.mark.parametrize(("after", "closing"), [(0.0149, (departure(84), "recovered")), (0.0151, (None, None))])
def test_contradiction_recovers_below_half(after: float, closing: tuple):
    """A contradiction lasts fifteen flights after the loss was last above half of the three points."""
    loss = np.where(FLIGHT < 65, loss_growing_by(0.0), np.where(FLIGHT < 70, 0.25, LOSS_THEN + after))
    assert closings(alerts(features(loss), inspection()))[1] == closing


@pytest.mark.parametrize(("growth", "wear"), [(0.151, True), (0.149, False)])
def test_wear_returns_above_whole_limit(growth: float, wear: bool):
    loss = np.where(FLIGHT < LOOKED_AFTER, loss_growing_by(0.0), np.where(FLIGHT < 80, 0.0, LOSS_THEN + growth))
    cases = alerts(features(loss).with_columns(hx_fouling_step_3=pl.lit(0.0)), inspection())
    assert ("HX_FOULING" in cases["diagnosis"].to_list()[1:]) is wear


@pytest.mark.parametrize("finding", [None, "FOULED"])
def test_other_findings_close_nothing(finding: str | None):
    assert closings(alerts(features(loss_growing_by(0.1)), inspection(finding=finding))) == [(None, None)]


@pytest.mark.parametrize("component", ["HX", "SENSOR"])
def test_renewal_closes_sensor_case(component: str):
    loss = np.where((component == "HX") & (FLIGHT >= 90), 0.0, loss_growing_by(0.1))
    cases = alerts(features(loss), pl.concat([inspection(), work_before(90, component)], how="diagonal"))
    assert closings(cases) == [(departure(LOOKED_AFTER), "found_clean"), (departure(90), "renewed")]


def test_next_unit_wears_by_itself():
    log = pl.concat([inspection(), work_before(80), work_before(95)])
    loss = loss_growing_by(0.0) + np.where(FLIGHT < 85, 0.0, 0.05)
    assert alerts(features(loss), log)["diagnosis"].to_list() == ["HX_FOULING"] * 2


LOW_MARGIN = features(np.full(FLIGHTS, 0.05), hx_passage_300=np.full(FLIGHTS, 0.99), hx_margin_k=np.full(FLIGHTS, 1.0))


def test_clean_finding_leaves_low_margin():
    """Little margin is not what an exchanger's inspection is about."""
    cases = alerts(LOW_MARGIN, inspection())
    assert cases.select("diagnosis", "closed_at").rows() == [("HX_LOW_MARGIN", None)]


def test_named_closing_ends_low_margin():
    """An engineer says so of that very alert, though its id is another since."""
    closed = {"closes_alert_id": "another id", "closes_diagnosis": "HX_LOW_MARGIN", "closes_sensor": None}
    assert alerts(LOW_MARGIN, inspection(**closed))["closed_reason"].to_list() == ["found_clean"]


LATE_WEAR = features(0.01 + 0.005 * np.maximum(np.arange(4 * 110) - 4 * 98, 0))
"""Four flights a day from day 0 on; the alert is raised on day 100 or so."""


@pytest.mark.parametrize(("days", "units"), [((30, 60), 3), ((1, 60), 2), ((60,), 2), ((), 1)])
def test_third_unit_asks_for_cause(days: tuple[int, ...], units: int):
    log = pl.concat([NOTHING, *(work(departure(4 * day), timed=True) for day in days)])
    (alert,) = alerts(LATE_WEAR, log).to_dicts()
    assert alert["units_in_90_days"] == units
    assert alert["recommended_action"].startswith("Find the cause upstream") == (units >= 3)


@pytest.mark.parametrize(("late_s", "units"), [(0, 2), (1, 3)])
def test_units_count_over_ninety_days(late_s: int, units: int):
    raised = alerts(LATE_WEAR, NOTHING)["raised_at"][0]
    log = [work(raised - timedelta(days=90, seconds=-late_s), timed=True), work(departure(4 * 60), timed=True)]
    assert alerts(LATE_WEAR, pl.concat(log))["units_in_90_days"].to_list() == [units]


def test_later_units_do_not_count():
    log = pl.concat([work(departure(4 * day), timed=True) for day in (60, 108)])
    assert alerts(LATE_WEAR, log).select("closed_reason", "units_in_90_days").rows() == [("renewed", 2)]


@pytest.fixture(scope="module")
def open_alert() -> pl.DataFrame:
    """One alert of a night without work."""
    return alerts(FOULING, NOTHING).head(1)


def since_night(*moments: datetime, pack: int = 1) -> pl.DataFrame:
    """Replacements that the night did not have."""
    log = RawMaintenance.conform(pl.concat([work(moment, timed=True) for moment in moments]))
    return date_entries(log).with_columns(pack=pl.lit(pack, log.schema["pack"]), since_night=pl.lit(True))


@pytest.mark.parametrize(("late_s", "is_closed"), [(0, False), (1, True)])
def test_only_later_work_closes_alert(open_alert: pl.DataFrame, late_s: int, is_closed: bool):
    done = open_alert["raised_at"][0] + timedelta(seconds=late_s)

    alert = alerts_now(open_alert, NO_LOG, since_night(done))

    assert alert["closed_at"].is_not_null().to_list() == [is_closed]


def test_first_later_work_closes_alert(open_alert: pl.DataFrame):
    first = open_alert["raised_at"][0] + timedelta(days=1)

    alert = alerts_now(open_alert, NO_LOG, since_night(first + timedelta(days=1), first))

    assert alert["closed_at"].to_list() == [first]


def test_later_work_keeps_closing_time(open_alert: pl.DataFrame):
    end = open_alert["raised_at"][0] + timedelta(days=1)
    ended = open_alert.with_columns(closed_at=pl.lit(end, open_alert.schema["closed_at"]))

    alert = alerts_now(ended, NO_LOG, since_night(end + timedelta(days=1)))

    assert alert["closed_at"].to_list() == [end]


def test_other_pack_work_closes_nothing(open_alert: pl.DataFrame):
    done = open_alert["raised_at"][0] + timedelta(days=1)

    alert = alerts_now(open_alert, NO_LOG, since_night(done, pack=2))

    assert alert["closed_at"].to_list() == [None]
