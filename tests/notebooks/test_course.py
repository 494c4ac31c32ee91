"""The course: each lesson runs over the sample, and says something."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

COURSE = Path(__file__).parents[2] / "notebooks/course"
LESSONS = {
    "one_flight": lambda held: held["health"].height > 5 and held["compared"].height > 3,
    "one_packs_life": lambda held: held["held"].len() > 50 and held["fouling"].height > 100,
    "own_component": lambda held: (abs(held["found"]["hc_fouling"] - held["truth"]) < 4 * held["found"]["sd"]).all(),
    "what_an_alert_rests_on": lambda held: held["outcome"].height == 1 and held["witnesses"].height > 100,
    "a_query": lambda held: held["answer"].height == 4 and held["learn"].height > 100,
}


@pytest.mark.parametrize("lesson", LESSONS)
def test_a_lesson_runs(lesson, sample_home, monkeypatch):
    monkeypatch.setenv("HDT_HOME", str(sample_home))
    spec = importlib.util.spec_from_file_location(f"course_{lesson}", COURSE / f"{lesson}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    _, held = module.app.run()
    assert LESSONS[lesson](held)
    if "con" in held:
        held["con"].close()


def test_every_lesson_is_run_and_marimo_finds_nothing_to_mend():
    files = sorted(COURSE.glob("*.py"))
    assert {f.stem for f in files} == set(LESSONS)
    done = subprocess.run([sys.executable, "-m", "marimo", "check", "--strict", *map(str, files)], capture_output=True,
                          text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
