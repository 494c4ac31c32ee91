"""Which units are ranked by flights of long ago: none since moved their estimate, or holds a row of the pack."""

import pytest
from answers import rows
from small_catalog import catalog, flight, fouling

SINCE = "select n_flights, since, reason from missing_estimates"


def health(n: int, status: str) -> dict:
    return fouling(n, 0.2) | {"status": status}


def leg(n: int) -> dict:
    return flight(n) | {"pack": 1, "admitted": False, "reason": "NO_CRUISE"}


@pytest.mark.parametrize(("n_predicted", "expected"), [(14, []), (15, [(15, flight(20)["departed_at"], "NO_CRUISE")])])
def test_fifteen_predictions_are_told(n_predicted, expected):
    flown = range(20 + n_predicted)
    con = catalog(
        raw_flights=[flight(n) for n in flown],
        twin_health=[health(n, "ok" if n < 20 else "predicted") for n in flown],
        legs_verdicts=[leg(n) for n in flown if n >= 20],
    )
    assert rows(con, SINCE) == expected


def test_flights_without_the_pack_are_told():
    con = catalog(raw_flights=[flight(n) for n in range(40)], twin_health=[health(n, "ok") for n in range(20)])
    assert rows(con, SINCE) == [(20, flight(20)["departed_at"], "NO_ROWS")]
