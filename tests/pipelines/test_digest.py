"""After a night: what changed is told once, to each receiver, and no receiver is in another's or the night's way."""

import datetime as dt
import http.server
import json
import re
import shutil
import socket
import ssl
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from email import message_from_bytes, policy
from pathlib import Path
from typing import NamedTuple

import polars as pl
import pytest
from aiosmtpd.controller import Controller
from aiosmtpd.smtp import SMTP, AuthResult
from typer.testing import CliRunner

from hdt_core.components import component_rows
from pipelines.cli import app
from pipelines.digest import (
    EMPTY,
    NotifyError,
    as_html,
    as_json,
    as_text,
    compare,
    declaration,
    receivers_of,
    senders,
    tell_night,
    told,
    work_orders,
)
from pipelines.digest import changes_since as since
from pipelines.digest.render import as_slack, as_teams
from pipelines.storage.catalog import connect, publish
from pipelines.storage.store import FLEET, Store

START = dt.datetime(2024, 3, 1, 6, tzinfo=dt.UTC)
SECRET = "s3cret-pass-word"


def flight(n: int, tail: str = "T-1") -> dict:
    at = START + dt.timedelta(days=n // 2, hours=4 * (n % 2))
    return {"operator": "AAA", "tail": tail, "flight_id": f"{tail}_{at:%Y%m%d}_{n % 2 + 1:02d}", "departed_at": at,
            "landed_at": at + dt.timedelta(hours=2), "source": "acms"}  # fmt: skip


def alert(name: str, severity: str, last: int, *, closed: int | None = None) -> dict:
    raised, now = flight(10), flight(last)
    ends = None if closed is None else flight(closed)["departed_at"]
    return raised | {
        "alert_id": name, "pack": 1, "component": "HX", "diagnosis": "HX_FOULING", "severity": severity,
        "raised_severity": "low", "evidence": "then", "evidence_now": "now", "recommended_action": "=wash & look <now>",
        "raised_flight_id": raised["flight_id"], "raised_at": raised["departed_at"], "closed_at": ends,
        "now_flight_id": now["flight_id"],
    }  # fmt: skip


class Night(NamedTuple):
    """What a night makes of one aircraft: its last flight, alerts, and the outlook after that flight."""

    last: int
    alerts: list[dict]
    outlook: tuple[float, float, float]


def publish_night(home: Path, night: Night) -> None:
    """Store it as a night would, and publish."""
    store, own = Store(home), [("AAA", "T-1")]
    low, middle, high = night.outlook
    said = {"pack": 1, "component": "HX", "model_version": "m", "split": "live", "p_event_50": 0.2}
    outlook = [
        flight(n) | said | {"rul_low": low, "rul_flights": middle, "rul_high": high} for n in range(night.last + 1)
    ]
    life = {"life": 0, "first_row": 0, "end_row": night.last + 1, "n_flights": night.last + 1, "censored": True}
    life |= {"operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "age_known": False}
    store.replace("raw_flights", own, pl.DataFrame([flight(n) for n in range(night.last + 1)]))
    store.replace("features_alerts", own, pl.DataFrame(night.alerts, infer_schema_length=None))
    store.replace("prognoses", [FLEET], pl.DataFrame(outlook))
    store.replace("prognosis_lives", [FLEET], pl.DataFrame([life]))
    store.replace("components", [FLEET], pl.DataFrame(component_rows()))
    publish(home)


FIRST = Night(40, [alert("aaaa", "low", 40), alert("bbbb", "medium", 40)], (40.0, 80.0, 120.0))
SECOND = Night(42, [alert("aaaa", "high", 42), alert("bbbb", "medium", 42, closed=42), alert("cccc", "low", 42)],
               (5.0, 10.0, 30.0))  # fmt: skip


@pytest.fixture(scope="module")
def one_night(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("one") / "home"
    publish_night(home, FIRST)
    return home


@pytest.fixture(scope="module")
def two_nights(tmp_path_factory, one_night) -> Path:
    home = tmp_path_factory.mktemp("two") / "home"
    shutil.copytree(one_night, home)
    publish_night(home, SECOND)
    return home


@pytest.fixture
def home(one_night, tmp_path) -> Path:
    return Path(shutil.copytree(one_night, tmp_path / "home"))


@pytest.fixture(autouse=True)
def no_waits(monkeypatch):
    monkeypatch.setattr(senders, "WAITS_S", (0.0, 0.0))


# --- what changed --------------------------------------------------------------------------------------------------


def test_a_digest_tells_what_is_new_worse_closed_and_moved(two_nights):
    digest = since(two_nights)
    assert {kind: [r.get("alert_id") for r in rows] for kind, rows in digest.changes.items()} == {
        "new": ["cccc"], "worse": ["aaaa"], "closed": ["bbbb"], "moved": [None],
    }  # fmt: skip
    text = as_text(digest)
    assert "low to high" in text
    assert "flights left 10 (5 to 30); 2 flights ago 80 (40 to 120)." in text
    assert "=wash & look <now>" in text
    assert "=wash &amp; look &lt;now&gt;" in as_html(digest)
    assert json.loads(as_json(digest))["changes"]["closed"][0]["closed_on"] == f"{flight(42)['departed_at']:%Y-%m-%d}"


def test_the_same_night_twice_is_no_change_and_an_operator_sees_its_own(two_nights):
    with connect(two_nights) as con:
        now = told.read_state(con)
    assert compare(now, now).empty
    assert compare(EMPTY, now).of("AAA").changes == compare(EMPTY, now).changes
    assert compare(EMPTY, now).of("ZZZ").empty


@pytest.mark.parametrize(
    ("then", "now", "flown", "moved"),
    [
        ((40, 80, 120), (30, 70, 110), 10, False),  # ten flights flown, ten fewer left
        ((40, 80, 120), (10, 29, 60), 10, True),
        ((40, 80, 120), (60, 111, 200), 10, True),
        ((40, 200, 300), (200, 300, 300), 10, False),  # 300 stands for 300 or more
    ],
)
def test_an_outlook_moved_where_it_left_its_own_interval(then, now, flown, moved):
    def state(outlook: tuple[float, ...], n: int, life: int = 0) -> dict:
        names = dict(zip(("rul_low", "rul_flights", "rul_high"), outlook, strict=True))
        row = {"operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "life": life, "n_flights": n}
        return EMPTY | {"outlook": {"one": row | names}}

    assert ("moved" in compare(state(then, 20), state(now, 20 + flown)).changes) is moved
    assert compare(state(then, 20), state(now, 20 + flown, life=1)).empty, "another unit has an outlook of its own"


def test_slack_and_teams_get_what_they_take(two_nights):
    digest = since(two_nights)
    slack, teams = as_slack(digest), as_teams(digest)
    assert slack["text"] == "Fleet: 1 new, 1 worse, 1 closed, 1 moved"
    assert all(b["type"] == "section" and len(b["text"]["text"]) <= 3000 for b in slack["blocks"])
    assert "&lt;now&gt;" in json.dumps(slack)
    (card,) = teams["attachments"]
    assert (teams["type"], card["contentType"]) == ("message", "application/vnd.microsoft.card.adaptive")
    assert {block["type"] for block in card["content"]["body"]} == {"TextBlock"}


def test_work_orders_say_by_when(two_nights, tmp_path):
    answer = CliRunner().invoke(app, ["orders", "--home", str(two_nights), "--out", str(tmp_path / "out")])
    assert answer.exit_code == 0, answer.output
    names = ["reference", "operator", "tail", "pack", "component", "action", "due", "reason", "alert_id"]
    sheet = pl.read_csv(tmp_path / "out/orders.csv", infer_schema=False)
    assert sheet.columns == names
    assert sheet["action"].to_list() == ["'=wash & look <now>"] * 2, "no formula for a spreadsheet"
    rows = json.loads((tmp_path / "out/orders.json").read_text())
    assert [r["alert_id"] for r in rows] == ["aaaa", "cccc"]
    # five flights at two a day after the last one: two days and a half later the message may have come
    assert {r["due"] for r in rows} == {f"{flight(42)['departed_at'] + dt.timedelta(days=3):%Y-%m-%d}"}
    page = (tmp_path / "out/orders.html").read_text()
    assert "HDT-aaaa" in page
    assert "&lt;now&gt;" in page
    with connect(two_nights) as con:
        assert work_orders(con, "ZZZ").is_empty()


# --- who is told ---------------------------------------------------------------------------------------------------


class Post(NamedTuple):
    path: str
    headers: dict
    body: dict


@contextmanager
def webhook(*codes: int) -> Iterator[tuple[str, list[Post]]]:
    """A server on the loopback that answers with these codes, then with 200; its address and what it was sent."""
    posts: list[Post] = []
    answers = iter(codes)

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            code = next(answers, 200)
            if code == 200:
                posts.append(Post(self.path, dict(self.headers), json.loads(body)))
            self.send_response(code)
            self.send_header("Location", "http://127.0.0.1:9/elsewhere")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/hook/{SECRET}", posts
        finally:
            server.shutdown()
            thread.join()


def declare(home: Path, *receivers: dict) -> None:
    lines = (["[[receiver]]", *(f"{key} = {json.dumps(value)}" for key, value in entry.items())] for entry in receivers)
    (home / "notify.toml").write_text("\n".join(line for entry in lines for line in entry))


def test_nothing_is_sent_when_nothing_changed_and_each_night_once(home):
    with webhook() as (url, posts):
        declare(home, {"name": "ops", "kind": "webhook", "url": url})
        assert tell_night(home) == []
        assert [set(p.body["changes"]) for p in posts] == [{"new"}]
        assert tell_night(home) == []
        publish(home)  # a night that changes nothing
        assert tell_night(home) == []
        assert len(posts) == 1
        publish_night(home, SECOND)
        assert tell_night(home) == []
        assert set(posts[-1].body["changes"]) == {"new", "worse", "closed", "moved"}
        assert len(list((home / "notify").iterdir())) == 2, "one state and the record"


def test_a_receiver_that_fails_is_told_with_the_next_night_and_is_in_nobodys_way(home, monkeypatch):
    with webhook() as (url, posts), webhook(*[500] * 3) as (busy, late):
        monkeypatch.setenv("HDT_BUSY", busy)
        declare(home, {"name": "busy", "kind": "slack", "url_env": "HDT_BUSY"}, {"name": "ops", "kind": "teams",
                "url": url})  # fmt: skip
        (line,) = tell_night(home)
        assert line.startswith("busy was not told")
        assert SECRET not in line
        assert (len(posts), len(late)) == (1, 0)
        publish_night(home, SECOND)
        assert tell_night(home) == []
        assert (len(posts), len(late)) == (2, 1)
        assert late[0].body["text"].startswith("Fleet: 2 new"), "both nights at once: what is open now"


@pytest.mark.parametrize(("codes", "arrives"), [((503,), True), ((429, 500), True), ((400,), False), ((302,), False)])
def test_what_may_pass_is_tried_again_and_a_redirect_is_not_followed(home, codes, arrives):
    with webhook(*codes) as (url, posts):
        declare(home, {"name": "ops", "kind": "webhook", "url": url})
        assert (tell_night(home) == []) is arrives
        assert len(posts) == arrives


def test_a_night_that_is_killed_while_it_tells_tells_nobody_twice(home, monkeypatch):
    with webhook() as (url, posts):
        declare(home, *({"name": n, "kind": "webhook", "url": f"{url}/{n}"} for n in ("one", "two", "three")))
        send = told.send

        def killed(receiver, *rest):
            if receiver.name == "two":
                raise KeyboardInterrupt
            send(receiver, *rest)

        monkeypatch.setattr(told, "send", killed)
        with pytest.raises(KeyboardInterrupt):
            tell_night(home)
        monkeypatch.setattr(told, "send", send)
        assert tell_night(home) == []
        assert [p.path.rpartition("/")[2] for p in posts] == ["one", "two", "three"]
        assert len({p.headers["Idempotency-Key"] for p in posts}) == 3


@pytest.fixture(scope="module")
def certificate(tmp_path_factory) -> Path:
    """A certificate and key of this machine's own, made for the test."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    file = tmp_path_factory.mktemp("tls") / "both.pem"
    names = "subjectAltName=DNS:localhost,IP:127.0.0.1"
    made = f"openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext {names}"
    made = [*made.split(), "-keyout", f"{file}.key", "-out", str(file)]
    subprocess.run(made, check=True, capture_output=True)
    return file


@contextmanager
def mail_server(certificate: Path) -> Iterator[tuple[int, list]]:
    """A real SMTP server that wants STARTTLS and a password; its port and the envelopes it took."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificate, f"{certificate}.key")
    taken: list = []

    class Box:
        async def handle_DATA(self, server, session, envelope) -> str:  # noqa: N802
            taken.append(envelope)
            return "250 ok"

    def known(server, session, envelope, mechanism, given) -> AuthResult:
        return AuthResult(success=(given.login, given.password) == (b"hdt", SECRET.encode()), handled=False)

    class Server(Controller):
        def factory(self) -> SMTP:
            return SMTP(self.handler, require_starttls=True, tls_context=context, authenticator=known,
                        auth_required=True, hostname="localhost")  # fmt: skip

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = Server(Box(), hostname="127.0.0.1", port=port)
    server.start()
    try:
        yield port, taken
    finally:
        server.stop()


def test_an_e_mail_goes_over_starttls_with_text_page_and_json(home, certificate, monkeypatch):
    monkeypatch.setenv("HDT_SMTP_USER", "hdt")
    monkeypatch.setenv("HDT_SMTP_PASSWORD", SECRET)
    with mail_server(certificate) as (port, taken):
        receiver = {"name": "mcc", "kind": "mail", "host": "127.0.0.1", "port": port, "from": "hdt@airline.example",
                    "to": ["mcc@airline.example", "eng@airline.example"], "user_env": "HDT_SMTP_USER",
                    "password_env": "HDT_SMTP_PASSWORD"}  # fmt: skip
        declare(home, receiver)
        (line,) = tell_night(home)
        assert "certificate" in line, "nobody's certificate is taken on trust"
        declare(home, receiver | {"ca_file": str(certificate)})
        assert tell_night(home) == []
        monkeypatch.setenv("HDT_SMTP_PASSWORD", f"{SECRET}-wrong")
        (home / "notify/sent.json").unlink()
        (line,) = tell_night(home)
        assert SECRET not in line
    (envelope,) = taken
    assert envelope.rcpt_tos == ["mcc@airline.example", "eng@airline.example"]
    message = message_from_bytes(envelope.content, policy=policy.default)
    assert message["Subject"] == "Fleet: 2 new"
    assert re.fullmatch(r"<\w+@hybrid-digital-twin>", message["Message-ID"])
    kinds = [part.get_content_type() for part in message.walk() if not part.is_multipart()]
    assert kinds == ["text/plain", "text/html", "application/json"]


MAIL = {"name": "m", "kind": "mail", "host": "h", "from": "a@b", "to": ["a@b"]}


@pytest.mark.parametrize(
    ("receiver", "says"),
    [
        ({"kind": "mail"}, "receiver 1: name is missing"),
        ({"name": "m", "kind": "fax"}, "receiver 1 (m): kind is 'fax'; there are mail, slack"),
        (MAIL | {"hots": "h"}, "receiver 1 (m): unknown key hots; a receiver of kind mail has host, port"),
        ({k: v for k, v in MAIL.items() if k != "host"}, "receiver 1 (m): host is missing"),
        (MAIL | {"port": "587"}, "receiver 1 (m): port is '587' and ought to be a number"),
        (MAIL | {"to": []}, "receiver 1 (m): to is a list of addresses"),
        (MAIL | {"security": "ssl3"}, "receiver 1 (m): security is 'ssl3'"),
        (MAIL | {"user_env": "U"}, "receiver 1 (m): give both user_env and password_env"),
        (MAIL | {"user_env": "U", "password_env": "P", "security": "none"}, "encrypted line"),
        ({"name": "w", "kind": "slack"}, "receiver 1 (w): give either url or url_env"),
        ({"name": "w", "kind": "slack", "url": "http://hooks.example/abc"}, "has to begin with https://"),
    ],
)
def test_a_wrong_declaration_is_told_with_file_and_key(tmp_path, receiver, says):
    declare(tmp_path, receiver)
    with pytest.raises(NotifyError, match=re.escape(says)) as error:
        receivers_of(tmp_path)
    assert str(error.value).startswith(str(tmp_path / "notify.toml"))
    assert "hooks.example" not in str(error.value)


def test_every_key_is_documented():
    said = (Path(__file__).parents[2] / "docs/digest.md").read_text()
    keys = {key for kind in declaration.KINDS.values() for key in kind} | set(declaration.KINDS)
    assert [key for key in keys if f"`{key}`" not in said and f"{key} = " not in said] == []


def test_a_night_goes_well_whoever_can_not_be_told(own_home):
    landing, home = own_home
    declare(home, {"name": "gone", "kind": "webhook", "url": "http://127.0.0.1:9/x"}, {"name": "here", "kind": "file",
            "folder": "digests"})  # fmt: skip
    answer = CliRunner().invoke(app, ["nightly", "--landing", str(landing), "--home", str(home)])
    assert answer.exit_code == 0, answer.output
    assert answer.output.count("hdt: gone was not told") == 1
    assert {f.suffix for f in (home / "digests").iterdir()} == {".txt", ".html", ".json"}
