"""The benchmark runs, and its page and figures come out of its result."""

import pytest

from benchmarks.estimators import filter_claim, fit_claim
from benchmarks.harness import put, race_table
from benchmarks.spring_mass_damper import contestants, figures, main, tables


@pytest.fixture(scope="module")
def rows():
    return main(seeds=3, slow_seeds=1, estimators=[e for e in contestants() if e.name in ("nls", "pso", "ekf", "ukf")])


def test_benchmark_runs_without_failure(rows):
    assert [(row.n_seeds, row.failures) for row in rows] == [(3, 0)] * 4


def test_tables_follow_from_result(rows, tmp_path):
    """The paper's number stands beside ours; the page's former table is gone."""
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- tables: begin -->\nold\n<!-- tables: end -->\nafter\n")
    text = tables(rows)
    put("tables", text, page)
    assert "| Stiffness [N/m] | 1.959 |" in text
    assert text in page.read_text()
    assert "old" not in page.read_text()


def test_figures_are_drawn(rows, tmp_path):
    assert all(path.stat().st_size > 1000 for path in figures(rows, tmp_path / "plots"))


@pytest.fixture(scope="module")
def claims():
    # the ratios depend on the machine and are the benchmark's to print; that both sides do the same work is a test's
    return fit_claim(rounds=1, records=2), filter_claim(rounds=1, records=2)


def test_peers_give_same_answers(claims):
    fit, filtered = claims
    assert max(fit.apart.values()) < 1e-5
    assert fit.apart["SciPy trf, tolerances of 1e-14"] < 1e-6
    assert max(filtered.apart.values()) < 1e-10


def test_race_table_has_claimed_ratios(claims):
    text = race_table(claims, ["numpy"])
    cells = [line.split(" | ")[5] for line in text.splitlines() if line.count(" | ") > 5][2:]
    assert (cells.count("130 x"), cells.count("100 x")) == (1, 2)
    assert f"{claims[1].ratios['filterpy in a Python loop']:,.0f} x | 100 x" in text
