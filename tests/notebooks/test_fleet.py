"""The notebook over the catalog: every cell runs, and what hangs on a choice follows it."""

from pathlib import Path

import pytest
from marimo_notebooks import load_notebook, marimo_faults

NOTEBOOK = Path(__file__).parents[2] / "notebooks/fleet.py"


@pytest.fixture(scope="module")
def notebook():
    return load_notebook(NOTEBOOK)


@pytest.fixture
def at_home(sample_home, monkeypatch):
    monkeypatch.setenv("HDT_HOME", str(sample_home))


def test_every_cell_runs(notebook, at_home):
    _, cells = notebook.app.run()
    assert set(cells["ranking"]["tail"]) == {"LX-AAB", "A9-BAC"}
    assert cells["health"].height > 100
    assert cells["lives"].height >= cells["ranking"].height
    assert cells["said"]["on_date"].unique().to_list() == [cells["last"]]
    assert cells["heard"].height == 16
    cells["con"].close()


def test_tables_follow_picked_pack(notebook, at_home):
    class Picked:
        value = ("BZR", "A9-BAC", 1)

    _, cells = notebook.app.run(defs={"pick": Picked, "packs": {}})
    condition = "where operator = 'BZR' and tail = 'A9-BAC' and pack = 1"
    assert cells["alerts"].height == cells["con"].sql(f"from alerts {condition}").pl().height > 0
    figure = notebook.track(cells["health"], cells["alerts"], cells["work"])
    fouling = cells["health"].filter(parameter="hx_fouling")
    curve = figure.axes[0].lines[0].get_ydata()
    assert curve.tolist() == pytest.approx((100 * fouling["value"]).to_list())
    cells["con"].close()


def test_marimo_accepts_notebook():
    assert marimo_faults(NOTEBOOK) == ""
