"""The page of cases: nobody's cases but one's own, nothing changed from elsewhere, and no request that breaks it."""

import itertools
import re
import shutil
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from ipaddress import ip_network
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest
from asgi_client import Client
from browsers import served
from case_homes import case_home, publish_losses

from hdt_core.alerts.succession import FOLLOW, WITHDRAW
from pipelines.casework import find_case, history_of
from pipelines.digest.changes import Digest
from pipelines.storage.cases import FILE, NIGHT, CaseLog
from pipelines.storage.catalog import CATALOG
from pipelines.web import sign_in
from pipelines.web.casebook import application
from pipelines.web.guard import LOCAL
from pipelines.web.sign_in import LocalToken, Person, ProxyHeader

ROLES = """[people]
Vi = "viewer"
Eng = "engineer"
Own = { role = "engineer", operators = ["AAA"] }
Else = { role = "viewer", operators = ["BBB"] }
"""
HEADER = "X-Remote-User"
HOSTILE = "<script>alert(1)</script> {{ 7 * 7 }}"


@pytest.fixture(scope="module")
def template_home(tmp_path_factory) -> Path:
    home = case_home(tmp_path_factory.mktemp("page") / "home")
    (home / sign_in.FILE).write_text(ROLES)
    return home


@pytest.fixture(scope="module")
def home(template_home, tmp_path_factory) -> Path:
    return Path(shutil.copytree(template_home, tmp_path_factory.mktemp("open") / "home"))


@pytest.fixture
def fresh_home(template_home, tmp_path) -> Path:
    return Path(shutil.copytree(template_home, tmp_path / "home"))


@pytest.fixture
def page(home):
    """The page as somebody gets it through the site's proxy."""
    (home / FILE).unlink(missing_ok=True)
    return lambda name: by_proxy(home, name)


def by_proxy(home: Path, name: str) -> Client:
    app = application(home, LOCAL, ProxyHeader(home, HEADER, [ip_network("127.0.0.1")]))
    return Client(app, {HEADER: name})


def page_of(home: Path, name: str = "Eng", **fields: object) -> Client:
    """The page of somebody who has signed in."""
    return Client(application(home, LOCAL, lambda request: Person(name, **fields)))


def change(client: Client, alert: str, kind: str, line: int = 0, **fields: str):
    return client.post(f"/case/{alert}", data={"kind": kind, "seen": str(line)} | fields)


def history(home: Path, alert: str = "wear") -> list[dict]:
    return history_of(home, find_case(home, alert))


@pytest.mark.parametrize("path", ["/", "/case/wear", "/?all", "/docs"])
def test_stranger_sees_nothing(page, path):
    answer = page("Eve").get(path)
    assert answer.status_code == 403
    assert "T-1" not in answer.text


@pytest.mark.parametrize("name", ["Eve", "Vi"])
def test_only_engineer_changes_a_case(page, home, name):
    """Neither who has no role nor a viewer."""
    assert change(page(name), "wear", "acknowledge").status_code == 403
    assert history(home) == []


def test_viewer_sees_no_form(page):
    assert "Change this case" not in page("Vi").get("/case/wear").text


def test_engineer_closes_a_case(page, home):
    client = page("Eng")
    assert "T-1 pack 1 (left)" in client.get("/").text
    assert "acknowledged" in change(client, "wear", "acknowledge").text
    assert "assigned to Bo" in change(client, "wear", "assign", 1, assignee="Bo").text
    done = change(client, "wear", "close", 2, finding="clean", on="2024-04-09", note="looked")
    assert "no fault found, inspected on 2024-04-09" in done.text
    case = find_case(home, "wear")
    assert (case["state"], case["found_by"], case["owner"]) == ("closed", "Eng", "Bo")
    assert "assigned to Bo" not in client.get("/").text


def test_page_has_no_other_addresses(page):
    assert page("Eng").get("/docs").status_code == 404


def test_proxy_page_has_no_logout(page):
    """Who comes by the proxy has no session of ours to end."""
    client = page("Eng")
    assert "Sign out" not in client.get("/").text
    assert client.post("/logout").status_code == 404


def test_changes_fold_into_lines(fresh_home, monkeypatch):
    """The packs in need of attention stay on the first screen, however much changed."""
    gaps = [{"operator": "AAA", "tail": f"T-{n}", "gap": "never_heard", "n_flights": None} for n in range(9)]
    monkeypatch.setattr("pipelines.web.casebook.changes_since", lambda _: Digest("then", "now", {"gap": gaps}))
    text = by_proxy(fresh_home, "Eng").get("/").text
    line, _, opened = text.partition("<details><summary>Data gaps: ")[2].partition("</summary>")
    assert line == ", ".join(f"AAA T-{n}" for n in range(9))
    assert opened.count("<li><b>AAA T-") == 9


@pytest.mark.parametrize(
    ("name", "path", "own", "foreign"),
    [("Own", "/?all", "T-1", "BBB"), ("Else", "/", "T-9", "T-1"), ("Eng", "/", "BBB", None)],
)
def test_operator_sees_own_cases(page, name, path, own, foreign):
    text = page(name).get(path).text
    assert own in text
    assert foreign is None or foreign not in text


