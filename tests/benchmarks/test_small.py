"""Commands of the documentation run, and what they print small is what it was when the tables were written."""

import re
import tomllib
from pathlib import Path

import pytest

from benchmarks import small

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
WRITTEN_BY = re.compile(r"Written by `python -m benchmarks\.[^`]+`(?: at|, stored in) [0-9a-f]{8}\.\s*$")
TABLE = """
## scores

| method | error | time [ms] |
| --- | ---: | ---: |
| nls | 0.0611 ± 0.01 | 3.1 |
"""


def named_commands() -> set[str]:
    """Modules, with their verb, of benchmarks that a page names."""
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    return {" ".join(words).strip() for words in re.findall(r"python -m benchmarks\.(\w+)((?: [a-z][a-z-]+)?)", text)}


def test_documented_command_has_small_run():
    listed = tomllib.loads((ROOT / "benchmarks/small.toml").read_text(encoding="utf-8"))
    runs = [*small.COMMANDS.values(), *small.OF_TIMES.values(), *listed["elsewhere"]]

    missing = {c for c in named_commands() if not any(k.startswith(c.replace("  ", " ")) for k in runs)}

    assert missing == set()


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda p: p.stem)
def test_nothing_follows_main_guard(path):
    _, start, below = path.read_text(encoding="utf-8").partition('if __name__ == "__main__":')

    assert not start or not re.search(r"^\S", below, re.MULTILINE)


@pytest.mark.parametrize(
    ("was", "now", "n_moved"), [("3.1", "9.9", 0), ("0.0611", "0.0622", 1), ("± 0.01", "± 0.02", 1)]
)
def test_scores_are_compared_without_times(was, now, n_moved):
    lines = small.moved(small.cells(TABLE), small.cells(TABLE.replace(was, now)))

    assert len(lines) == n_moved


def test_line_figures_are_compared():
    lines = small.moved(small.cells("tied H of 1.0: 3355"), small.cells("tied H of 1.0: 3400"))

    assert len(lines) == 1


def test_cells_below_nameless_head_keep_columns():
    cells = small.cells("## scores\n|  | nls | ukf |\n| --- | ---: | ---: |\n| damping | 0.1 |  |\n")

    assert cells == {("scores", "damping", 0, "nls"): "0.1", ("scores", "damping", 0, "ukf"): ""}


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda p: p.stem)
def test_written_table_names_its_run(page):
    marked = re.findall(r"<!-- ([\w ]+): begin -->(.*?)<!-- \1: end -->", page.read_text(encoding="utf-8"), re.DOTALL)

    without = [mark for mark, text in marked if not WRITTEN_BY.search(text)]

    assert without == []


def test_readme_names_run_of_its_figures():
    readme = re.search(
        r"Written by `python -m benchmarks\.prognosis.*", (ROOT / "README.md").read_text(encoding="utf-8")
    )

    assert readme
    assert readme[0] in (ROOT / "docs/prognosis.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", small.OF_TIMES)
def test_timing_command_ends_well(name):
    assert small.run(name)


@pytest.mark.parametrize("name", small.COMMANDS)
def test_small_run_prints_stored_figures(name):
    assert small.moved_since(name, small.run(name)) == []


def test_unstored_run_has_moved():
    printed = small.place("promise").read_text(encoding="utf-8")

    assert small.moved_since("promise", printed) == []
    assert small.moved_since("promise", printed.replace("| 283 |", "| 255 |")) != []
