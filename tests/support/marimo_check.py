"""Marimo's own linter over notebooks."""

import subprocess
import sys
from pathlib import Path


def marimo_faults(*notebooks: Path) -> str:
    """What it finds to mend; empty where nothing."""
    command = [sys.executable, "-m", "marimo", "check", "--strict", *map(str, notebooks)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr if done.returncode else ""
