"""Signing in: the token of this start opens a session of one's own, the header counts from the proxy alone."""

import gc
import tracemalloc
from ipaddress import ip_network

import pytest
from asgi_client import ADDRESS, Client
from starlette.responses import PlainTextResponse

from pipelines.storage.objects import StoreError
from pipelines.web import sign_in
from pipelines.web.guard import LOCAL, Guard
from pipelines.web.sign_in import FILE, SESSIONS, LocalToken, Person, ProxyHeader, local_person, read_people

ADA = Person("Ada")


async def page(scope, receive, send) -> None:
    await PlainTextResponse(f"for {scope['state']['person'].name}")(scope, receive, send)


def by_token(token: LocalToken) -> Client:
    client = Client(Guard(page, LOCAL, token))
    assert client.get(f"/?token={token.token}").status_code == 303
    return client


def test_token_becomes_a_cookie():
    token = LocalToken(ADA, https=True)
    client = Client(Guard(page, LOCAL, token))
    assert client.get("/").status_code == 401
    answer = client.get(f"{ADDRESS}//evil.example/case/a?token={token.token}")
    assert (answer.status_code, answer.headers["location"]) == (303, "/evil.example/case/a")
    cookie = answer.headers["set-cookie"]
    assert {"httponly", "samesite=strict", "secure"} <= set(cookie.lower().split("; "))
    assert token.token not in cookie
    assert token.token not in client.get("/").text


@pytest.mark.parametrize(
    ("host", "port"), [("127.0.0.1", ""), ("127.0.0.1:3000", "_3000"), ("127.0.0.1:8460", "_8460"), ("[::1]", "")]
)
def test_cookie_bears_its_port(host, port):
    token = LocalToken(ADA, https=True)
    answer = Client(Guard(page, LOCAL, token)).get(f"/?token={token.token}", headers={"host": host})
    assert answer.headers["set-cookie"].partition("=")[0] == f"hdt_session{port}"


def test_each_start_has_new_token():
    """What an earlier one opened ends."""
    before = LocalToken(ADA)
    now = LocalToken(ADA)
    later = Client(Guard(page, LOCAL, now))
    later.cookies.update(by_token(before).cookies)
    assert later.get("/").status_code == 401
    assert later.get(f"/?token={before.token}").status_code == 403
    assert len(now.token) >= 43


def test_signing_out_ends_every_copy():
    token = LocalToken(ADA)
    client = by_token(token)
    thief = Client(Guard(page, LOCAL, token))
    other = by_token(token)
    thief.cookies.update(client.cookies)
    assert thief.get("/").status_code == 200
    for method in ("GET", "HEAD"):
        assert client.ask(method, "/logout").status_code == 200, "only a form of the page signs out"
    assert "Signed out." in client.post("/logout").text
    assert [c.get("/").status_code for c in (client, thief, other)] == [401, 401, 200]


def test_session_ends_by_itself(monkeypatch):
    token = LocalToken(ADA)
    client = by_token(token)
    assert client.get("/").text == "for Ada"
    monkeypatch.setattr(sign_in.time, "monotonic", lambda: 1e12)
    assert client.get("/").status_code == 401


@pytest.mark.parametrize("value", ["", "x", "é", "\x00", "a" * 5000, "%ff%00", "None"])
def test_no_other_secret_opens(value):
    client = Client(Guard(page, LOCAL, LocalToken(ADA)))
    assert client.get("/", params={"token": value}).status_code == 403
    assert client.get("/", headers=[(b"cookie", b"hdt_session=" + value.encode())]).status_code == 401


def test_no_header_replaces_the_token():
    client = Client(Guard(page, LOCAL, LocalToken(ADA)))
    assert client.get("/", headers={"x-remote-user": "Ada"}).status_code == 401


def test_guesses_lock_nobody_out():
    """The hand-made sign-in kept 58 kB of each request and shut everybody behind a proxy out after fifty."""
    token = LocalToken(ADA)
    client = Client(Guard(page, LOCAL, token))
    for _ in range(20):
        client.get("/")
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for n in range(200):
        assert client.get(f"/?token=guess-{n}").status_code == 403
        client.cookies.clear()
    gc.collect()  # what waits for the collector is not left behind
    growth = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert growth < 200 * 2_000
    assert client.get(f"/?token={token.token}").status_code == 303


def test_oldest_session_gives_way():
    token = LocalToken(ADA)
    first = by_token(token)
    second = by_token(token)
    for _ in range(SESSIONS - 1):
        by_token(token)
    assert (first.get("/").status_code, second.get("/").status_code) == (401, 200)
    assert len(token._ends) == SESSIONS


