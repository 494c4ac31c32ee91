"""The benchmark runs, and its page and figures come out of its result."""

from benchmarks.estimators import filter_claim, fit_claim
from benchmarks.harness import put, race_table
from benchmarks.spring_mass_damper import contestants, figures, main, tables


def test_tables_follow_from_result(tmp_path):
    rows = main(seeds=3, slow_seeds=1, estimators=[e for e in contestants() if e.name in ("nls", "pso", "ekf", "ukf")])
    assert [row.n_seeds for row in rows] == [3, 3, 3, 3]
    assert all(row.failures == 0 for row in rows)
    text = tables(rows)
    assert "| Stiffness [N/m] | 1.959 |" in text  # the paper's number stands beside ours
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- tables: begin -->\nold\n<!-- tables: end -->\nafter\n")
    put("tables", text, page)
    assert text in page.read_text()
    assert "old" not in page.read_text()
    assert all(path.stat().st_size > 1000 for path in figures(rows, tmp_path / "plots"))


def test_peers_give_same_answers():
    # the ratios depend on the machine and are the benchmark's to print; that both sides do the same work is a test's
    fit, filtered = fit_claim(rounds=1, records=2), filter_claim(rounds=1, records=2)
    assert max(fit.apart.values()) < 1e-5
    assert fit.apart["SciPy trf, tolerances of 1e-14"] < 1e-6
    assert max(filtered.apart.values()) < 1e-10
    text = race_table([fit, filtered], ["numpy"])
    cells = [line.split(" | ")[5] for line in text.splitlines() if line.count(" | ") > 5][2:]
    assert (cells.count("130 x"), cells.count("100 x")) == (1, 2)
    assert f"{filtered.ratios['filterpy in a Python loop']:,.0f} x | 100 x" in text
