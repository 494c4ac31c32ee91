"""The wheel alone, on a base install without numba and extensions and away from the repository: its demo runs."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from nights import keep_base

ROOT = Path(__file__).parents[1]
PACKAGES = ("hdt_core", "pipelines", "dagster_batched", "sql")
DEMO = """
import importlib.metadata, pathlib, sys
sys.modules["numba"] = None  # importing it fails, as where it is not installed
extensions = [p.name for p in pathlib.Path(sys.argv[2]).glob("hdt_*")]
assert extensions
sys.modules.update(dict.fromkeys(extensions))
every = importlib.metadata.entry_points
def ours(**group):  # fsspec asks for all groups at once
    return [p for p in every(**group) if p.value.split(".")[0] not in extensions] if group else every()
importlib.metadata.entry_points = ours
import dagster_batched, hdt_core, pipelines, sql
assert all(m.__file__.startswith(sys.argv[1]) for m in (hdt_core, pipelines, dagster_batched, sql))
from pipelines.cli import app
app("simulate --out fleet --operators 1 --tails 1 --flights 15".split(), standalone_mode=False)
pathlib.Path("fleet/landing/SAA/AA-0000/recorder").mkdir()
for words in (
    "doctor --landing fleet/landing",
    "nightly --landing fleet/landing --home home",
    "report --home home --out report.html",
    "docs raw-data",
):
    app(words.split(), standalone_mode=False)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy, so that nothing is left in the repository."""
    source = tmp_path_factory.mktemp("source")
    target = tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = ("wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", target, source)
    subprocess.run([sys.executable, "-m", "pip", *build], check=True, cwd=target)
    return next(target.glob("*.whl"))


@pytest.fixture(scope="module")
def names(wheel) -> set[str]:
    """Files in the wheel."""
    return set(zipfile.ZipFile(wheel).namelist())


def test_wheel_has_version_of_project(wheel):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert wheel.name.startswith(f"hybrid_digital_twin-{project['version']}-")


def test_wheel_carries_data_files(names):
    """What is no Python, and the mark that it is typed."""
    suffixes = {".sql", ".css", ".js", ".toml", ".typed"}
    files = [p for package in PACKAGES for p in (ROOT / package).rglob("*") if p.is_file() and p.suffix in suffixes]
    assert len(files) > 30
    assert {p.relative_to(ROOT).as_posix() for p in files} <= names


def test_wheel_carries_no_tests(names):
    assert not {h for h in names if h.startswith(("tests", "benchmarks", "docs"))}


@pytest.fixture(scope="module")
def messages() -> list[str]:
    """Texts that the code may show, and those of its settings."""
    sources = [*(ROOT / "hdt_core").rglob("*.py"), *(ROOT / "pipelines").rglob("*.py")]
    nodes = (node for file in sources for node in _messages(ast.parse(file.read_text(encoding="utf-8"))))
    texts = [node.value for node in nodes if isinstance(node.value, str)]
    return texts + [file.read_text(encoding="utf-8") for file in (ROOT / "pipelines").rglob("*.toml")]


def test_wheel_carries_referenced_pages(names, messages):
    """Messages say `hdt docs PAGE`."""
    pages = {page for text in messages for page in re.findall(r"`hdt docs ([a-z0-9-]+)`", text)}
    assert pages >= {"raw-data", "howto-recorder"}
    assert {f"pipelines/docs/{page}.md" for page in pages} <= names
    assert {Path(h).suffix for h in names if h.startswith("pipelines/docs/")} == {".md"}


def test_messages_name_no_file_of_checkout(messages):
    assert [t for t in messages if re.search(r"\bsee docs/|\(docs/[a-z-]+\.md\)", t)] == []


def _messages(tree: ast.Module) -> list[ast.Constant]:
    """Texts of a module that are no docstring."""
    docstrings = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    return [n for n in ast.walk(tree) if isinstance(n, ast.Constant) and id(n) not in docstrings]


def test_demo_runs_outside_repository(wheel, sample_home, tmp_path):
    site = tmp_path / "site"
    out = tmp_path / "elsewhere"
    zipfile.ZipFile(wheel).extractall(site)
    out.mkdir()
    keep_base(sample_home, out / "home")
    command = [sys.executable, "-c", DEMO, str(site), str(ROOT / "extensions")]
    env = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(command, cwd=out, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "SAA AA-0000" in done.stdout
    assert re.search(r"recorder: .* hdt_recorder of the package hybrid-digital-twin-extensions reads it", done.stdout)
    assert "AA-0000" in (out / "report.html").read_text(encoding="utf-8")