def test_foreign_case_is_hidden(page, home):
    client = page("Own")
    for answer in (client.get("/case/other"), change(client, "other", "acknowledge"), client.get("/case/none")):
        assert answer.status_code == 404
        assert "T-9" not in answer.text
        assert "There is no such case." in answer.text
    assert client.get("/case/othe").status_code == 404, "nor by a part of the id"
    assert history(home, "other") == []


def test_operator_changes_own_case(page):
    assert change(page("Own"), "wear", "acknowledge").status_code == 200


def test_first_table_links_to_cases(page):
    """Bars are drawn though the page allows no style of an element; another operator's people have no such row."""
    first = page("Eng").get("/").text.partition("<table")[2].partition("</table>")[0]
    links = [("/case/wear", "T-1 pack 1 (left)"), ("/case/other", "T-9 pack 1 (left)")]
    assert re.findall(r'<a href="([^"]+)"><b>([^<]+)</b>', first) == links
    assert "20\N{NO-BREAK SPACE}% (18 to 22)" in first
    assert "style=" not in first


@pytest.mark.parametrize("path", ["/", "/case/wear"])
def test_page_needs_no_other_machine(page, path):
    assert re.findall(r'(?:src|href|action)="(?!/|data:)', page("Eng").get(path).text) == []


def test_night_shows_at_once(tmp_path):
    home = case_home(tmp_path / "home")
    client = page_of(home)
    assert "20\N{NO-BREAK SPACE}% (18 to 22)" in client.get("/").text
    publish_losses(home, 0.3)
    assert "30\N{NO-BREAK SPACE}% (28 to 32)" in client.get("/").text


@pytest.fixture
def with_withdrawn(fresh_home):
    """A home whose log holds a case that went on from alert `first` to alert `last`, and was withdrawn."""
    log = CaseLog(fresh_home)
    ours = find_case(fresh_home, "wear") | {"alert_id": "first"}
    log.append(ours, "assign", "Ada", {"assignee": "Bo", "note": "look at it"})
    for kind in (FOLLOW, WITHDRAW):
        log.append(
            ours | {"alert_id": "last"}, kind, NIGHT, {"case_id": "first", "raised_then": "2024-03-05 00:00:00+00:00"}
        )
    return fresh_home


@pytest.mark.parametrize("name", ["first", "last"])
def test_withdrawn_link_still_answers(with_withdrawn, name):
    answer = page_of(with_withdrawn).get(f"/case/{name}")
    assert answer.status_code == 200
    for words in (f"withdrawn by the night of {datetime.now(UTC):%Y-%m-%d}", "raised 2024-03-05", "look at it"):
        assert words in answer.text


def test_withdrawn_case_takes_no_line(with_withdrawn):
    lines = CaseLog(with_withdrawn).entries().height
    assert change(page_of(with_withdrawn), "first", "acknowledge", lines).status_code == 409
    assert CaseLog(with_withdrawn).entries().height == lines


def test_withdrawn_case_stays_private(with_withdrawn):
    assert page_of(with_withdrawn, "Else", operators=("BBB",)).get("/case/first").status_code == 404


def test_foreign_form_changes_nothing(page, home):
    client = page("Eng")
    good = {"kind": "acknowledge", "seen": "0"}
    assert client.post("/case/wear", data=good, headers={"origin": "http://evil.example"}).status_code == 403
    assert client.get("/case/wear", params=good).status_code == 200
    assert history(home) == []
    assert client.post("/case/wear", data=good).status_code == 200


def test_token_opens_a_session(home):
    """Lines bear the account's name; signing out ends it."""
    (home / FILE).unlink(missing_ok=True)
    token = LocalToken(Person("ada"))
    client = Client(application(home, LOCAL, token))
    assert 'name="token"' in client.get("/").text
    client.get(f"/?token={token.token}")
    assert "Sign out" in client.get("/").text
    change(client, "wear", "acknowledge")
    assert history(home)[0]["person"] == "ada"
    assert client.post("/logout").status_code == 200
    assert client.get("/").status_code == 401


def test_notes_are_escaped(page):
    """As is what the catalog holds."""
    client = page("Eng")
    change(client, "wear", "acknowledge", note=HOSTILE)
    change(client, "wear", "assign", 1, assignee='"><img src=x>')
    cases, case = (client.get(path).text for path in ("/", "/case/wear"))
    assert [tag for tag in ("<script", "<img", "<b>wash</b>") if tag in cases + case] == []
    assert "&lt;script&gt;alert(1)&lt;/script&gt; {{ 7 * 7 }}" in case


@pytest.mark.parametrize("path", ["/", "/case/wear"])
def test_headers_forbid_scripts(page, path):
    headers = page("Eng").get(path).headers
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "script-src" not in headers["content-security-policy"]
    assert (headers["cache-control"], headers["x-content-type-options"]) == ("no-store", "nosniff")


