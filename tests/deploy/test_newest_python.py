"""The README's two commands on the newest Python of this machine, in a clone of the tree."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NAMES = [f"python3.{n}" for n in range(20, sys.version_info.minor, -1)]


def runs(name: str) -> bool:
    """Whether a Python starts: a version manager puts names on the path of versions that it lacks."""
    return (
        shutil.which(name) is not None
        and not subprocess.run([name, "-c", ""], capture_output=True, check=False).returncode
    )


NEWEST = next(filter(runs, NAMES), None)


@pytest.mark.skipif(NEWEST is None, reason="no Python newer than the one that runs the tests")
def test_commands_pass_on_newest_python(tmp_path):
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(tmp_path / "clone")], check=True)
    environment = {k: v for k, v in os.environ.items() if k != "VIRTUAL_ENV"}

    done = [
        subprocess.run(
            ["make", target, f"PYTHON={NEWEST}"],
            cwd=tmp_path / "clone",
            env=environment,
            check=False,
            capture_output=True,
            text=True,
        )
        for target in ("run", "test")
    ]

    assert [d.returncode for d in done] == [0, 0], done[-1].stdout[-2000:]
