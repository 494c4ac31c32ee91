"""The dashboard in a real browser: each tab shows what the catalog has, an operator less is an operator less."""

import os
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest
from browsers import NEEDS_CHROMIUM, launched
from playwright.sync_api import Page, expect
from streamlit.testing.v1 import AppTest

ROOT = Path(__file__).parents[2]
pytestmark = NEEDS_CHROMIUM


@pytest.fixture(scope="module")
def address(sample_home: Path) -> Iterator[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    run = [sys.executable, "-m", "streamlit", "run", "notebooks/dashboard.py", f"--server.port={port}"]
    server = subprocess.Popen(run, cwd=ROOT, env=os.environ | {"HDT_HOME": str(sample_home)})
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        server.terminate()
        server.wait(20)


@pytest.fixture(scope="module")
def page(address: str) -> Iterator[Page]:
    """The page when its tabs are there; what it fetched from elsewhere is looked at in the end."""
    elsewhere: list[str] = []
    with launched() as browser:
        page = browser.new_page()
        page.set_default_timeout(60_000)
        page.on("request", lambda r: None if r.url.startswith((address, "data:", "blob:")) else elsewhere.append(r.url))
        for _ in range(200):
            try:
                urllib.request.urlopen(f"{address}_stcore/health").close()
                break
            except OSError:
                page.wait_for_timeout(100)
        page.goto(address)
        page.get_by_role("tab", name="Tonight").wait_for()
        yield page
    assert elsewhere == []


def metric(page: Page, label: str) -> str:
    return page.get_by_test_id("stMetric").filter(has_text=label).get_by_test_id("stMetricValue").inner_text()


@pytest.fixture
def con(sample_home):
    with duckdb.connect(str(sample_home / "catalog.duckdb"), read_only=True) as con:
        yield con


@pytest.mark.parametrize("tab", ["Tonight", "Wear", "Leads", "Costs", "Seasons"])
def test_tab_shows_table_or_chart(page, tab):
    page.get_by_role("tab", name=tab).click()
    panel = page.get_by_role("tabpanel").filter(visible=True)
    expect(panel.locator("canvas, [data-testid=stVegaLiteChart] svg").first).to_be_visible()
    expect(page.get_by_test_id("stException")).to_have_count(0)


def test_figures_follow_chosen_operators(page, con):
    def figures_of(where: str) -> tuple[int, int, str]:
        ((plan,),) = con.sql(f"select count(*) from fleet_ranking where urgency = 'plan' and {where}").fetchall()
        ((n_messages, cost),) = con.sql(
            f"select sum(n_messages)::int, sum(expected_message_cost) from operator_costs where {where}"
        ).fetchall()
        return plan, n_messages, f"{cost:,.0f}"

    def page_figures() -> tuple[int, int, str]:
        return int(metric(page, "Plan")), int(metric(page, "so far")), metric(page, "to expect")

    assert page_figures() == figures_of("true")
    assert figures_of("true") != figures_of("operator = 'BZR'")
    page.get_by_test_id("stSidebar").get_by_role("button", name="Remove AQX").click()
    expect(page.get_by_test_id("stMetric").filter(has_text="so far")).to_contain_text(
        str(figures_of("operator = 'BZR'")[1])
    )
    assert page_figures() == figures_of("operator = 'BZR'")


def test_missing_catalog_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("HDT_HOME", str(tmp_path))
    app = AppTest.from_file(str(ROOT / "notebooks/dashboard.py")).run()
    assert str(tmp_path / "catalog.duckdb") in app.error[0].value
