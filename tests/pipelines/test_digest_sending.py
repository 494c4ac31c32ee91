"""After a night: what changed is sent once, to each receiver, and no receiver is in another's or the night's way."""

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
from http.client import HTTPException
from pathlib import Path
from typing import NamedTuple
from unittest.mock import Mock

import pytest
from aiosmtpd.controller import Controller
from aiosmtpd.smtp import SMTP, AuthResult
from command import hdt
from digest_nights import FIRST, SECOND, publish_night

from pipelines.digest import declaration, delivery
from pipelines.digest.declaration import NotifyError, receivers_of
from pipelines.digest.delivery import send_digests
from pipelines.orchestration.around_night import report_failure
from pipelines.storage.publication import publish

SECRET = "s3cret-pass-word"


@pytest.fixture(scope="module")
def one_night(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("one") / "home"
    publish_night(home, FIRST)
    return home


@pytest.fixture
def home(one_night, tmp_path) -> Path:
    return Path(shutil.copytree(one_night, tmp_path / "home"))


@pytest.fixture(autouse=True)
def no_waits(monkeypatch):
    monkeypatch.setattr(delivery, "WAITS_S", (0.0, 0.0))


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


def test_each_change_is_sent_once(home):
    with webhook() as (url, posts):
        declare(home, {"name": "ops", "kind": "webhook", "url": url})
        assert send_digests(home) == []
        assert [set(p.body["changes"]) for p in posts] == [{"new"}]
        assert send_digests(home) == []
        publish(home)  # a night that changes nothing
        assert send_digests(home) == []
        assert len(posts) == 1
        publish_night(home, SECOND)
        assert send_digests(home) == []
        assert set(posts[-1].body["changes"]) == {"new", "worse", "closed", "moved"}
        assert len(list((home / "notify").iterdir())) == 2, "one state and the record"


def test_failed_receiver_catches_up(home, monkeypatch):
    with webhook() as (url, posts), webhook(*[500] * 3) as (busy, late):
        monkeypatch.setenv("HDT_BUSY", busy)
        declare(home, {"name": "busy", "kind": "webhook", "url_env": "HDT_BUSY"}, {"name": "ops", "kind": "webhook",
                "url": url})  # fmt: skip
        (line,) = send_digests(home)
        assert line.startswith("busy got no digest")
        assert SECRET not in line
        assert (len(posts), len(late)) == (1, 0)
        publish_night(home, SECOND)
        assert send_digests(home) == []
        assert (len(posts), len(late)) == (2, 1)
        assert late[0].body["text"].startswith("Fleet: 2 new"), "text for a chat; both nights at once"


@pytest.mark.parametrize(("codes", "arrives"), [((503,), True), ((429, 500), True), ((400,), False), ((302,), False)])
def test_passing_failure_is_tried_again(home, codes, arrives):
    with webhook(*codes) as (url, posts):
        declare(home, {"name": "ops", "kind": "webhook", "url": url})
        assert (send_digests(home) == []) is arrives
        assert len(posts) == arrives


def test_killed_sending_repeats_nothing(home, monkeypatch):
    with webhook() as (url, posts):
        declare(home, *({"name": n, "kind": "webhook", "url": f"{url}/{n}"} for n in ("one", "two", "three")))
        send = delivery.send

        def killed(receiver, *rest):
            if receiver.name == "two":
                raise KeyboardInterrupt
            send(receiver, *rest)

        monkeypatch.setattr(delivery, "send", killed)
        with pytest.raises(KeyboardInterrupt):
            send_digests(home)
        monkeypatch.setattr(delivery, "send", send)
        assert send_digests(home) == []
        assert [p.path.rpartition("/")[2] for p in posts] == ["one", "two", "three"]
        assert len({p.headers["Idempotency-Key"] for p in posts}) == 3


def test_failed_night_is_sent_once(home):
    with webhook() as (url, posts):
        declare(home, *({"name": n, "kind": "webhook", "url": url} | own for n, own in
                        (("all", {}), ("one", {"operator": "AQX"}))))  # fmt: skip

        done = hdt("nightly", "--landing", home, "--home", home)

    assert done.returncode
    (post,) = posts
    assert "no fleet.csv" in post.body["text"]


def test_failure_without_receiver_is_reported(home):
    declare(home, {"name": "ops", "kind": "webhook", "url": "http://127.0.0.1:9/hook"})
    lines: list[str] = []

    with pytest.raises(OSError, match="full"), report_failure(home, lines.append):
        raise OSError("disk full")

    assert lines[0].startswith("ops got no message of the failed night")


@pytest.fixture(scope="module")
def certificate(tmp_path_factory) -> Path:
    """A certificate and key of this machine's own, made for the test."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    file = tmp_path_factory.mktemp("tls") / "both.pem"
    names = "subjectAltName=DNS:localhost,IP:127.0.0.1"
    command = f"openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext {names}"
    command = [*command.split(), "-keyout", f"{file}.key", "-out", str(file)]
    subprocess.run(command, check=True, capture_output=True)
    return file


@contextmanager
def mail_server(certificate: Path) -> Iterator[tuple[int, list]]:
    """A real SMTP server that wants STARTTLS and a password; its port and the envelopes it took."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificate, f"{certificate}.key")
    envelopes: list = []

    class Box:
        async def handle_DATA(self, server, session, envelope) -> str:  # noqa: N802
            envelopes.append(envelope)
            return "250 ok"

    def authenticate(server, session, envelope, mechanism, credentials) -> AuthResult:
        return AuthResult(success=(credentials.login, credentials.password) == (b"hdt", SECRET.encode()), handled=False)

    class Server(Controller):
        def factory(self) -> SMTP:
            return SMTP(self.handler, require_starttls=True, tls_context=context, authenticator=authenticate,
                        auth_required=True, hostname="localhost")  # fmt: skip

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = Server(Box(), hostname="127.0.0.1", port=port)
    server.start()
    try:
        yield port, envelopes
    finally:
        server.stop()


def test_mail_goes_over_starttls(home, certificate, monkeypatch):
    monkeypatch.setenv("HDT_SMTP_USER", "hdt")
    monkeypatch.setenv("HDT_SMTP_PASSWORD", SECRET)
    with mail_server(certificate) as (port, envelopes):
        receiver = {"name": "mcc", "kind": "mail", "host": "127.0.0.1", "port": port, "from": "hdt@airline.example",
                    "to": ["mcc@airline.example", "eng@airline.example"], "user_env": "HDT_SMTP_USER",
                    "password_env": "HDT_SMTP_PASSWORD"}  # fmt: skip
        declare(home, receiver)
        (line,) = send_digests(home)
        assert "certificate" in line, "nobody's certificate is taken on trust"
        declare(home, receiver | {"ca_file": str(certificate)})
        assert send_digests(home) == []
        monkeypatch.setenv("HDT_SMTP_PASSWORD", f"{SECRET}-wrong")
        (home / "notify/sent.json").unlink()
        (line,) = send_digests(home)
        assert SECRET not in line
    (envelope,) = envelopes
    assert envelope.rcpt_tos == ["mcc@airline.example", "eng@airline.example"]
    message = message_from_bytes(envelope.content, policy=policy.default)
    assert message["Subject"] == "Fleet: 2 new"
    assert re.fullmatch(r"<\w+@hybrid-digital-twin>", message["Message-ID"])
    kinds = [part.get_content_type() for part in message.walk() if not part.is_multipart()]
    assert kinds == ["text/plain", "text/html", "application/json"]


MAIL = {"name": "m", "kind": "mail", "host": "h", "from": "a@b", "to": ["a@b"]}


@pytest.mark.parametrize(
    ("receiver", "message"),
    [
        ({"kind": "mail"}, "receiver 1: name is missing"),
        ({"name": "m", "kind": "fax"}, "receiver 1 (m): kind is 'fax'; there are mail, webhook"),
        (MAIL | {"hots": "h"}, "receiver 1 (m): unknown key hots; a receiver of kind mail has host, port"),
        ({k: v for k, v in MAIL.items() if k != "host"}, "receiver 1 (m): host is missing"),
        (MAIL | {"port": "587"}, "receiver 1 (m): port is '587' and ought to be a number"),
        (MAIL | {"to": []}, "receiver 1 (m): to is a list of addresses"),
        (MAIL | {"security": "ssl3"}, "receiver 1 (m): security is 'ssl3'"),
        (MAIL | {"user_env": "U"}, "receiver 1 (m): give both user_env and password_env"),
        (MAIL | {"user_env": "U", "password_env": "P", "security": "none"}, "encrypted connection"),
        ({"name": "w", "kind": "webhook"}, "receiver 1 (w): give either url or url_env"),
        ({"name": "w", "kind": "webhook", "url": "http://hooks.example/abc"}, "has to begin with https://"),
    ],
)
def test_wrong_declaration_is_named(tmp_path, receiver, message):
    declare(tmp_path, receiver)
    with pytest.raises(NotifyError, match=re.escape(message)) as error:
        receivers_of(tmp_path)
    assert str(error.value).startswith(str(tmp_path / "notify.toml"))
    assert "hooks.example" not in str(error.value)


@pytest.mark.parametrize(
    "url",
    [
        "https://user:S3CRET@hooks.example/x",
        "https://hooks.example:S3CRET/x",
        "https://hooks.example/S3CRET x",
        "https://hooks.example/S3CRET\x07",
        "https://hooks.example/S3CRET\u00e9",
        "https://[S3CRET/x",
        "ftp://hooks.example/S3CRET",
        ["https://hooks.example/S3CRET"],
    ],
)
@pytest.mark.parametrize("key", ["url", "url_env"])
def test_refused_address_is_not_shown(tmp_path, key, url):
    declare(tmp_path, {"name": "w", "kind": "webhook", key: url})

    with pytest.raises(NotifyError) as error:
        receivers_of(tmp_path)

    assert "S3CRET" not in str(error.value)


@pytest.mark.parametrize("variable", ["https://user:S3CRET@hooks.example/x", "https://hooks.example/S3CRET x"])
def test_refused_variable_is_not_shown(home, monkeypatch, variable):
    monkeypatch.setenv("HDT_HOOK", variable)
    declare(home, {"name": "w", "kind": "webhook", "url_env": "HDT_HOOK"})

    (line,) = send_digests(home)

    assert "S3CRET" not in line


def test_error_of_address_is_not_quoted(home, monkeypatch):
    declare(home, {"name": "w", "kind": "webhook", "url": "https://hooks.example/S3CRET"})
    fault = HTTPException("nonnumeric port: 'S3CRET'")
    monkeypatch.setattr(delivery, "_post", Mock(side_effect=fault))

    (line,) = send_digests(home)

    assert "S3CRET" not in line


def test_every_key_is_documented():
    page = (Path(__file__).parents[2] / "docs/howto-cases.md").read_text()
    keys = {key for kind in declaration.KINDS.values() for key in kind} | set(declaration.KINDS)
    assert [key for key in keys if f"`{key}`" not in page and f"{key} = " not in page] == []


def test_dead_receiver_stops_no_night(own_home):
    landing, home = own_home
    declare(home, {"name": "gone", "kind": "webhook", "url": "http://127.0.0.1:9/x"}, {"name": "here", "kind": "file",
            "folder": "digests"})  # fmt: skip
    night = hdt("nightly", "--landing", landing, "--home", home)
    assert night.returncode == 0, night.stderr
    assert night.stderr.count("hdt: gone got no digest") == 1
    assert {f.suffix for f in (home / "digests").iterdir()} == {".txt", ".html", ".json"}
