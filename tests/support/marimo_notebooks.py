"""Notebooks of marimo: loaded as modules, and looked over by its own linter."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType


def load_notebook(path: Path) -> ModuleType:
    """A notebook as a module; its `app` is run by the test."""
    spec = importlib.util.spec_from_file_location(f"{path.stem}_notebook", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def marimo_faults(*notebooks: Path) -> str:
    """What the linter finds to mend; empty where nothing."""
    command = [sys.executable, "-m", "marimo", "check", "--strict", *map(str, notebooks)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr if done.returncode else ""
