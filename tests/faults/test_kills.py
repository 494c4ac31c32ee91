"""Killed at every named place and at any moment: nothing lost, nothing doubled, nothing torn, and the end is the same.

`make soak` sets HDT_SOAK_KILLS to kill far more often than there is time for in CI.
"""

import os
import random
import shutil
import signal
import threading
from itertools import count

import dagster as dg
import duckdb
import pytest
from nights import steps_up_to
from soundness import state

from benchmarks.fault_points import POINTS, fingerprint
from pipelines.orchestration.runs import open_instance
from pipelines.storage.catalog import connect

KILLS = int(os.environ.get("HDT_SOAK_KILLS", "24"))
"""Kills at random moments, beside those at the named places."""


def test_kill_at_each_place_loses_nothing(tiny, children, intact, home):
    """Place by place through the whole night: the first night dies at its first place, the second at its second, ..."""
    for place in count(1):
        ended, message = children.night(tiny.landing, home, fault=f"any:{place}")
        intact(home)
        if ended != signal.SIGKILL:
            break
    assert (ended, message) == (0, "")
    assert place > 20
    tiny.check_end(home)


@pytest.mark.parametrize("point", POINTS)
def test_kill_at_intake_loses_nothing(tiny, children, intact, home, point):
    """The place that writes what was delivered: rows may be stored and not yet accounted for."""
    nth = 1 if "register" in point or "publish" in point else 9
    steps = steps_up_to("legs")
    assert children.night(tiny.landing, home, fault=f"{point}:{nth}", steps=steps)[0] == signal.SIGKILL
    intact(home)
    children.complete_night(tiny.landing, home, steps=steps)
    stored = fingerprint(home)
    delivered = [t for t in stored if t.startswith(("raw_", "legs_samples", "legs_verdicts"))]
    assert {t: stored[t] for t in delivered} == {t: tiny.end[t] for t in delivered}


def test_kill_at_any_moment_loses_nothing(tiny, children, intact, tmp_path):
    chance = random.Random(7)
    kills = 0
    homes = 0
    while kills < KILLS:
        home = children.home(tmp_path / f"home{homes}")
        homes += 1
        ended: int | None = signal.SIGKILL
        while ended == signal.SIGKILL:
            after_s = 600 if kills >= KILLS else chance.uniform(0.05, 1.0) * 2 ** chance.randrange(4)
            ended, message = children.night(tiny.landing, home, kill_after_s=after_s)
            kills += ended == signal.SIGKILL
            intact(home)
        assert (ended, message) == (0, "")
        assert not list(home.glob("**/.*.part")), "what a killed writer left is swept"
        assert state(home) == tiny.end
        print(f"{kills} kills, {homes} nights ended: 0 lost, 0 doubled, 0 torn, all equal", flush=True)
        shutil.rmtree(home)


def test_killed_run_is_marked_failed(tiny, children, home):
    assert children.night(tiny.landing, home, fault="before_mark:2")[0] == signal.SIGKILL
    children.complete_night(tiny.landing, home)
    with open_instance(home) as instance:
        ended = [r.status for r in instance.get_runs()]
    assert ended.count(dg.DagsterRunStatus.FAILURE) == 1
    assert set(ended) == {dg.DagsterRunStatus.FAILURE, dg.DagsterRunStatus.SUCCESS}


def test_stopped_night_loses_nothing(tiny, children, intact, home):
    """Asked to stop by a signal."""
    ended, _ = children.night(tiny.landing, home, fault="before_rename:14:term")
    assert ended != 0
    intact(home)
    children.complete_night(tiny.landing, home)
    assert state(home) == tiny.end


def test_readers_meet_whole_catalogs_only(tiny, children, home):
    children.complete_night(tiny.landing, home, steps=steps_up_to("legs"))
    over = threading.Event()
    answers = []

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
        children.complete_night(tiny.landing, home, publish=15)
    finally:
        over.set()
        reader.join()
    assert len(answers) > 15
    assert set(answers) == {4}
