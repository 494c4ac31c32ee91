"""The page of cases: nothing without a session, nobody's cases but one's own, nothing changed from elsewhere."""

import re
import stat
from pathlib import Path

import pytest
from asgi_client import Client
from case_homes import case_home

from pipelines.casework.listing import find_case, history_of
from pipelines.storage.cases import FILE
from pipelines.web import guard, people
from pipelines.web.address import LOCAL
from pipelines.web.casebook import application
from pipelines.web.people import PeopleError, add_person, person_of, remove_person, session_secret

PASSWORD = "correct horse 7"
WHO = {"Vi": ("viewer", ()), "Eng": ("engineer", ()), "Own": ("engineer", ("AAA",)), "Adm": ("admin", ())}
HOSTILE = "<script>alert(1)</script> {{ 7 * 7 }}"


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    made = case_home(tmp_path_factory.mktemp("page") / "home")
    for name, (role, operators) in WHO.items():
        add_person(made, name, role, operators, PASSWORD)
    return made


@pytest.fixture
def page(home):
    """A browser of somebody's own; each call another."""
    (home / FILE).unlink(missing_ok=True)
    app = application(home, LOCAL)

    def open_as(name: str | None = None) -> Client:
        client = Client(app)
        if name:
            assert login(client, name).status_code == 303
        return client

    return open_as


def token(client: Client, path: str = "/login") -> str:
    return re.search(r'name="token" value="([^"]+)"', client.get(path).text)[1]


def login(client: Client, name: str, password: str = PASSWORD):
    return client.post("/login", data={"token": token(client), "name": name, "password": password})


def say(client: Client, alert: str, kind: str, seen: int = 0, **asked: str):
    return client.post(f"/case/{alert}", data={"token": token(client, "/"), "kind": kind, "seen": str(seen)} | asked)


def test_without_a_session_nothing_is_seen_or_changed(page, home):
    client = page()
    for path in ("/", "/case/wear", "/?all"):
        answer = client.get(path)
        assert (answer.status_code, answer.headers["location"]) == (303, "/login")
        assert "T-1" not in answer.text
    assert client.post("/case/wear", data={"kind": "acknowledge", "seen": "0"}).headers["location"] == "/login"
    assert client.get("/docs").status_code == 404
    assert history_of(home, "wear") == []


def test_an_engineer_takes_a_case_through_its_life(page, home):
    client = page("Eng")
    assert "T-1 1" in client.get("/").text
    assert "acknowledged" in say(client, "wear", "acknowledge").text
    assert "assigned to Bo" in say(client, "wear", "assign", 1, assignee="Bo").text
    done = say(client, "wear", "close", 2, finding="clean", on="2024-04-09", note="looked")
    assert "NO_FAULT_FOUND, inspected on 2024-04-09" in done.text
    found = find_case(home, "wear")
    assert (found["state"], found["found_by"], found["owner"]) == ("answered", "Eng", "Bo")


def test_a_viewer_looks_and_changes_nothing(page, home):
    client = page("Vi")
    assert "What to say" not in client.get("/case/wear").text
    assert say(client, "wear", "acknowledge").status_code == 403
    assert history_of(home, "wear") == []


def test_an_operators_people_see_and_change_their_own_alone(page, home):
    client = page("Own")
    assert "BBB" not in client.get("/?all").text
    for answer in (client.get("/case/other"), say(client, "other", "acknowledge"), client.get("/case/none")):
        assert answer.status_code == 404
        assert "T-9" not in answer.text
        assert "There is no such case." in answer.text
    assert client.get("/case/othe").status_code == 404, "nor by a part of the id"
    assert history_of(home, "other") == []
    assert say(client, "wear", "acknowledge").status_code == 200
    assert "BBB" in page("Adm").get("/").text


def test_what_comes_from_another_page_changes_nothing(page, home):
    client = page("Eng")
    good = {"token": token(client, "/"), "kind": "acknowledge", "seen": "0"}
    others = token(page("Adm"), "/")
    for data in (good | {"token": others}, good | {"token": ""}, {k: v for k, v in good.items() if k != "token"}):
        assert client.post("/case/wear", data=data).status_code == 403
    for headers in ({"origin": "http://evil.example"}, {"origin": "null"}, {"host": "evil.example"}):
        assert client.post("/case/wear", data=good, headers=headers).status_code == 403
    assert client.get("/", headers={"host": "evil.example"}).status_code == 403
    assert client.post("/logout").status_code == 403
    assert history_of(home, "wear") == []
    assert client.post("/case/wear", data=good).status_code == 200


