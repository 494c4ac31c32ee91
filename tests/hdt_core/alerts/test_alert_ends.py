"""An alert ends with its unit or by what an inspection finds, says what was true when raised and now."""

from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, START, alerts, departure, features, work

from hdt_core.alerts.alerts import VALUES, trials
from hdt_core.alerts.answers import alerts_now
from hdt_core.alerts.cases import Case, Grid
from hdt_core.alerts.diagnoses import DIAGNOSES, close_after_work
from hdt_core.alerts.evidence import ROLES
from hdt_core.records.unit_index import date_entries
from hdt_core.tables.features import FeaturesAlerts
from hdt_core.tables.raw import RawMaintenance

NOTHING = work(START).clear()
NO_LOG = RawMaintenance.create_empty()


@pytest.mark.parametrize("late", range(6))
@pytest.mark.parametrize("timed", [False, True])
def test_work_closes_alert_at_next_flight(late: int, timed: bool) -> None:
    """Even where the track goes on as if nothing had happened."""
    rows = features(np.linspace(0.0, 0.35, FLIGHTS))
    done = departure(60 + late) - timedelta(minutes=5)
    (alert,) = alerts(rows, work(done, timed=timed)).head(1).to_dicts()
    ends = done if timed else datetime(done.year, done.month, done.day, tzinfo=UTC) + timedelta(days=1)
    assert alert["raised_at"] < done
    assert alert["closed_at"] == rows.filter(pl.col("departed_at") >= ends)["departed_at"][0]
    last = rows.filter(pl.col("departed_at") < ends)["flight_id"][-1]
    assert alert["now_flight_id"] == last


def test_work_after_last_flight_closes_alert() -> None:
    rows = features(np.linspace(0.0, 0.35, FLIGHTS))
    for days in (0, 3):
        done = departure(FLIGHTS - 1) + timedelta(days=days, hours=1)
        (alert,) = alerts(rows, work(done, timed=True)).to_dicts()
        assert alert["closed_at"] == done
        assert alert["now_flight_id"] == rows["flight_id"][-1]
        busier = features(np.zeros(FLIGHTS + 5)).with_columns(pl.lit(2, pl.Int32).alias("pack"))
        both = pl.concat([rows, busier], how="diagonal")
        assert alerts(both, work(done, timed=True))["closed_at"].to_list() == [done], "beside a pack that flew on"
    assert alerts(rows, work(departure(FLIGHTS), "CC"))["closed_at"].to_list() == [None], "another component's work"


def test_new_unit_has_own_alert() -> None:
    """A clog's case is not carried on by the loss of the unit that came after it."""
    flight = np.arange(FLIGHTS)
    loss = np.where(flight < 40, 0.03, np.where(flight < 52, 0.28, 0.012 * np.maximum(flight - 52, 0)))
    out = alerts(features(loss), work(departure(52) - timedelta(minutes=5), timed=True))
    assert out["diagnosis"].to_list() == ["HX_SUDDEN_CLOG", "HX_FOULING"]
    assert out["closed_at"].to_list() == [departure(52), None]
    # A belief held at a pack's last flight raises no case on flights that only the other aircraft flew.
    alone = np.concatenate([np.zeros(40), np.full(40, 0.3)])
    rows = features(np.zeros(80), hx_fouling_flight=alone).with_columns(hx_fouling_step_3=pl.lit(-0.2))
    busier = features(np.linspace(0.0, 0.35, FLIGHTS)).with_columns(tail=pl.lit("T-BBB"))
    both = alerts(pl.concat([rows, busier], how="diagonal"), NOTHING)
    assert both.equals(pl.concat([alerts(rows, NOTHING), alerts(busier, NOTHING)]))


@pytest.mark.parametrize("code", DIAGNOSES)
def test_diagnosis_ends_with_own_component(code: str) -> None:
    diagnosis, grid = DIAGNOSES[code], Grid.from_frame(features(np.zeros(FLIGHTS)))
    for component in ("HX", "CC", "RAM_DOOR", "SENSOR"):
        for action in ("REPLACED", "INSPECTED"):
            case = Case(0, diagnosis.component, code, 30, None)
            entry = work(departure(50), component, action, timed=True)
            close_after_work(grid, entry, [case])
            assert case.closed_flight == (50 if component == diagnosis.component and action == "REPLACED" else None)