@pytest.fixture
def behind(tmp_path):
    """Somebody who sends headers from an address."""
    (tmp_path / FILE).write_text('[people]\nAda = "engineer"\n"Jörg" = "viewer"\n')
    app = Guard(page, LOCAL, ProxyHeader(tmp_path, "X-Remote-User", [ip_network("10.1.0.0/24"), ip_network("::1")]))

    def ask(address: str, *values: bytes, name: bytes = b"x-remote-user"):
        return Client(app, address=address).get("/", headers=[(name, value) for value in values])

    return ask


@pytest.mark.parametrize("address", ["10.1.0.7", "::1", "::ffff:10.1.0.7"])
@pytest.mark.parametrize(("name", "encoding"), [("Ada", "ascii"), ("Jörg", "utf-8"), ("Jörg", "latin-1")])
def test_proxy_header_names_the_person(behind, address, name, encoding):
    assert behind(address, name.encode(encoding)).text == f"for {name}"


@pytest.mark.parametrize("address", ["10.1.1.7", "127.0.0.1", "::2", "", "unix", "::ffff:10.2.0.7", "10.1.0.7.evil"])
def test_foreign_header_opens_nothing(behind, address):
    answer = behind(address, b"Ada")
    assert answer.status_code == 403
    assert "the site&#39;s proxy only" in answer.text


@pytest.mark.parametrize(
    ("values", "status"), [((), 401), ((b"",), 401), ((b"Ada", b"Ada"), 401), ((b"ada",), 403), ((b"Eve",), 403)]
)
def test_named_person_needs_a_role(behind, values, status):
    assert behind("10.1.0.7", *values).status_code == status


@pytest.mark.parametrize("name", [b"x_remote_user", b"x-forwarded-for"])
def test_other_headers_name_nobody(behind, name):
    assert behind("10.1.0.7", b"Ada", name=name).status_code == 401


def test_role_counts_from_next_request(behind, tmp_path):
    (tmp_path / FILE).write_text('[people]\nEve = "viewer"\n')
    assert [behind("10.1.0.7", who).status_code for who in (b"Ada", b"Eve")] == [403, 200]


def test_broken_roles_admit_nobody(behind, tmp_path):
    (tmp_path / FILE).write_text("[people")
    answer = behind("10.1.0.7", b"Ada")
    assert (answer.status_code, "no TOML" in answer.text) == (503, True)


def test_roles_file_names_people(tmp_path):
    (tmp_path / FILE).write_text("""
local = "viewer"
[people]
"ada@example.org" = "engineer"
"Line 1" = { role = "viewer", operators = ["AQX", "BZR"] }
""")
    people = (Person("ada@example.org", "engineer"), Person("Line 1", "viewer", ("AQX", "BZR")))
    assert read_people(tmp_path) == {person.name: person for person in people}
    assert local_person(tmp_path).role == "viewer"


@pytest.mark.parametrize(("role", "is_allowed"), [("viewer", False), ("engineer", True)])
def test_role_decides_who_may_change(role, is_allowed):
    assert Person("a", role).may_change is is_allowed


@pytest.mark.parametrize(("operators", "is_allowed"), [((), True), (("AQX",), True), (("BZR",), False)])
def test_person_reads_own_operators(operators, is_allowed):
    assert Person("a", operators=operators).may_read("AQX") is is_allowed


def test_home_without_roles_names_nobody(tmp_path):
    assert read_people(tmp_path) == {}


def test_account_is_an_engineer(tmp_path, monkeypatch):
    monkeypatch.setenv("USER", "ada")
    assert local_person(tmp_path) == Person("ada", "engineer")


def test_unnamed_account_is_local(tmp_path, monkeypatch):
    monkeypatch.delenv("USER", raising=False)
    assert local_person(tmp_path).name == "local"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("people = 1", "people is a table"),
        ("[person]\nAda = 'viewer'", "no setting 'person'"),
        ("[people]\nAda = 'admin'", "'Ada': role is viewer or engineer, not 'admin'"),
        ("[people]\nAda = ['viewer']", "'Ada': role is viewer or engineer"),
        ("[people]\nAda = {role = 'viewer', operator = 'AQX'}", "'Ada': unknown key operator"),
        ("[people]\nAda = {role = 'viewer', operators = 'AQX'}", "'Ada': operators is a list"),
        ("[people]\nAda = {role = 'viewer', operators = []}", "'Ada': operators is empty"),
        ("[people]\n'' = 'viewer'", "a name has 1 to 80 printable characters"),
        ("[people]\n\"A\\nB\" = 'viewer'", "a key has a control character"),
        ("[people]\nAda = 'viewer'\nAda = 'engineer'", "no TOML"),
        ("[people", "no TOML"),
        ("a = " + "[" * 100_000, "no TOML"),
        ("\xff", "can't be read"),
    ],
)
def test_wrong_role_is_named(tmp_path, text, named):
    (tmp_path / FILE).write_bytes(text.encode("latin-1"))
    with pytest.raises(StoreError, match=FILE) as error:
        read_people(tmp_path)
    assert named in str(error.value)
    assert "\n" not in str(error.value)
