"""docs/paper.md maps every equation, table and figure of the paper to code, test and plot that are there."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest

from hdt_core.components import components
from hdt_core.tables.raw import SIGNALS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
TESTS = "tests/hdt_core"
ITEMS = {("eq", n) for n in range(1, 9)} | {("fig", n) for n in range(1, 17)} | {("table", n) for n in range(1, 4)}


class Row(NamedTuple):
    """A row of the map: its item, and the code, tests and plots it names."""

    item: str
    code: str
    test: str
    plot: str


ROWS = [
    Row(item, code, test, plot)
    for item, _, code, test, plot in (
        [cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("| ")
    )
    if item not in ("paper", "---")
]


def numbers(item: str) -> set[tuple[str, int]]:
    """What `eqs (2)-(4)`, `fig. 4, 5` or `tables 1, 2` speak of."""
    kind = re.match(r"(eq|fig|table)s?\b", item)
    if kind is None:
        return set()
    listed = [int(n) for n in re.findall(r"\d+", item)]
    return {(kind[1], n) for n in (range(listed[0], listed[-1] + 1) if "-" in item else listed)}


def named(cell: str, below: str) -> tuple[list[Path], list[str]]:
    """Paths and symbols in the backticks of a cell; a bare file lies beside the one before it."""
    paths: list[Path] = []
    symbols: list[str] = []
    for word in re.findall(r"`([^`]+)`", cell):
        beside = [paths[-1].parent / word] if paths else []
        there = [p for p in (ROOT / below / word, ROOT / word, *beside) if p.exists()]
        if there:
            paths.append(there[0])
        elif "/" in word or word.endswith(".py"):
            raise AssertionError(f"docs/paper.md names {word}, which is not there")
        elif " " not in word:
            symbols.append(word)
    return paths, symbols


def defined(symbol: str, paths: list[Path]) -> bool:
    files = [f for p in paths for f in ([p] if p.is_file() else p.rglob("*.py"))]
    pattern = re.compile(rf"^\s*(def|class) {symbol}\b|^{symbol}\b.* = ", re.MULTILINE)
    return any(pattern.search(f.read_text(encoding="utf-8")) for f in files)


def test_every_paper_item_has_row():
    items = [numbers(row.item) for row in ROWS]
    assert set().union(*items) == ITEMS
    assert sum(map(len, items)) == len(ITEMS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.item)
def test_row_names_present_code(row):
    code, symbols = named(row.code, "hdt_core")
    plots, plotted = named(row.plot, ".")
    assert code
    assert named(row.test, TESTS)[0]
    assert [s for s in symbols if not defined(s, code)] == []
    assert [s for s in plotted if not defined(s, plots)] == []


@pytest.mark.parametrize("row", [row for row in ROWS if row.item.startswith("eq")], ids=lambda row: row.item)
def test_tests_call_functions_of_equation(row):
    tests = "\n".join(f.read_text(encoding="utf-8") for f in named(row.test, TESTS)[0])
    assert [s for s in named(row.code, "hdt_core")[1] if s not in tests] == []


def test_cited_methods_are_in_place():
    below = PAGE[PAGE.rindex("| [physics from an FMU]") :]
    assert len(named(below, "hdt_core")[0]) == 7


NOMENCLATURE = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in (ROOT / "docs/theory.md").read_text(encoding="utf-8").split("## Nomenclature")[1].splitlines()
    if line.startswith("| ") and "`" in line
]
TERMS = {name: (row[2], row[4].strip("`")) for row in NOMENCLATURE for name in re.findall(r"`(\w+)`", row[1])}


def test_nomenclature_has_declared_units():
    """Of every signal and parameter of the pack."""
    models = [components()[code].model for code in ("HX", "CC")]
    units = {d.name: d.unit for model in models for d in (*model.inputs, *model.outputs, *model.params)}
    assert units == {name: TERMS[name][0] for name in units}


def test_nomenclature_has_every_recorded_signal():
    assert set(SIGNALS) <= set(TERMS)


@pytest.mark.parametrize("name", TERMS)
def test_nomenclature_name_stands_in_place(name):
    assert re.search(rf"\b{name}\b", (ROOT / "hdt_core" / TERMS[name][1]).read_text(encoding="utf-8"))
