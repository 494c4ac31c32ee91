"""Two writers, and readers while one writes."""

import threading

import duckdb
import pytest

from pipelines.orchestration.around_night import BusyError, lock_home
from pipelines.storage.catalog import connect


def test_the_second_of_two_nights_stops_with_a_clear_line(tiny, children, tmp_path):
    home = children.home(tmp_path / "home")
    with lock_home(home), pytest.raises(BusyError, match="wait for it to end"), lock_home(home):
        pass
    with lock_home(home):
        ended, message = children.night(tiny.landing, home)
    assert ended is None
    assert message.startswith("BusyError: another run (process ")
    assert not (home / "catalog.duckdb").exists()


def test_the_lock_goes_with_the_process(tiny, children, tmp_path):
    home = children.home(tmp_path / "home")
    children.night(tiny.landing, home, fault="before_write:1")
    with lock_home(home):
        pass


def test_readers_never_meet_a_half_published_catalog(tiny, children, tmp_path):
    home = children.home(tmp_path / "home")
    assert children.night(tiny.landing, home, steps=3) == (0, "")
    over, answers = threading.Event(), []

    def read() -> None:
        while not over.is_set():
            try:
                with connect(home) as con:
                    answers.append(con.execute("select count(*) from flights").fetchone()[0])
            except duckdb.Error as error:
                answers.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        assert children.night(tiny.landing, home, publish=15) == (0, "")
    finally:
        over.set()
        reader.join()
    assert len(answers) > 15
    assert set(answers) == {4}
