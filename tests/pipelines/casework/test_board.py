"""What the page holds of the cases is as new as the log, the night and the clock."""

import datetime as dt

import pytest
from case_homes import case_home

from pipelines.casework import board
from pipelines.casework.board import Board
from pipelines.casework.changes import change_case


@pytest.fixture
def home(tmp_path):
    return case_home(tmp_path / "home")


@pytest.fixture
def reads(monkeypatch):
    """A line for each time the catalog was asked for the cases."""
    reads, read = [], board.list_cases
    monkeypatch.setattr(board, "list_cases", lambda *a: reads.append(a) or read(*a))
    return reads


def test_a_line_is_there_at_once_and_nothing_is_read_twice(home, reads):
    cases = Board(home)
    assert list(cases.read().cases) == ["wear", "clog", "other", "gone"]
    assert cases.read() is cases.read()
    assert len(reads) == 1
    change_case(home, cases.read().cases["wear"], "assign", "Ada", assignee="Bo")
    snapshot = cases.read()
    assert (snapshot.cases["wear"]["owner"], len(snapshot.history["wear"]), len(reads)) == ("Bo", 1, 2)


def test_a_night_is_there_at_once(home):
    cases = Board(home)
    assert cases.read().cases["wear"]["now_loss"] == 0.2
    case_home(home, loss=0.3)
    assert cases.read().cases["wear"]["now_loss"] == 0.3


def test_a_mute_ends_by_the_clock(home, reads, monkeypatch):
    cases, until = Board(home), dt.datetime.now(dt.UTC).replace(microsecond=0) + dt.timedelta(days=2)
    change_case(home, cases.read().cases["wear"], "mute", "Ada", until=until.isoformat(), note="x")
    assert (cases.read().cases["wear"]["state"], cases.read().valid_until, len(reads)) == ("muted", until, 2)

    class Later(dt.datetime):
        @classmethod
        def now(cls, tz=None):
            return until

    monkeypatch.setattr(board, "datetime", Later)
    cases.read()
    assert len(reads) == 3
