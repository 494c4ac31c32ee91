"""The page of cases in a real browser: three people at once, no script, no sideways scroll, nothing from outside."""

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
from case_homes import case_home
from playwright.sync_api import Browser, Page, expect, sync_playwright

from pipelines.casework.listing import find_case
from pipelines.web.address import LOCAL, listening
from pipelines.web.casebook import application
from pipelines.web.people import add_person

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
PASSWORD = "correct horse 7"


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    made = case_home(tmp_path_factory.mktemp("browsed") / "home")
    for name, role in (("Ada", "engineer"), ("Bo", "engineer"), ("Vi", "viewer")):
        add_person(made, name, role, (), PASSWORD)
    return made


@pytest.fixture(scope="module")
def address(home: Path) -> Iterator[str]:
    """The page, served on the loopback."""
    with listening("127.0.0.1", 0) as sock:
        server = uvicorn.Server(uvicorn.Config(application(home, LOCAL), log_level="warning"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [sock]})
        thread.start()
        yield f"http://127.0.0.1:{sock.getsockname()[1]}/"
        server.should_exit = True
        thread.join()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as started:
        yield started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])


@pytest.fixture
def enter(browser: Browser, address: str):
    """A window of somebody who has logged in; what its console said and what it fetched is looked at in the end."""
    said: list[str] = []

    def of(name: str, width: int = 1280) -> Page:
        page = browser.new_context(viewport={"width": width, "height": 900}).new_page()
        page.on("console", lambda m: said.append(m.text) if m.type in ("error", "warning") else None)
        page.on("request", lambda r: said.append(r.url) if not r.url.startswith((address, "data:")) else None)
        page.goto(address)
        page.fill("[name=name]", name)
        page.fill("[name=password]", PASSWORD)
        page.click("main button")
        expect(page.locator("h1")).to_have_text("Open cases")
        return page

    yield of
    assert [s for s in said if "409" not in s] == []


def test_three_people_work_at_once_and_the_second_is_told(enter, home):
    ada, bo, vi = (enter(name) for name in ("Ada", "Bo", "Vi"))
    for page in (ada, bo, vi):
        page.click("a[href='/case/wear']")
    expect(vi.get_by_role("heading", name="What to say")).to_have_count(0)
    for page, name in ((ada, "Ada"), (bo, "Bo")):
        page.locator("form", has=page.get_by_role("heading", name="Assign")).locator("[name=assignee]").fill(name)
        page.get_by_role("button", name="Assign").click()
    expect(ada.get_by_role("status")).to_contain_text("assigned to Ada")
    expect(bo.get_by_role("status")).to_contain_text("Ada changed this case in the meantime")
    bo.locator("form", has=bo.get_by_role("heading", name="Close")).locator("[name=finding]").select_option("clean")
    bo.locator("[name=on]").fill("2024-04-09")
    bo.get_by_role("button", name="Close", exact=True).click()
    expect(bo.get_by_role("status")).to_contain_text("found clean")
    vi.reload()
    expect(vi.locator("main")).to_contain_text("answered, with Ada")
    found = find_case(home, "wear")
    assert (found["owner"], found["found_by"], found["state"]) == ("Ada", "Bo", "answered")
    vi.get_by_role("button", name="Log out").click()
    expect(vi.locator("h1")).to_have_text("Log in")


@pytest.mark.parametrize("width", [390, 800, 1280])
def test_it_fits_the_window(enter, width):
    page = enter("Ada", width)
    for path in ("", "case/clog"):
        if path:
            page.click("a[href='/case/clog']")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
