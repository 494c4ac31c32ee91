"""`dagster_batched` holds against the stock Dagster of every version it claims, not only of the one that is pinned."""

import os
import re
import subprocess
import tomllib
from pathlib import Path

import dagster
import pytest

ROOT = Path(__file__).parents[2]
OTHER = os.environ.get("HDT_TEST_DAGSTER", "")
TESTS = [f"tests/pipelines/test_{name}.py" for name in ("eventlog", "broker", "definitions")]


def numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def supported_range() -> tuple[str, str]:
    """The oldest version that is supported, and the first that is not."""
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (bounds,) = (
        re.fullmatch(r"dagster>=([\d.]+),<([\d.]+)", line) for line in dependencies if line.startswith("dagster>")
    )
    return bounds[1], bounds[2]


def test_oldest_version_is_named_alike():
    oldest, beyond = supported_range()
    assert numbers(oldest) < numbers(dagster.__version__) < numbers(beyond)
    assert f"`make dagster` runs them with the oldest, {oldest}" in (ROOT / "dagster_batched/README.md").read_text()
    assert f"\t.ci/dagster {oldest}\n" in (ROOT / "Makefile").read_text()


@pytest.mark.skipif(not OTHER, reason="HDT_TEST_DAGSTER names no Python with another Dagster; `make dagster` makes one")
def test_other_dagster_passes_the_tests():
    ask = [OTHER, "-c", "import dagster; print(dagster.__version__)"]
    other = subprocess.run(ask, capture_output=True, text=True, check=True).stdout.strip()
    oldest, beyond = supported_range()
    assert numbers(oldest) <= numbers(other) < numbers(beyond)
    assert other != dagster.__version__
    own = {**os.environ, "PYTHONPATH": str(ROOT), "HDT_TEST_DAGSTER": ""}
    command = [OTHER, "-m", "pytest", *TESTS]
    done = subprocess.run(command, cwd=ROOT, env=own, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