def test_raised_evidence_stays_as_written() -> None:
    rows = features(np.linspace(0.0, 0.35, FLIGHTS), door_full_open_share=np.linspace(0.0, 0.4, FLIGHTS) ** 2)
    (alert,) = alerts(rows, NOTHING).to_dicts()
    raised = rows.filter(flight_id=alert["raised_flight_id"])["hx_fouling"].item()
    assert f"Heat transfer lost (hx_fouling) {100 * raised:.0f} % ({100 * raised - 1.6:.0f} to" in alert["evidence"]
    assert "Heat transfer lost (hx_fouling) 35 % (33 to 37)" in alert["evidence_now"]
    assert (alert["raised_severity"], alert["severity"]) == ("medium", "high")
    assert alert["now_flight_id"] == rows["flight_id"][-1]
    rows = features(np.linspace(0.0, 0.35, FLIGHTS))
    whole, part = alerts(rows, NOTHING), alerts(rows.head(70), NOTHING)
    stays = ["alert_id", "raised_at", "raised_severity", "evidence", "recommended_action"]
    assert part.select(stays).equals(whole.select(stays))


def role(text: str, phrase: str) -> str:
    """Role under which a paragraph of evidence tells of something."""
    before = text.partition(phrase)[0]
    return max((r for r in ROLES if f"{r}:" in before), key=lambda r: before.rfind(f"{r}:"))


def test_clog_with_ram_flow_is_contested() -> None:
    loss = np.where(np.arange(FLIGHTS) < 60, 0.03, 0.3)
    (alert,) = alerts(features(loss, ram_flow_loss=0.0), NOTHING).to_dicts()
    assert alert["diagnosis"] == "HX_SUDDEN_CLOG"
    assert role(alert["evidence"], "no blockage") == "Against"


def test_diagnoses_are_listed_everywhere() -> None:
    declared = set(DIAGNOSES)
    listed = str((FeaturesAlerts.columns()["diagnosis"].metadata or {})["meaning"])
    check = (Path(__file__).parents[3] / "sql/checks/alerts_in_disorder.sql").read_text()
    assert all(code in listed and f"'{code}'" in check for code in declared)
    assert all(d.code == code and d.name and "ATA 21-" in d.action for code, d in DIAGNOSES.items())


def three_packs() -> pl.DataFrame:
    """Packs that lose 12, 18 and 35 per cent over their flights."""
    worn = (features(np.linspace(0.0, most, FLIGHTS)) for most in (0.12, 0.18, 0.35))
    return pl.concat(f.with_columns(tail=pl.lit(f"T-{k}")) for k, f in enumerate(worn))


def test_lower_limit_raises_more_alerts() -> None:
    rows = three_packs()
    in_service = {t.diagnosis: t.alerts for t in trials(rows, NOTHING) if t.in_service}
    assert set(in_service) == set(VALUES)
    assert [values for _, values in VALUES.values()] == [
        (0.10, 0.125, 0.15, 0.20, 0.25), (0.07, 0.10, 0.15, 0.20), (0.70, 0.80, 0.90, 0.95, 0.98),
        (0.03, 0.04, 0.05, 0.07), (0.9, 1.3, 1.8, 2.5),
    ]  # fmt: skip
    for diagnosis in set(VALUES) - {"RAM_DOOR_FAULT"}:
        assert in_service[diagnosis].sort("alert_id").equals(alerts(rows, NOTHING).sort("alert_id"))
    limits = [t for t in trials(three_packs(), NOTHING) if t.diagnosis == "HX_FOULING"]
    assert [t.value for t in limits] == sorted(t.value for t in limits)
    packs = [set(t.alerts["tail"]) for t in limits]
    assert all(later <= earlier for earlier, later in pairwise(packs))
    raised = [t.alerts.filter(tail="T-2")["raised_at"].min() for t in limits]
    assert raised == sorted(raised)
    assert len(packs[-1]) < len(packs[0])


LOOKED_AFTER, LOSS_THEN = 60, 0.2 * 59 / 60
"""Flights before an inspection, and the loss that it looks at."""


def inspection(at: int = LOOKED_AFTER, finding: str | None = "NO_FAULT_FOUND", **more: object) -> pl.DataFrame:
    """An inspection of the exchanger just before a flight."""
    entry = work(departure(at) - timedelta(minutes=5), action="INSPECTED", timed=True)
    return entry.with_columns(pl.lit(finding).alias("finding"), *(pl.lit(v).alias(k) for k, v in more.items()))


def worn(after: float) -> np.ndarray:
    """A loss that rises to 0.2 until the inspection, and by `after` in the flights that follow."""
    flight = np.arange(FLIGHTS)
    later = 0.2 + after * (flight - LOOKED_AFTER) / (FLIGHTS - 60)
    return np.where(flight < LOOKED_AFTER, 0.2 * flight / LOOKED_AFTER, later)


