"""Reference classes over a fleet counted on fingers: T-1 has lost 20 % on 10 May, its month began on day 61."""

import pytest
from answers import rows
from small_catalog import catalog, chances, flight, fouling, message

LAST = 70
LOSS = 0.2
BEFORE = 0.05


def track(tail: str, reached: int, last: int = LAST) -> list[dict]:
    return [fouling(n, LOSS if n >= reached else BEFORE, tail=tail) for n in range(last + 1)]


def life(tail: str, last: int = LAST, ended_by: str | None = None) -> dict:
    start = flight(0, tail=tail)
    end = flight(last, tail=tail)
    own = {"operator": "AAA", "tail": tail, "pack": 1, "component": "HX", "life": 0, "ended_by": ended_by}
    return own | {"first_departed_at": start["departed_at"], "end_departed_at": end["departed_at"]}


def classes(columns: str, chance: float = 0.1, low: float = 60.0, **more: list[dict]) -> list[tuple]:
    """T-2 and T-3 had the message after 30 and 10 flights, T-4 in May after 50, T-5 flies on."""
    forecast = {"component": "HX", "pack": 1, "rul_flights": 99.0, "rul_low": low, "rul_high": 300.0}
    tables = {
        "twin_health": [*track("T-1", 60), *track("T-2", 10, 40), *track("T-3", 40, 50), *track("T-4", 15, 65),
                        *track("T-5", 20)],
        "prognosis_lives": [life("T-1"), life("T-2", 40, "message"), life("T-3", 50, "message"),
                            life("T-4", 65, "message"), life("T-5")],
        "raw_messages": [message(40)],
        "prognoses": [flight(LAST) | forecast | chances(chance)],
    }  # fmt: skip
    con = catalog(raw_flights=[flight(n) for n in range(LAST + 1)], **tables | more)
    return rows(con, f"select {columns} from reference_classes where tail = 'T-1'")


def test_units_are_counted_at_month_begin():
    assert classes("loss, n_units, n_flying, n_messages") == [(LOSS, 4, 2, 2)]


def test_flights_to_message_are_kaplan_meier():
    """Of four that came to it three outlived flight 10, two flight 30; the others are followed for 45 and 40."""
    columns = "flights_to_message_median, flights_to_message_most, chance_50"
    assert classes(columns) == [(30, 30, pytest.approx(0.5))]


@pytest.mark.parametrize(("chance", "low", "disagrees"), [(0.05, 60, True), (0.05, 20, False), (0.4, 60, False)])
def test_class_disagrees_beyond_both_errors(chance, low, disagrees):
    assert classes("disagrees", chance, low) == [(disagrees,)]


def test_operators_without_messages_are_no_reference():
    assert classes("n_units, chance_50", raw_messages=[]) == [(0, None)]


def test_record_begun_worn_is_no_reference():
    worn = [fouling(n, 0.4, tail="T-9") for n in range(LAST)]
    assert classes("n_units", twin_health=[*track("T-1", 60), *worn], prognosis_lives=[life("T-9")]) == [(0,)]
