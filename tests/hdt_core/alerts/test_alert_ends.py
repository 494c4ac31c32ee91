"""An alert ends with its unit, says what was true when raised and what is now, and fares otherwise at other limits."""

from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, START, alerts, departure, features, work

from hdt_core.alerts.case_closure import close_after_work
from hdt_core.alerts.cases import Case
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.evidence import ROLES
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.threshold_study import VALUES, trials
from hdt_core.tables.features import FeaturesAlerts

NOTHING = work(START).clear()


@pytest.mark.parametrize("late", range(6))
@pytest.mark.parametrize("timed", [False, True])
def test_it_ends_at_the_first_flight_after_the_work_however_late_the_log_is(late: int, timed: bool) -> None:
    """Even where the track goes on as if nothing had happened."""
    rows = features(np.linspace(0.0, 0.35, FLIGHTS))
    done = departure(60 + late) - timedelta(minutes=5)
    (alert,) = alerts(rows, work(done, timed=timed)).head(1).to_dicts()
    ends = done if timed else datetime(done.year, done.month, done.day, tzinfo=UTC) + timedelta(days=1)
    assert alert["raised_at"] < done
    assert alert["closed_at"] == rows.filter(pl.col("departed_at") >= ends)["departed_at"][0]
    last = rows.filter(pl.col("departed_at") < ends)["flight_id"][-1]
    assert alert["now_flight_id"] == last


def test_it_ends_with_the_work_though_no_flight_has_followed() -> None:
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


def test_a_new_unit_that_fouls_fast_has_an_alert_of_its_own() -> None:
    """A clog's case is not carried on by the loss of the unit that came after it."""
    flight = np.arange(FLIGHTS)
    loss = np.where(flight < 40, 0.03, np.where(flight < 52, 0.28, 0.012 * np.maximum(flight - 52, 0)))
    out = alerts(features(loss), work(departure(52) - timedelta(minutes=5), timed=True))
    assert out["diagnosis"].to_list() == ["HX_SUDDEN_CLOG", "HX_FOULING"]
    assert out["closed_at"].to_list() == [departure(52), None]


@pytest.mark.parametrize("code", DIAGNOSES)
def test_every_diagnosis_ends_with_work_on_its_component_and_no_other(code: str) -> None:
    diagnosis, grid = DIAGNOSES[code], Grid.from_frame(features(np.zeros(FLIGHTS)))
    for component in ("HX", "CC", "RAM_DOOR", "SENSOR"):
        for action in ("REPLACED", "INSPECTED"):
            case = Case(0, diagnosis.component, code, 30, None)
            entry = work(departure(50), component, action, timed=True)
            close_after_work(grid, entry, [case])
            assert case.closed_flight == (50 if component == diagnosis.component and action == "REPLACED" else None)


def test_when_raised_and_now_are_told_apart() -> None:
    rows = features(np.linspace(0.0, 0.35, FLIGHTS), door_full_open_share=np.linspace(0.0, 0.4, FLIGHTS) ** 2)
    (alert,) = alerts(rows, NOTHING).to_dicts()
    raised = rows.filter(flight_id=alert["raised_flight_id"])["hx_fouling"].item()
    assert f"Heat transfer lost (hx_fouling) {100 * raised:.0f} % ({100 * raised - 1.6:.0f} to" in alert["evidence"]
    assert "Heat transfer lost (hx_fouling) 35 % (33 to 37)" in alert["evidence_now"]
    assert (alert["raised_severity"], alert["severity"]) == ("medium", "high")
    assert alert["now_flight_id"] == rows["flight_id"][-1]


def test_what_was_raised_is_never_said_otherwise_later() -> None:
    rows = features(np.linspace(0.0, 0.35, FLIGHTS))
    whole, part = alerts(rows, NOTHING), alerts(rows.head(70), NOTHING)
    stays = ["alert_id", "raised_at", "raised_severity", "evidence", "recommended_action"]
    assert part.select(stays).equals(whole.select(stays))


def role(text: str, phrase: str) -> str:
    """Role under which a paragraph of evidence tells of something."""
    before = text.partition(phrase)[0]
    return max((r for r in ROLES if f"{r}:" in before), key=lambda r: before.rfind(f"{r}:"))


def test_a_clog_without_loss_of_ram_flow_has_a_witness_against_it() -> None:
    loss = np.where(np.arange(FLIGHTS) < 60, 0.03, 0.3)
    (alert,) = alerts(features(loss, ram_flow_loss=0.0), NOTHING).to_dicts()
    assert alert["diagnosis"] == "HX_SUDDEN_CLOG"
    assert role(alert["evidence"], "no blockage") == "Against"


def test_every_diagnosis_is_known_wherever_diagnoses_are_listed() -> None:
    declared = set(DIAGNOSES)
    listed = str((FeaturesAlerts.columns()["diagnosis"].metadata or {})["meaning"])
    check = (Path(__file__).parents[3] / "sql/checks/alerts_in_disorder.sql").read_text()
    assert all(code in listed and f"'{code}'" in check for code in declared)
    assert all(d.code == code and d.name and "ATA 21-" in d.action for code, d in DIAGNOSES.items())


def test_a_busier_aircraft_beside_it_changes_nothing() -> None:
    """A belief held at a pack's last flight raises no case on flights that only the other aircraft flew."""
    alone = np.concatenate([np.zeros(40), np.full(40, 0.3)])
    rows = features(np.zeros(80), hx_fouling_flight=alone).with_columns(hx_fouling_step_3=pl.lit(-0.2))
    busier = features(np.linspace(0.0, 0.35, FLIGHTS)).with_columns(tail=pl.lit("T-BBB"))
    both = alerts(pl.concat([rows, busier], how="diagonal"), NOTHING)
    assert both.equals(pl.concat([alerts(rows, NOTHING), alerts(busier, NOTHING)]))


def three_packs() -> pl.DataFrame:
    """Packs that lose 12, 18 and 35 per cent over their flights."""
    worn = (features(np.linspace(0.0, most, FLIGHTS)) for most in (0.12, 0.18, 0.35))
    return pl.concat(f.with_columns(tail=pl.lit(f"T-{k}")) for k, f in enumerate(worn))


def test_the_limit_in_service_says_what_was_said() -> None:
    rows = three_packs()
    in_service = {t.diagnosis: t.alerts for t in trials(rows, pl.DataFrame(), NOTHING) if t.in_service}
    assert set(in_service) == set(VALUES)
    assert [values for _, values in VALUES.values()] == [
        (0.10, 0.125, 0.15, 0.20, 0.25), (0.07, 0.10, 0.15, 0.20), (0.70, 0.80, 0.90, 0.95, 0.98),
        (0.03, 0.04, 0.05, 0.07), (0.9, 1.3, 1.8, 2.5),
    ]  # fmt: skip
    for diagnosis in set(VALUES) - {"RAM_DOOR_FAULT"}:
        assert in_service[diagnosis].sort("alert_id").equals(alerts(rows, NOTHING).sort("alert_id"))


def test_a_lower_limit_hears_of_more_packs_and_earlier() -> None:
    limits = [t for t in trials(three_packs(), pl.DataFrame(), NOTHING) if t.diagnosis == "HX_FOULING"]
    assert [t.value for t in limits] == sorted(t.value for t in limits)
    packs = [set(t.alerts["tail"]) for t in limits]
    assert all(later <= earlier for earlier, later in pairwise(packs))
    raised = [t.alerts.filter(tail="T-2")["raised_at"].min() for t in limits]
    assert raised == sorted(raised)
    assert len(packs[-1]) < len(packs[0])