def test_clean_finding_closes_alert() -> None:
    (alert,) = alerts(features(worn(0.0)), inspection()).to_dicts()
    assert (alert["closed_at"], alert["closed_reason"]) == (departure(LOOKED_AFTER), "found_clean")
    (alert,) = alerts(features(worn(0.0)), inspection(FLIGHTS)).to_dicts()
    assert (alert["closed_at"], alert["closed_reason"]) == (departure(FLIGHTS) - timedelta(minutes=5), "found_clean")
    rows = features(worn(0.1))
    with_it, without = (alerts(rows.head(LOOKED_AFTER), m) for m in (inspection(), inspection().clear()))
    assert with_it.drop("closed_at", "closed_reason").equals(without.drop("closed_at", "closed_reason"))


def test_growing_loss_returns_as_sensor_fault() -> None:
    first, second = alerts(features(worn(0.1)), inspection()).to_dicts()
    assert (first["diagnosis"], first["closed_reason"]) == ("HX_FOULING", "found_clean")
    assert second["diagnosis"] == "SENSOR_FAULT"
    assert second["component"] == "SENSOR"
    assert second["follows"] == first["alert_id"]
    assert second["closed_at"] is None
    assert second["severity"] == "medium"
    assert f"found clean on {departure(LOOKED_AFTER).date()}" in second["evidence"]
    assert "check the sensors" in second["evidence"]
    assert "neither wash nor new part yet" in second["recommended_action"]


def test_growth_by_limit_is_wear() -> None:
    cases = alerts(features(worn(0.25)), inspection())
    assert cases["diagnosis"].to_list() == ["HX_FOULING", "SENSOR_FAULT"], "one spell is told once"
    gap = worn(0.25)
    gap[LOOKED_AFTER + 1 : LOOKED_AFTER + 20] = 0.0  # the belief ends, and comes back higher
    cases = alerts(features(gap), inspection())
    assert cases["diagnosis"].to_list()[0] == "HX_FOULING"


@pytest.mark.parametrize(("growth", "back"), [(0.031, True), (0.029, False)])
def test_three_points_contradict_inspection(growth: float, back: bool) -> None:
    loss = np.where(np.arange(FLIGHTS) < LOOKED_AFTER + 5, worn(0.0), LOSS_THEN + growth)
    cases = alerts(features(loss), inspection())
    assert cases["diagnosis"].to_list() == ["HX_FOULING"] + ["SENSOR_FAULT"] * back
    if back:
        assert cases["raised_at"].to_list()[1] == departure(LOOKED_AFTER + 7)
        assert "at a loss of 20 %, and the loss has grown to 23 %" in cases["evidence_now"].to_list()[1]


@pytest.mark.parametrize(("after", "stays"), [(0.0149, False), (0.0151, True)])
def test_contradiction_recovers_below_half(after: float, stays: bool) -> None:
    """A contradiction lasts fifteen flights after the loss was last above half of the three points."""
    flight = np.arange(FLIGHTS)
    loss = np.where(flight < 65, worn(0.0), np.where(flight < 70, 0.25, LOSS_THEN + after))
    second = alerts(features(loss), inspection()).row(1, named=True)
    assert (second["closed_at"], second["closed_reason"]) == ((None, None) if stays else (departure(84), "recovered"))


@pytest.mark.parametrize(("growth", "wear"), [(0.151, True), (0.149, False)])
def test_wear_returns_above_whole_limit(growth: float, wear: bool) -> None:
    flight = np.arange(FLIGHTS)
    loss = np.where(flight < LOOKED_AFTER, worn(0.0), np.where(flight < 80, 0.0, LOSS_THEN + growth))
    cases = alerts(features(loss).with_columns(hx_fouling_step_3=pl.lit(0.0)), inspection())
    assert ("HX_FOULING" in cases["diagnosis"].to_list()[1:]) is wear


@pytest.mark.parametrize("finding", [None, "FOULED"])
def test_other_findings_close_nothing(finding: str | None) -> None:
    (alert,) = alerts(features(worn(0.1)), inspection(finding=finding)).to_dicts()
    assert (alert["closed_at"], alert["closed_reason"]) == (None, None)


def test_renewal_closes_sensor_case() -> None:
    for component in ("HX", "SENSOR"):
        new = work(departure(90) - timedelta(minutes=5), component, timed=True)
        loss = np.where((component == "HX") & (np.arange(FLIGHTS) >= 90), 0.0, worn(0.1))
        cases = alerts(features(loss), pl.concat([inspection(), new], how="diagonal"))
        assert cases["closed_at"].to_list() == [departure(LOOKED_AFTER), departure(90)]
        assert cases["closed_reason"].to_list() == ["found_clean", "renewed"]
    twice = pl.concat([inspection(), *(work(departure(k) - timedelta(minutes=5), timed=True) for k in (80, 95))])
    later = np.where(np.arange(FLIGHTS) < 85, worn(0.0), worn(0.0) + 0.05)  # the next unit wears by itself
    assert alerts(features(later), twice)["diagnosis"].to_list() == ["HX_FOULING"] * 2


