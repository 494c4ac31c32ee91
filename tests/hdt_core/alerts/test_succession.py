"""Cases go on from alert to alert as later nights move them, in the lines of the log and in the view of them."""

from datetime import timedelta
from itertools import count, pairwise

import polars as pl
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_catalog import OWN, START, alert, catalog

from hdt_core.alerts.succession import lines_of_night
from hdt_core.tables import TABLES

Span = tuple[int, int | None]
"""Days on which an alert was raised and closed, the latter None while open."""


def alerts(*spans: Span, **more: object) -> list[dict]:
    """Alerts named after the day on which they were raised."""
    last = {"now_flight_id": "f", "evidence_now": "e", "raised_severity": "medium"}
    return [OWN | alert(f"day {first}", first, end) | last | more for first, end in spans]


def frame(table: str, rows: list[dict]) -> pl.DataFrame:
    return TABLES[table].schema.conform(pl.DataFrame(rows, infer_schema_length=None))


def lines_between(log: list[dict], before: list[dict], now: list[dict]) -> list[dict]:
    """The lines that a night adds to the log."""
    frames = (frame("raw_cases", log), frame("features_alerts", before), frame("features_alerts", now))
    ids = count(len(log))
    lines = lines_of_night(*frames, frames[2]["raised_at"], new_id=lambda: f"new {next(ids)}")
    return [
        line.alert | line.body | {"id": f"{n}", "line": n, "at": START, "kind": line.kind, "person": "night"}
        for n, line in enumerate(lines, len(log) + 1)
    ]


def log_of(*nights: list[dict]) -> list[dict]:
    log: list[dict] = []
    for before, now in pairwise(nights):
        log += lines_between(log, before, now)
    return log


def cases(log: list[dict], now: list[dict]) -> dict[str, tuple[str, str]]:
    """By name, the case and its alert, as the catalog has them."""
    names = catalog(raw_cases=log, features_alerts=now).sql("select known_as, case_id, alert_id from alert_cases")
    return {name: (case_id, alert_id) for name, case_id, alert_id in names.fetchall()}


@pytest.mark.parametrize(
    ("nights", "expected"),
    [
        pytest.param([[(9, None)], [(5, None)]], {"day 5": "day 9"}, id="raised earlier"),
        pytest.param([[(9, None)], [(5, None)], [(7, None)]], {"day 7": "day 9"}, id="moved twice"),
        pytest.param([[(9, 20)], [(21, None)]], {"day 21": "day 21"}, id="not open at once"),
        pytest.param([[(9, 40)], [(8, 12), (15, 41)]], {"day 8": "day 8", "day 15": "day 9"}, id="one became two"),
        pytest.param([[(9, 12), (15, 41)], [(8, 41)]], {"day 8": "day 15"}, id="two became one"),
        pytest.param([[(9, 12), (15, 41)], [(9, 41)]], {"day 9": "day 9"}, id="one joined another"),
        pytest.param([[(9, 30), (26, 30)], [(10, 30), (25, 30)]], {"day 10": "day 9", "day 25": "day 26"}, id="beside"),
        pytest.param([[(9, 30)], [], [(12, 30)]], {"day 12": "day 9"}, id="gone for a night"),
        pytest.param([[(9, None)], [(5, None)], [(9, None)]], {"day 9": "day 9"}, id="moved back"),
        pytest.param([[(9, 20)], [(5, 20)], [(5, 8), (9, 20)]], {"day 5": "day 9", "day 9": "new 1"}, id="taken name"),
    ],
)
def test_case_follows_nearest_alert(nights: list[list[Span]], expected: dict[str, str]):
    alerts_by_night = [alerts(*spans) for spans in nights]
    names = cases(log_of(*alerts_by_night), alerts_by_night[-1])
    assert {alert_id: case_id for case_id, alert_id in names.values()} == expected


@pytest.mark.parametrize(
    "other", [{"pack": 2}, {"diagnosis": "HX_LOW_MARGIN"}, {"sensor": "hx_out_k"}, {"tail": "T-2"}]
)
def test_other_trouble_is_another_case(other: dict):
    before = alerts((9, None), sensor="hx_in_k")
    now = alerts((8, None), **{"sensor": "hx_in_k"} | other)
    assert cases(log_of(before, now), now) == {"day 8": ("day 8", "day 8")}


@pytest.mark.parametrize(("day", "case_id"), [(12, "old"), (4, "day 9")])
def test_undated_line_follows_open_alert(day: int, case_id: str):
    """What it was about is gone; it was written, or the work done, while the alert of that kind was open."""
    done = {"done_on": (START + timedelta(days=day)).date()}
    line = OWN | alert("old", 0) | done | {"id": "1", "line": 1, "case_id": "old", "at": START, "kind": "close"}
    now = alerts((9, 20))
    log = [line | {"person": "Ada"}]
    assert cases([*log, *lines_between(log, [], now)], now)["day 9"] == (case_id, "day 9")


spans = st.tuples(st.integers(0, 12), st.none() | st.integers(1, 12)).map(lambda s: (s[0], s[1] and s[0] + s[1]))
nights = st.lists(st.lists(spans, max_size=3, unique_by=lambda s: s[0]), min_size=2, max_size=5)


@settings(max_examples=60)
@example(moves=[[(0, None)], [(3, 4)], [(0, 1)], [(2, None)]])
@given(nights)
def test_cases_stay_one_to_one(moves: list[list[Span]]):
    log: list[dict] = []
    for before, now in pairwise(alerts(*night) for night in moves):
        earlier = cases(log, before)
        log += lines_between(log, before, now)
        names = cases(log, now)
        assert len({alert_id for _, alert_id in names.values()}) == len({c for c, _ in names.values()}) == len(now)
        open_still = {n for n, (_, a) in earlier.items() if any(_overlap(a, before, b) for b in now)}
        assert open_still <= names.keys(), "a link to a case whose alert is raised leads to it"
        assert lines_between(log, now, now) == [], "a night without a move adds nothing"


def _overlap(alert_id: str, alerts_before: list[dict], other: dict) -> bool:
    (own,) = [a for a in alerts_before if a["alert_id"] == alert_id]
    ends = [a["closed_at"] or START.replace(year=2100) for a in (own, other)]
    return own["raised_at"] <= ends[1] and other["raised_at"] <= ends[0]
