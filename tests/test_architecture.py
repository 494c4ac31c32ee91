"""The house: imports point one way, and the science can be used without the pipeline."""

import pkgutil
import subprocess
import sys

import hdt_core

MODULES = sorted(m.name for m in pkgutil.walk_packages(hdt_core.__path__, "hdt_core."))


def test_no_science_module_loads_dagster_or_duckdb():
    """In one fresh interpreter, module by module: the first that drags a pipeline in is named."""
    script = (
        "import importlib, sys\n"
        f"for name in {MODULES!r}:\n"
        "    importlib.import_module(name)\n"
        "    found = {'dagster', 'duckdb', 'pipelines'} & set(sys.modules)\n"
        "    assert not found, f'{name} loads {found}'\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_top_level_is_as_agreed():
    from pathlib import Path

    root = Path(__file__).parents[1]
    for name in (
        "pipelines",
        "hdt_core",
        "sql",
        "data_samples",
        "tests",
        "dagster.yaml",
        "pyproject.toml",
        "requirements.lock",
    ):
        assert (root / name).exists(), name