def test_late_change_names_the_first(page, home):
    two = page("Own")
    assert change(page("Eng"), "wear", "assign", 0, assignee="Eng").status_code == 200
    late = change(two, "wear", "assign", 0, assignee="Own")
    assert late.status_code == 409
    assert "Nothing was written: Eng changed this case in the meantime" in late.text
    assert find_case(home, "wear")["owner"] == "Eng"
    assert change(two, "wear", "assign", 1, assignee="Own").status_code == 200


@pytest.mark.parametrize(
    ("kind", "fields", "status"),
    [
        ("close", {"finding": "rusty"}, 422),
        ("drop table", {}, 400),
        ("acknowledge", {"seen": "-1"}, 400),
        ("acknowledge", {"seen": "9" * 5_000}, 400),
        ("acknowledge", {"seen": "١"}, 400),
        ("acknowledge", {"note": "x" * 70_000}, 413),
    ],
)
def test_senseless_form_is_refused(page, home, kind, fields, status):
    assert change(page("Eng"), "wear", kind, **({"seen": 0} | fields)).status_code == status
    assert history(home) == []


VALUES = ("", "0", "-1", "1e999", "9" * 5_000, "NaN", "9999-12-31", "0001-01-01", "0001-01-01T00:00+23:59",
          "9999-12-31T23:59:59-23:59", "2024-02-30", "2024-W01-1", "\x00", "\ud7ff\uffff", "%",
          "'; drop table cases; --", "../../etc/passwd", "\N{RIGHT-TO-LEFT OVERRIDE}", "a" * 30_000,
          HOSTILE)  # fmt: skip
FIELDS = {"close": ("finding", "action", "on", "reference"), "mute": ("until", "note"), "assign": ("assignee",),
          "watch": ("kind", "seen")}  # fmt: skip
SOUND = {"seen": "7", "note": "n", "assignee": "Bo", "until": "2024-06-19", "finding": "clean", "action": "inspected"}


def test_odd_values_break_nothing(page, home):
    client = page("Eng")
    for (kind, fields), value in itertools.product(FIELDS.items(), VALUES):
        for field in fields:
            answer = client.post("/case/wear", data={"kind": kind} | SOUND | {field: value})
            sound = (kind, field, value) == ("watch", "seen", "0")
            assert answer.status_code in ({200} if sound else {400, 409, 413, 422}), (kind, field, value)
    assert len(history(home)) == 1


@pytest.mark.parametrize("method", ["GET", "POST"])
@pytest.mark.parametrize("place", ["/", "/case/", "/case/wear/", "//", "/?all=", "/?token="])
def test_odd_address_breaks_nothing(page, place, method):
    client = page("Eng")
    for value in VALUES:
        where = (place + quote(value, errors="surrogatepass")).encode()[:20_000]
        answer = client.ask(method, httpx.URL("http://127.0.0.1").copy_with(raw_path=where))
        assert answer.status_code < 500, where


FORM = "application/x-www-form-urlencoded"
PARTS = "multipart/form-data; boundary=b"
PART = b'--b\r\nContent-Disposition: form-data; name="kind"'


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (FORM, b"kind=%ff&seen=%00&note=%ed%a0%80&=&&&a=b=c"),
        (FORM, b"seen=0&" * 9_000),
        (PARTS, PART),
        (PARTS, PART + b'; filename="a"\r\n\r\nx\r\n--b--\r\n'),
        (PARTS + "; charset=none", PART + b"\r\n\r\n\xff\r\n--b--\r\n"),
        ("multipart/form-data", b"x"),
        ("application/json", b"[" * 60_000),
        ("\xff", b"\x00"),
    ],
)
def test_odd_body_breaks_nothing(page, home, kind, body):
    client = page("Eng")
    answer = client.post("/case/wear", content=body, headers={b"content-type": kind.encode("latin-1")})
    assert answer.status_code == 400
    assert history(home) == []


@pytest.mark.parametrize("name", [FILE, CATALOG])
def test_damaged_home_gets_one_line(fresh_home, name):
    client = page_of(fresh_home)
    assert client.get("/").status_code == 200
    (fresh_home / name).write_bytes(b"x" * 100)
    answer = client.get("/")
    assert answer.status_code == 503
    assert re.search(r'role="status">[^\n]+</p>', answer.text)


def test_home_without_catalog_is_unavailable(fresh_home):
    client = page_of(fresh_home)
    (fresh_home / CATALOG).unlink()
    assert client.get("/case/wear").status_code == 503


def test_simultaneous_first_readers_get_answers(fresh_home):
    """Six of a hundred got DuckDB's locked configuration."""
    token = LocalToken(Person("ada"))
    app = application(fresh_home, LOCAL, token)
    with served(app) as address, httpx.Client(base_url=address, timeout=60) as one:
        one.get("/", params={"token": token.token})
        origin = {"origin": address}

        def ask(n: int) -> int:
            if n % 10 == 0:
                return one.post("/case/gone", data={"kind": "watch", "seen": "0"}, headers=origin).status_code
            return one.get(("/", "/?all", "/case/wear")[n % 3]).status_code

        with ThreadPoolExecutor(20) as pool:
            answers = Counter(pool.map(ask, range(50)))
    assert set(answers) <= {200, 409}
    assert answers[409] == 4, "of five who write the first line one does"
