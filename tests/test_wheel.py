"""The wheel alone, on a base install without numba and away from the repository: its demo runs."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from nights import keep_base

ROOT = Path(__file__).parents[1]
DEMO = """
import sys
sys.modules["numba"] = None  # importing it fails, as where it is not installed
import dagster_batched, hdt_core, pipelines, sql
assert all(m.__file__.startswith(sys.argv[1]) for m in (hdt_core, pipelines, dagster_batched, sql))
from pipelines.cli import app
for words in (
    "simulate --out fleet --operators 1 --tails 1 --flights 15",
    "nightly --landing fleet/landing --home home",
    "report --home home --out report.html",
):
    app(words.split(), standalone_mode=False)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy, so that nothing is left in the repository."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("hdt_core", "pipelines", "dagster_batched", "sql"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = ("wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", target, source)
    subprocess.run([sys.executable, "-m", "pip", *build], check=True, cwd=target)
    return next(target.glob("*.whl"))


def test_it_carries_what_is_no_python_and_says_that_it_is_typed(wheel):
    said = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert wheel.name.startswith(f"hybrid_digital_twin-{said['version']}-")
    held = set(zipfile.ZipFile(wheel).namelist())
    beside = [
        p
        for name in ("hdt_core", "pipelines", "dagster_batched", "sql")
        for p in (ROOT / name).rglob("*")
        if p.is_file()
    ]
    wanted = {p.relative_to(ROOT).as_posix() for p in beside if p.suffix in {".sql", ".css", ".js", ".typed"}}
    assert len(wanted) > 30
    assert wanted <= held
    assert not {h for h in held if h.startswith(("tests", "benchmarks", "docs"))}


def test_its_demo_runs_outside_the_repository(wheel, sample_home, tmp_path):
    site, out = tmp_path / "site", tmp_path / "elsewhere"
    zipfile.ZipFile(wheel).extractall(site)
    out.mkdir()
    keep_base(sample_home, out / "home")
    command = [sys.executable, "-c", DEMO, str(site)]
    env = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(command, cwd=out, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "SAA AA-0000" in done.stdout
    assert "AA-0000" in (out / "report.html").read_text(encoding="utf-8")