def test_named_closing_ends_low_margin() -> None:
    """Little margin is not what an exchanger's inspection is about, unless an engineer says so of that very alert."""
    rows = features(np.full(FLIGHTS, 0.05), hx_passage_300=np.full(FLIGHTS, 0.99), hx_margin_k=np.full(FLIGHTS, 1.0))
    (alert,) = alerts(rows, inspection()).to_dicts()
    assert (alert["diagnosis"], alert["closed_at"]) == ("HX_LOW_MARGIN", None)
    closed = {"closes_alert_id": "another id", "closes_diagnosis": "HX_LOW_MARGIN", "closes_sensor": None}
    (alert,) = alerts(rows, inspection(**closed)).to_dicts()
    assert alert["closed_reason"] == "found_clean", "though its id is another since"


@pytest.mark.parametrize(("days", "units"), [((30, 60), 3), ((1, 60), 2), ((60,), 2), ((), 1)])
def test_third_unit_asks_for_cause(days: tuple[int, ...], units: int) -> None:
    """Flights begin on day 0, the alert is raised on day 100 or so."""
    flight = np.arange(4 * 110)
    loss = np.where(flight < 4 * 98, 0.01, 0.01 + 0.005 * (flight - 4 * 98))
    work_done = [work(departure(4 * d), timed=True) for d in days]
    log = pl.concat(work_done) if days else work(departure(0)).clear()
    (alert,) = alerts(features(loss), log).to_dicts()
    assert alert["units_in_90_days"] == units
    assert alert["recommended_action"].startswith("Find the cause upstream") == (units >= 3)


@pytest.mark.parametrize(("late_s", "units"), [(0, 2), (1, 3)])
def test_units_count_over_ninety_days(late_s: int, units: int) -> None:
    flight = np.arange(4 * 110)
    rows = features(np.where(flight < 4 * 98, 0.01, 0.01 + 0.005 * (flight - 4 * 98)))
    raised = alerts(rows, work(departure(0)).clear())["raised_at"][0]
    log = [work(raised - timedelta(days=90, seconds=-late_s), timed=True), work(departure(4 * 60), timed=True)]
    assert alerts(rows, pl.concat(log))["units_in_90_days"].to_list() == [units]


def test_later_units_do_not_count() -> None:
    flight = np.arange(4 * 110)
    rows = features(np.where(flight < 4 * 98, 0.01, 0.01 + 0.005 * (flight - 4 * 98)))
    log = [work(departure(4 * day), timed=True) for day in (60, 108)]

    (alert,) = alerts(rows, pl.concat(log)).to_dicts()

    assert (alert["closed_reason"], alert["units_in_90_days"]) == ("renewed", 2)


@pytest.fixture(scope="module")
def open_alert() -> pl.DataFrame:
    """One alert of a night without work."""
    return alerts(features(np.linspace(0.0, 0.35, FLIGHTS)), NOTHING).head(1)


def since_night(*moments: datetime, pack: int = 1) -> pl.DataFrame:
    """Replacements that the night did not have."""
    log = RawMaintenance.conform(pl.concat([work(moment, timed=True) for moment in moments]))
    return date_entries(log).with_columns(pack=pl.lit(pack, log.schema["pack"]), since_night=pl.lit(True))


@pytest.mark.parametrize(("late_s", "is_closed"), [(0, False), (1, True)])
def test_only_later_work_closes_alert(open_alert: pl.DataFrame, late_s: int, is_closed: bool) -> None:
    done = open_alert["raised_at"][0] + timedelta(seconds=late_s)

    alert = alerts_now(open_alert, NO_LOG, since_night(done))

    assert alert["closed_at"].is_not_null().to_list() == [is_closed]


def test_first_later_work_closes_alert(open_alert: pl.DataFrame) -> None:
    first = open_alert["raised_at"][0] + timedelta(days=1)

    alert = alerts_now(open_alert, NO_LOG, since_night(first + timedelta(days=1), first))

    assert alert["closed_at"].to_list() == [first]


def test_later_work_keeps_closing_time(open_alert: pl.DataFrame) -> None:
    end = open_alert["raised_at"][0] + timedelta(days=1)
    ended = open_alert.with_columns(closed_at=pl.lit(end, open_alert.schema["closed_at"]))

    alert = alerts_now(ended, NO_LOG, since_night(end + timedelta(days=1)))

    assert alert["closed_at"].to_list() == [end]


def test_other_pack_work_closes_nothing(open_alert: pl.DataFrame) -> None:
    done = open_alert["raised_at"][0] + timedelta(days=1)

    alert = alerts_now(open_alert, NO_LOG, since_night(done, pack=2))

    assert alert["closed_at"].to_list() == [None]
