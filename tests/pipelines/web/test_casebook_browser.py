"""The page of cases in a real browser: signing in and out, three people at once, no sideways scroll, no script."""

from collections.abc import Iterator
from ipaddress import ip_network
from pathlib import Path

import pytest
from browsers import NEEDS_CHROMIUM, launched, served
from case_homes import case_home
from playwright.sync_api import Browser, Page, expect

from pipelines.casework import find_case
from pipelines.web import sign_in
from pipelines.web.casebook import application
from pipelines.web.guard import LOCAL
from pipelines.web.sign_in import LocalToken, Person, ProxyHeader

pytestmark = NEEDS_CHROMIUM
HEADER = "X-Remote-User"


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    home = case_home(tmp_path_factory.mktemp("browsed") / "home")
    (home / sign_in.FILE).write_text('[people]\nAda = "engineer"\nBo = "engineer"\nVi = "viewer"\n')
    return home


@pytest.fixture(scope="module")
def address(home: Path) -> Iterator[str]:
    """The page as it is behind the site's proxy."""
    with served(application(home, LOCAL, ProxyHeader(home, HEADER, [ip_network("127.0.0.1")]))) as address:
        yield f"{address}/"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with launched() as browser:
        yield browser


@pytest.fixture
def enter(browser: Browser, address: str):
    """A window of somebody whom the proxy names; in the end its console must be clean, nothing foreign fetched."""
    noted: list[str] = []

    def of(name: str, width: int = 1280) -> Page:
        window = {"width": width, "height": 900}
        page = browser.new_context(viewport=window, extra_http_headers={HEADER: name}).new_page()
        page.on("console", lambda m: noted.append(m.text) if m.type in ("error", "warning") else None)
        page.on("request", lambda r: noted.append(r.url) if not r.url.startswith((address, "data:")) else None)
        page.goto(address)
        expect(page.locator("h1")).to_have_text("Open cases")
        return page

    yield of
    assert [s for s in noted if "409" not in s] == []


def test_browser_signs_in_with_token(browser, home):
    token = LocalToken(Person("ada"))
    with served(application(home, LOCAL, token)) as place:
        address = f"{place}/"
        page, other = (browser.new_context().new_page() for _ in range(2))
        page.goto(f"{address}case/wear?token={token.token}")
        assert page.url == f"{address}case/wear"
        expect(page.locator("header")).to_contain_text("ada, engineer")
        other.goto(address)
        expect(other.locator("h1")).to_have_text("Sign in")
        other.fill("[name=token]", "wrong")
        other.get_by_role("button", name="Sign in").click()
        expect(other.get_by_role("status")).to_contain_text("not the token")
        other.fill("[name=token]", token.token)
        other.get_by_role("button", name="Sign in").click()
        expect(other.locator("h1")).to_have_text("Open cases")
        assert other.url == address
        page.get_by_role("button", name="Sign out").click()
        expect(page.get_by_role("status")).to_contain_text("Signed out")


def test_three_people_work_at_once(enter, home):
    ada, bo, vi = (enter(name) for name in ("Ada", "Bo", "Vi"))
    for page in (ada, bo, vi):
        page.click("a[href='/case/wear']")
    expect(vi.get_by_role("heading", name="Change this case")).to_have_count(0)
    for page, name in ((ada, "Ada"), (bo, "Bo")):
        page.locator("summary", has_text="Assign").click()
        page.locator("[name=assignee]").fill(name)
        page.get_by_role("button", name="Assign").click()
    expect(ada.get_by_role("status")).to_contain_text("assigned to Ada")
    expect(bo.get_by_role("status")).to_contain_text("Ada changed this case in the meantime")
    bo.locator("summary", has_text="Close").click()
    bo.locator("[name=finding]").select_option("clean")
    bo.locator("[name=on]").fill("2024-04-09")
    bo.get_by_role("button", name="Close", exact=True).click()
    expect(bo.get_by_role("status")).to_contain_text("found clean")
    vi.reload()
    expect(vi.locator("main")).to_contain_text("closed, with Ada")
    case = find_case(home, "wear")
    assert (case["owner"], case["found_by"], case["state"]) == ("Ada", "Bo", "closed")


@pytest.mark.parametrize("width", [390, 800, 1280])
def test_page_fits_the_window(enter, width):
    page = enter("Ada", width)
    for path in ("", "case/clog"):
        if path:
            page.click("a[href='/case/clog']")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("document.documentElement.scrollHeight") <= 4 * 844, "four screens of a phone"
