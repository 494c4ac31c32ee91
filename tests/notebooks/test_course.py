"""The course: each lesson runs over the sample, and says something."""

from pathlib import Path

import pytest
from marimo_notebooks import load_notebook, marimo_faults

COURSE = Path(__file__).parents[2] / "notebooks/course"
LESSONS = {
    "one_flight": lambda cells: cells["health"].height > 5 and cells["compared"].height > 3,
    "one_packs_life": lambda cells: cells["held"].len() > 50 and cells["fouling"].height > 100,
    "own_component": lambda cells: (
        abs(cells["found"]["hc_fouling"] - cells["truth"]) < 4 * cells["found"]["sd"]
    ).all(),
    "what_an_alert_rests_on": lambda cells: cells["outcome"].height == 1 and cells["witnesses"].height > 100,
    "a_query": lambda cells: cells["answer"].height == 4 and cells["learn"].height > 100,
}


@pytest.mark.parametrize("lesson", LESSONS)
def test_lesson_runs_over_sample(lesson, sample_home, monkeypatch):
    monkeypatch.setenv("HDT_HOME", str(sample_home))
    _, cells = load_notebook(COURSE / f"{lesson}.py").app.run()
    assert LESSONS[lesson](cells)
    if "con" in cells:
        cells["con"].close()


FILES = sorted(COURSE.glob("*.py"))


def test_every_lesson_is_run():
    assert {f.stem for f in FILES} == set(LESSONS)


def test_marimo_accepts_lessons():
    assert marimo_faults(*FILES) == ""
