"""How cells are shared out to runs."""

import polars as pl
import pytest

from pipelines import runs

KEYS = ["AAA:T1", "AAA:T2", "AAA:T3", "BBB:T4"]


@pytest.fixture
def runner(monkeypatch):
    """A runner that knows four aircraft, with room for ten flights a run."""
    monkeypatch.setattr(runs, "CELLS_A_RUN", 10)
    monkeypatch.setattr(runs.Runner, "_keys", lambda self, definition: KEYS)
    return object.__new__(runs.Runner)


def shared(runner, flights: dict[str, int], wanted: list[str]) -> list[tuple[str, ...]]:
    flown = {key: {f"{i}" for i in range(n)} for key, n in flights.items()}
    cells = pl.DataFrame([k.split(":") for k in wanted], schema=["operator", "tail"], orient="row")
    return [block.aircraft for block in runner._aircraft_blocks(cells, flown)]


@pytest.mark.parametrize(
    ("each", "found"),
    [
        (5, [("AAA:T1", "AAA:T2"), ("AAA:T3", "BBB:T4")]),
        (6, [("AAA:T1",), ("AAA:T2",), ("AAA:T3",), ("BBB:T4",)]),
        (99, [("AAA:T1",), ("AAA:T2",), ("AAA:T3",), ("BBB:T4",)]),
        (1, [tuple(KEYS)]),
    ],
)
def test_aircraft_share_a_run_up_to_a_number_of_flights(runner, each, found):
    assert shared(runner, dict.fromkeys(KEYS, each), KEYS) == found


def test_an_aircraft_that_is_not_wanted_parts_the_range(runner):
    assert shared(runner, dict.fromkeys(KEYS, 1), [KEYS[0], *KEYS[2:]]) == [("AAA:T1",), ("AAA:T3", "BBB:T4")]
