"""Which flights never arrived, and which aircraft fell silent."""

import datetime as dt

import pytest
from answers import rows
from small_catalog import OWN, catalog, flight


def leg_of(number: int, hours: float, day: int = 0) -> dict:
    """A leg of a day, by its number, that departs so many hours into it."""
    row = flight(day)
    return row | {
        "flight_id": f"{row['flight_id'][:-2]}{number:02d}",
        "departed_at": row["departed_at"] + dt.timedelta(hours=hours),
    }


def test_gaps_are_listed_by_kind():
    flown = [leg_of(1, 1, d) for d in range(40) if not 10 <= d < 20] + [leg_of(4, 4, 5)]
    others = [flight(d, tail="T-2") for d in range(20)]
    fleet = [{"operator": "AAA", "tail": t} for t in ("T-1", "T-2", "T-3")]
    con = catalog(raw_flights=flown + others, raw_fleet=fleet)
    gaps = rows(con, "select tail, gap, n_flights, round(silent_days) from data_gaps order by 1, 2")
    assert gaps == [
        ("T-1", "missing_leg", 2, None), ("T-1", "silence", None, 11), ("T-2", "silent_now", None, 20),
        ("T-3", "never_heard", None, None),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("elsewhere", "n"),
    [
        ({}, [1]),
        ({"record_held": [leg_of(2, 2)]}, []),
        ({"raw_quarantine": [{"file": f"AAA/T-1/acms/{leg_of(2, 2)['flight_id']}.csv", "reason": "no_rows"}]}, []),
        ({"raw_quarantine": [{"file": "f", "flight_id": leg_of(2, 2)["flight_id"], "reason": "bad_pack"}]}, []),
    ],
)
def test_held_leg_has_arrived(elsewhere, n):
    own = {"scope": "row", "n_rows": 1} | OWN
    tables = {name: [own | row for row in rows] for name, rows in elsewhere.items()}
    con = catalog(raw_flights=[leg_of(1, 0), leg_of(3, 4)], **tables)
    assert [k for (k,) in rows(con, "select n_flights from data_gaps where gap = 'missing_leg'")] == n


def test_exchanged_legs_leave_no_gap():
    con = catalog(raw_flights=[leg_of(1, 0), leg_of(3, 2), leg_of(2, 4)])
    assert rows(con, "select n_flights from data_gaps where gap = 'missing_leg'") == []
