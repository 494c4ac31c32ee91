"""The page in headless Chromium: no error, no sideways scroll, search, sort, zoom, units, dark ground and paper."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from browsers import NEEDS_CHROMIUM, launched
from playwright.sync_api import Browser, Page

from pipelines.report.page import write_report

pytestmark = NEEDS_CHROMIUM


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with launched() as browser:
        yield browser


@pytest.fixture(scope="module")
def report(sample_home: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    page = tmp_path_factory.mktemp("report") / "report.html"
    write_report(sample_home, page)
    return page.as_uri()


@pytest.fixture
def open_page(browser: Browser, report: str):
    """The page in a window of a width, whose console must stay clean."""
    pages: list[Page] = []
    console: list[str] = []

    def show(width: int = 1280, dark: bool = False) -> Page:
        page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme="dark" if dark else "light")
        page.on("console", lambda m: console.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: console.append(str(error)))
        page.on("request", lambda r: console.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
        page.goto(report)
        pages.append(page)
        return page

    yield show
    for page in pages:
        page.close()
    assert console == []


def ranking(page: Page) -> list[str]:
    return page.locator("#tonight tbody tr:not([hidden]) td:nth-child(1) a").all_text_contents()


@pytest.fixture(params=[390, 800, 1280])
def page(open_page, request) -> Page:
    """The page in windows from a phone's to a desk's."""
    return open_page(request.param)


def test_page_fits_the_window(page):
    assert page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth") <= 0
    assert len(ranking(page)) == 4


@pytest.mark.parametrize("width", [800, 1280])
def test_ranking_is_a_table(open_page, width):
    page = open_page(width)
    assert page.locator("#tonight thead").first.evaluate("head => head.getBoundingClientRect().height") > 10
    assert page.locator("#tonight td").first.evaluate("cell => getComputedStyle(cell).display") == "table-cell"


def test_search_filters_every_part(page):
    page.fill("#find", "a9-bac 2")
    assert ranking(page) == ["A9-BAC pack 2 (right)"]
    assert page.locator("#tracks article:not([hidden])").count() == 1
    page.fill("#find", "nothing of that name")
    assert page.locator("#tonight [data-group]:visible").count() == 0


def test_search_opens_closed_alerts(page):
    """They lie folded, on paper too, until something among them is looked for."""
    folds = page.locator("#alerts details", has=page.locator("[data-find]"))
    for text, is_open in (("a9-bac 2", True), ("", False)):
        page.fill("#find", text)
        assert folds.evaluate_all("all => all.map((d) => d.open)") == [is_open]


def test_losses_sort_both_ways(page):
    table = page.locator("#tonight table").first
    button = table.locator("th button", has_text="Share lost")
    losses = "rows => rows.map((r) => Number(r.cells[2].dataset.v))"
    ways = []
    for _ in range(2):
        button.dispatch_event("click")
        ways.append(table.locator("tbody tr").evaluate_all(losses))
    assert ways == [sorted(ways[0]), sorted(ways[0], reverse=True)]


def test_every_link_leads_somewhere(page):
    assert page.evaluate("[...document.querySelectorAll('a')].every(a => document.querySelector(a.hash))")


def test_chart_zooms_by_dates(open_page):
    page = open_page()
    chart = page.locator("#tracks .track").first
    chart.scroll_into_view_if_needed()
    visible_days = "chart => [...chart.querySelectorAll('.day')].filter((d) => d.style.display !== 'none').length"
    view = chart.locator(".plot")
    days = chart.evaluate(visible_days)
    box = chart.bounding_box()
    assert days > 1
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] * 0.45, middle)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.55, middle, steps=5)
    page.mouse.up()
    start, _, width, _ = map(float, view.get_attribute("viewBox").split())
    assert (start, width) == (pytest.approx(450, abs=15), pytest.approx(100, abs=15))
    assert chart.evaluate(visible_days) < days
    chart.dblclick()
    assert view.get_attribute("viewBox") == "0 0 1000 1000"
    assert chart.evaluate(visible_days) == days


def test_units_switch_without_mixture(open_page):
    page = open_page()
    page.locator("summary", has_text="Model against data").click()
    si = page.locator("main").inner_text()
    assert re.search(r"\d °C|\d K\b|\bK\n", si)
    assert "°F" not in si
    figures = page.locator("#figures")
    visible = [figures.locator("img.si:visible"), figures.locator("img.us:visible")]
    assert [images.count() for images in visible] == [3, 0]
    page.select_option("#units", "us")
    us = page.locator("main").inner_text()
    assert "°F" in us
    assert not re.search(r"°C|\d K\b|kg/s|W/K", us)
    assert [images.count() for images in visible] == [0, 3]


def test_figures_suit_either_ground(open_page):
    page = open_page(dark=True)
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(22, 22, 22)"
    page.locator("summary", has_text="Model against data").click()
    image = page.locator("#figures img:visible").first
    assert image.evaluate("img => img.decode().then(() => img.naturalWidth)") > 300
    assert image.evaluate("img => getComputedStyle(img).filter").startswith("invert")
    page.emulate_media(color_scheme="light")
    assert image.evaluate("img => getComputedStyle(img).filter") == "none"


def test_paper_holds_urgent_packs(open_page, tmp_path):
    page = open_page(800)
    urgent = page.locator("#tracks > .cards > article").count()
    assert urgent
    page.pdf(path=tmp_path / "report.pdf", prefer_css_page_size=True)
    sheets = len(re.findall(rb"/Type /Page\b", (tmp_path / "report.pdf").read_bytes()))
    assert 1 <= sheets <= 4
    page.emulate_media(media="print")
    assert page.locator("#tracks .track:visible").count() == urgent
    assert page.locator("#quarantine").is_hidden()
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"


def test_documentation_pictures_are_drawn(sample_home, tmp_path):
    """As those in docs/images are; in a process of its own, for the browser of these tests holds this one's loop."""
    root = Path(__file__).parents[3]
    run = [sys.executable, "docs/pictures.py", sample_home, tmp_path]
    env = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(run, cwd=root, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in ("report.png", "alert.png"):
        for picture in (tmp_path / name, root / "docs" / "images" / name):
            assert picture.read_bytes().startswith(b"\x89PNG")
            assert 10_000 < picture.stat().st_size < 150_000
