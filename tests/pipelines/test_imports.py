"""What a night and a command load: most of what a night with little to do costs."""

import subprocess
import sys
from pathlib import Path

import pytest
from answers import query

HEAVY = ("dagster", "matplotlib", "pandas", "scipy", "scipy.stats", "sklearn", "skops")


def loaded(*words: object) -> set[str]:
    """Which of `HEAVY` a command loads."""
    code = (
        "import sys\nfrom pipelines.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        f"print('loaded', *sys.modules.keys() & {set(HEAVY)!r})"
    )
    command = [sys.executable, "-c", code, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split()[1:])


@pytest.fixture(scope="module")
def first_alert(sample_home: Path) -> str:
    return str(query(sample_home, "select alert_id from open_alerts")[0][0])


def test_idle_night_loads_no_engine(own_home):
    landing, home = own_home
    assert loaded("nightly", "--landing", landing, "--home", home) == set()


def test_closing_loads_no_engine(own_home, first_alert):
    command = ("close", first_alert, "--finding", "clean", "--by", "me", "--home", own_home[1])
    assert loaded(*command) == set()
