"""A unit is to act on from a chance of one half until it falls below two fifths, or until work or a finding."""

import datetime as dt

import pytest
from small_catalog import catalog, chances, flight, fouling, replaced


def forecast(n: int, chance: float, version: str) -> dict:
    return flight(n) | {"pack": 1, "component": "HX", "model_version": version} | chances(chance)


def urgency(course: list[float], maintenance: list[dict] | None = None, model: list[str] | None = None) -> list[tuple]:
    """Urgency, its begin and its cause after flights with these chances of a message within 30 days."""
    versions = model or ["m"] * len(course)
    con = catalog(
        raw_flights=[flight(n) for n in range(len(course))],
        twin_health=[fouling(n, 0.2) for n in range(len(course))],
        prognoses=[forecast(n, *of) for n, of in enumerate(zip(course, versions, strict=True))],
        raw_maintenance=maintenance or [],
    )
    return con.execute("select urgency, urgent_since, urgent_by from unit_urgencies").fetchall()


LOW = [0.1] * 20
HIGH = [0.6] * 20


@pytest.mark.parametrize(
    ("chances", "expected"),
    [
        ([*LOW, *HIGH], "act"),
        ([*LOW, *HIGH, 0.45], "act"),
        ([*LOW, *HIGH, 0.35], "plan"),
        ([*LOW, *HIGH, 0.35, 0.45], "plan"),
        ([*LOW, 0.45], "plan"),
    ],
)
def test_urgency_has_memory(chances, expected):
    assert urgency(chances)[0][0] == expected


def test_urgency_begins_at_one_half():
    assert urgency([*LOW, *HIGH, 0.45])[0][1] == flight(20)["departed_at"]


@pytest.mark.parametrize(("versions", "by"), [(["m"] * 40, "flights"), (["m"] * 20 + ["n"] * 20, "fleet")])
def test_urgency_names_its_cause(versions, by):
    assert urgency([*LOW, *HIGH], model=versions)[0][2] == by


@pytest.mark.parametrize("work", [replaced(30), replaced(30, "NO_FAULT_FOUND") | {"action": "INSPECTED"}])
def test_work_ends_urgency(work):
    assert urgency([*LOW, *[0.6] * 5, *[0.45] * 20], [work])[0][0] == "plan"


def test_unconfirmed_urgency_lapses():
    assert urgency([*HIGH, *[0.45] * 120])[0][0] == "plan"
    assert dt.timedelta(90) < flight(139)["departed_at"] - flight(19)["departed_at"]