def test_a_session_begins_with_the_login_and_ends_with_the_person(page, home):
    client = page()
    before = token(client)
    fixed = client.cookies["hdt_session"]
    answer = login(client, "Own")
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert client.cookies["hdt_session"] != fixed
    assert token(client, "/") != before
    thief = page()
    thief.cookies.set("hdt_session", fixed)
    assert thief.get("/").headers["location"] == "/login", "the cookie of before the login opens nothing"
    for forged in (client.cookies["hdt_session"][:-2] + "AA", "e30=.x.y", ""):
        thief.cookies.set("hdt_session", forged)
        assert thief.get("/").headers["location"] == "/login"
    add_person(home, "Own", "viewer", ("AAA",), PASSWORD)  # another role ends what is open
    assert client.get("/").headers["location"] == "/login"
    add_person(home, "Own", *WHO["Own"], PASSWORD)


def test_logged_out_is_out(page):
    client = page("Eng")
    assert client.post("/logout", data={"token": token(client, "/")}).headers["location"] == "/login"
    assert client.get("/").headers["location"] == "/login"


def test_guesses_are_few(page, monkeypatch):
    client = page()
    for _ in range(guard.TRIES):
        assert login(client, "Eng", "wrong password").status_code == 401
    assert login(client, "Eng").status_code == 429, "not even with the right one"
    assert login(client, "Vi").status_code == 303, "another name may"
    monkeypatch.setattr(guard, "WINDOW_S", 0.0)
    assert login(page(), "Eng").status_code == 303


def test_notes_are_text_wherever_they_stand(page):
    client = page("Eng")
    say(client, "wear", "acknowledge", note=HOSTILE)
    say(client, "wear", "assign", 1, assignee='"><img src=x>')
    for path in ("/", "/case/wear"):
        answer = client.get(path)
        assert "<script" not in answer.text
        assert "<img" not in answer.text
        assert "&lt;script&gt;alert(1)&lt;/script&gt; {{ 7 * 7 }}" in answer.text or path == "/"
        assert "<b>wash</b>" not in answer.text, "nor what the catalog holds"
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "script-src" not in policy
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-content-type-options"] == "nosniff"


def test_the_second_of_two_is_told_who_was_first(page, home):
    one, two = page("Eng"), page("Adm")
    assert say(one, "wear", "assign", 0, assignee="Eng").status_code == 200
    late = say(two, "wear", "assign", 0, assignee="Adm")
    assert late.status_code == 409
    assert "Nothing was written: Eng changed this case in the meantime" in late.text
    assert find_case(home, "wear")["owner"] == "Eng"
    assert say(two, "wear", "assign", 1, assignee="Adm").status_code == 200


@pytest.mark.parametrize(
    ("kind", "asked", "status"),
    [
        ("close", {"finding": "rusty"}, 422),
        ("mute", {"until": "yesterday", "note": "x"}, 422),
        ("drop table", {}, 400),
        ("acknowledge", {"seen": "-1"}, 400),
        ("acknowledge", {"note": "x" * 70_000}, 413),
    ],
)
def test_what_makes_no_sense_is_told_and_not_written(page, home, kind, asked, status):
    assert say(page("Eng"), "wear", kind, **({"seen": 0} | asked)).status_code == status
    assert history_of(home, "wear") == []


def test_users_and_secret_are_the_owners_alone_and_hold_no_password(home):
    session_secret(home)
    for name in (people.FILE, people.SECRET):
        assert stat.S_IMODE((home / name).stat().st_mode) == 0o600
    assert PASSWORD not in (home / people.FILE).read_text()


def test_who_may_be_added_and_removed(tmp_path):
    for asked in (("", "viewer", (), PASSWORD), ("A", "king", (), PASSWORD), ("A", "viewer", (), "short"),
                  ("A", "admin", ("AAA",), PASSWORD), ("A\nB", "viewer", (), PASSWORD)):  # fmt: skip
        with pytest.raises(PeopleError):
            add_person(tmp_path, *asked)
    add_person(tmp_path, "A", "viewer", (), PASSWORD)
    assert person_of(tmp_path, "A", PASSWORD).role == "viewer"
    assert person_of(tmp_path, "A", PASSWORD + "x") is None
    assert person_of(tmp_path, "B", PASSWORD) is None
    remove_person(tmp_path, "A")
    with pytest.raises(PeopleError, match="no user A"):
        remove_person(tmp_path, "A")


def test_no_page_asks_another_machine_for_anything(page):
    client = page("Eng")
    for path in ("/", "/case/wear"):
        assert re.findall(r'(?:src|href|action)="(?!/|data:)', client.get(path).text) == []
