"""The documentation is true: its examples run, its commands exist, its site asks nothing of the network."""

import doctest
import importlib
import inspect
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pytest
import typer

import hdt_core
from benchmarks.fault_points import fingerprint
from hdt_benchmark.spring_mass_damper import TRUTH, oscillator_problem
from pipelines.cli import app, load_extensions
from pipelines.storage.catalog import connect

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
ROOMS = (".", "hdt_core", "tests/hdt_core")
"""Folders from which pages name files."""
MODULES = [
    m.name
    for m in pkgutil.walk_packages(hdt_core.__path__, "hdt_core.")
    if ">>>" in inspect.getsource(importlib.import_module(m.name))
]


def blocks(page: Path) -> list[str]:
    """Code of a page: fenced, or indented by four."""
    text = page.read_text(encoding="utf-8")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    rest = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return fenced + [textwrap.dedent(b) for b in re.findall(r"(?:(?<=\n\n)|\A)((?: {4}.*\n|\n(?= {4}))+)", rest)]


def commands(page: Path) -> list[list[str]]:
    """Words of each `hdt` command in the code of a page, quotes over several lines joined."""
    all_commands = []
    for block in blocks(page):
        for line in re.findall(r"^(?:\S*/)?hdt ((?:\"[^\"]*\"|[^\n\"])*)", block, flags=re.MULTILINE):
            words = shlex.split(line, comments=True)
            all_commands += [words[: words.index("&&")] if "&&" in words else words]
    return all_commands


load_extensions()  # the pages name their commands, too
COMMANDS = [(page, words) for page in PAGES for words in commands(page)]


@pytest.mark.parametrize("name", MODULES)
def test_worked_examples_hold(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0


@pytest.mark.parametrize("words", [w for _, w in COMMANDS], ids=[f"{w[0]}-{p.stem}" for p, w in COMMANDS])
def test_documented_command_is_accepted(words):
    command = typer.main.get_command(app)
    name, sub, rest = command.resolve_command(typer.Context(command), words)
    sub.make_context(name, rest)


def test_documented_queries_answer(sample_home):
    # a component of one's own is not in the sample: tests/pipelines/test_own_component.py asks that page's
    queries = [w[-1] for p, w in COMMANDS if w[0] == "query" and p.stem != "howto-component"]
    assert queries
    with connect(sample_home) as con:
        assert all(con.sql(sql).fetchall() for sql in queries)


def test_documented_readers_read_tables(sample_home):
    page = (ROOT / "docs/storage.md").read_text(encoding="utf-8").split("## Read the tables")[1]
    code = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    namespace: dict[str, object] = {}
    exec(code.replace('"hdt_home"', repr(str(sample_home))), namespace)
    with connect(sample_home) as con:
        flights = con.execute("select count(*) from flights").fetchone()[0]
    assert namespace["as_arrow"].num_rows == flights
    assert sum(n for _, n in namespace["per_tail"].fetchall()) == flights
    assert namespace["worn"].width == 4


def test_tutorial_python_runs(sample_home, monkeypatch):
    (code,) = [b for b in blocks(ROOT / "docs/tutorial.md") if b.startswith("import duckdb")]
    monkeypatch.chdir(sample_home)
    namespace: dict[str, object] = {}
    with duckdb.connect("catalog.duckdb", read_only=True):
        exec(code.replace("hdt_home/", ""), namespace)
    assert namespace["frame"].height > 0


def run_python(page: str) -> dict[str, Any]:
    """The names that the Python of a page leaves."""
    code = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    names: dict[str, Any] = {}
    exec("\n".join(code), names)
    return names


def test_file_equations_give_papers_line(monkeypatch):
    monkeypatch.chdir(ROOT)

    names = run_python("howto-equations.md")

    assert names["intercept_m"] == pytest.approx(0.1731, abs=0.005)
    assert 500.0 < np.nanmedian(names["ua_w_k"]) < 3000.0


def test_example_estimator_keeps_the_contract():
    estimate = run_python("howto-estimator.md")["RandomSearch"]().estimate(oscillator_problem(seed=0))

    assert estimate.status == "converged"
    assert (np.abs(estimate.belief.mean - TRUTH) < 4.0 * estimate.belief.sd).all()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_named_files_exist(page):
    paths = re.findall(r"`([\w.-]+/[\w./-]+\.(?:py|sql))`", page.read_text(encoding="utf-8"))

    missing = [p for p in paths if "NAME" not in p and not any((ROOT / room / p).exists() for room in ROOMS)]

    assert missing == []


def site(target: Path) -> Path:
    """The site that `make check` has built, where nothing it is made of has changed since; else one in `target`."""
    built = ROOT / ".site/sitemap.xml"
    sources = [ROOT / name for name in ("docs", "hdt_core", "extensions/hdt_recorder", "mkdocs.yml")]
    newest = max(f.stat().st_mtime for s in sources for f in (s, *s.rglob("*")) if "__pycache__" not in f.parts)
    if built.exists() and built.stat().st_mtime > newest:
        return built.parent
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(target)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


def test_site_fetches_nothing_elsewhere(tmp_path):
    """`--strict`: no page, link or anchor may be missing."""
    pages = list(site(tmp_path).rglob("*.html"))
    assert len(pages) > 15
    assert fetched(pages, FETCHED) == {}


FETCHED = r"<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^\"' >]+"


def fetched(pages: list[Path], pattern: str) -> dict[str, list[str]]:
    """What pages have a reader fetch from elsewhere."""
    return {p.name: links for p in pages if (links := re.findall(pattern, p.read_text(encoding="utf-8")))}


def test_pages_fetch_nothing_elsewhere():
    """What the site adds to the pages is seen where it is built, in the long tests; its fonts are the browser's."""
    written = rf"{FETCHED}|!\[[^\]]*\]\(https?:|url\([\"']?http|@import"
    assert fetched([*PAGES, *(ROOT / "docs").glob("*.css")], written) == {}
    assert "  font: false\n" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES[:2], ids=lambda p: p.stem)
def test_links_of_root_pages_hold(page):
    links = re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_every_room_has_its_page():
    rooms = {p.name for p in (ROOT / "hdt_core").iterdir() if (p / "__init__.py").exists()}
    pages = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "docs/api").glob("*.md"))
    assert rooms == set(re.findall(r"^::: hdt_core\.(\w+)$", pages, flags=re.MULTILINE))


def test_every_command_is_documented():
    assert {words[0] for _, words in COMMANDS} >= {c.name or c.callback.__name__ for c in app.registered_commands}


def test_backup_restores_home(own_home, tmp_path):
    """Line by line as the page has it, under other names."""
    landing, home = own_home
    before = fingerprint(home)
    backup, restore = blocks(ROOT / "docs/howto-backup.md")
    tools = f'PATH="{Path(sys.executable).parent}:$PATH"; set -e; '

    def run(lines: str) -> str:
        for name, path in (("/data/hdt", home), ("/data/landing", landing), ("/backup/hdt", tmp_path / "backup")):
            lines = lines.replace(name, str(path))
        return subprocess.run(["bash", "-c", tools + lines], capture_output=True, text=True, check=True).stdout

    run(backup)
    shutil.rmtree(home)
    printed = run(restore)

    assert "Nothing new" in printed
    assert fingerprint(home) == before
