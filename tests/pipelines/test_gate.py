"""Dagster's page answers under its own name only, changes nothing without the home's token, and still works."""

import asyncio
import http.client
import http.server
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pipelines.orchestration.runs import open_instance
from pipelines.web.address import LOCAL
from pipelines.web.gate import HEADER, Gate, only_asks, token_of

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
TOKEN = "the-token-of-the-home"
ASKS, CHANGES = "{ version }", 'mutation { deleteRun(runId: "a") { __typename } }'


def ask(method: str, path: str, headers: dict[str, str], query: str | None = None, token: str | None = TOKEN):
    """Status, headers and what came through the gate, over ASGI."""
    through: list[bytes] = []

    async def app(scope, receive, send) -> None:
        through.append((await receive())["body"])
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    body = json.dumps({"query": query}).encode() if query else b""
    sent: list[dict] = []

    async def receive() -> dict:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: dict) -> None:
        sent.append(message)

    path, _, search = path.partition("?")
    scope = {"type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": search.encode()}
    scope |= {"headers": [(k.lower().encode(), v.encode()) for k, v in headers.items()], "http_version": "1.1"}
    scope |= {"scheme": "http", "server": ("127.0.0.1", 3000), "client": ("127.0.0.1", 1), "root_path": ""}
    asyncio.run(Gate(app, LOCAL | {"hdt.example.com"}, token)(scope, receive, send))
    assert through in ([], [body])
    return sent[0]["status"], dict(sent[0]["headers"]), bool(through)


HOST = {"Host": "127.0.0.1:3000"}
JSON = HOST | {"Content-Type": "application/json"}
OWN = JSON | {HEADER: TOKEN}

TURNED_AWAY = [
    ("GET", "/graphql?query=mutation", HOST, None, 405),
    ("HEAD", "/graphql", HOST, None, 405),
    ("PUT", "/graphql", OWN, CHANGES, 405),
    ("DELETE", "/report_asset_check/a", OWN, None, 405),
    ("GET", "/", {"Host": "evil.example:3000"}, None, 403),
    ("GET", "/", {}, None, 403),
    ("GET", "/", HOST | {"Origin": "http://127.0.0.1:8000"}, None, 403),
    ("POST", "/graphql", JSON | {"Host": "127.0.0.1.evil.example"}, ASKS, 403),
    ("POST", "/graphql", JSON | {"Origin": "http://evil.example"}, ASKS, 403),
    ("POST", "/graphql", JSON | {"Origin": "null"}, ASKS, 403),
    ("POST", "/graphql", OWN | {"Origin": "http://127.0.0.1:8000"}, CHANGES, 403),
    ("POST", "/graphql", OWN | {"Host": "evil.example:3000", "Origin": "http://evil.example:3000"}, CHANGES, 403),
    ("POST", "/graphql", JSON, CHANGES, 403),
    ("POST", "/graphql", JSON, f"query A {ASKS} {CHANGES}", 403),
    ("POST", "/graphql", JSON | {HEADER: "another"}, CHANGES, 403),
    ("POST", "/graphql", JSON | {"Cookie": "hdt_token=another"}, CHANGES, 403),
    ("POST", "/graphql", HOST | {"Content-Type": "text/plain"}, CHANGES, 415),
    ("POST", "/graphql?query=mutation", HOST, None, 415),
    ("POST", "/graphql", OWN | {"Content-Type": "text/plain; application/json"}, CHANGES, 415),
    ("POST", "/report_asset_materialization/features", JSON, None, 403),
    ("POST", "/anything", JSON, ASKS, 403),
    ("GET", "/?token=another", HOST, None, 403),
]
LET_THROUGH = [
    ("GET", "/", HOST, None),
    ("GET", "/assets/features?view=lineage", {"Host": "localhost:8080"}, None),
    ("GET", "/", {"Host": "[::1]:3000"}, None),
    ("POST", "/graphql", JSON, ASKS),
    ("POST", "/graphql", JSON | {"Origin": "http://127.0.0.1:3000"}, "query A { version } query B { version }"),
    ("POST", "/graphql", JSON, "{ no GraphQL"),
    ("POST", "/graphql", OWN, CHANGES),
    ("POST", "/graphql", JSON | {"Cookie": f"hdt_token={TOKEN}"}, CHANGES),
    ("POST", "/graphql", OWN | {"Host": "hdt.example.com", "Origin": "https://hdt.example.com"}, CHANGES),
    ("POST", "/report_asset_materialization/features", OWN, None),
]


@pytest.mark.parametrize(("method", "path", "headers", "query", "status"), TURNED_AWAY)
def test_turned_away(method, path, headers, query, status):
    assert ask(method, path, headers, query)[::2] == (status, False)


@pytest.mark.parametrize(("method", "path", "headers", "query"), LET_THROUGH)
def test_let_through(method, path, headers, query):
    assert ask(method, path, headers, query)[::2] == (200, True)


def test_a_page_to_look_at_has_no_token_that_fits():
    for token in ("", "None", TOKEN):
        assert ask("POST", "/graphql", JSON | {HEADER: token}, CHANGES, token=None)[::2] == (403, False)


def test_the_address_with_the_token_leaves_it_with_the_browser_alone():
    status, headers, through = ask("GET", f"//evil.example/runs?a=b&token={TOKEN}", HOST)
    assert (status, through) == (303, False)
    assert headers[b"location"] == b"/evil.example/runs?a=b"
    assert {"HttpOnly", "SameSite=strict"} <= set(headers[b"set-cookie"].decode().split("; "))


@pytest.mark.parametrize("body", [b"", b"[]", b"{}", b'{"query": 1}', b"\xff", b"[" * 100_000, b'[{"query": "{a}"}]'])
def test_what_is_no_question_needs_the_token(body):
    assert not only_asks(body)


def test_the_token_is_the_homes_and_its_owners(tmp_path):
    token = token_of(tmp_path)
    assert len(token) > 40
    assert token_of(tmp_path) == token
    assert stat.S_IMODE((tmp_path / ".page_token").stat().st_mode) == 0o600


@pytest.fixture(scope="module")
def page(sample_landing, sample_home, tmp_path_factory):
    """The command itself on a free port: home, port and token."""
    home = tmp_path_factory.mktemp("page") / "home"
    shutil.copytree(sample_home, home)
    words = ("ui", "--landing", str(sample_landing), "--home", str(home), "--port", "0", "--no-daemon")
    command = [sys.executable, "-c", "from pipelines.cli import main; main()", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        line = next(line for line in server.stdout if line.startswith("Dagster's page"))
        address, _, token = line.split()[-1].partition("?token=")
        yield home, int(address.rstrip("/").rpartition(":")[2]), token
        server.send_signal(signal.SIGTERM)
        _, said = server.communicate(timeout=60)
    assert (server.returncode, said.splitlines()[-1]) == (143, "hdt: stopped"), said


def over_http(port: int, method: str, path: str, query: str | None = None, **headers: str) -> tuple[int, dict]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    own = {"Host": f"127.0.0.1:{port}", "Content-Type": "application/json"} | headers
    try:
        connection.request(method, path, json.dumps({"query": query}) if query else None, own)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        connection.close()


def runs(home: Path) -> set[str]:
    with open_instance(home) as instance:
        return {run.run_id for run in instance.get_runs()}


def test_a_run_goes_only_with_the_token(page):
    home, port, token = page
    before = runs(home)
    one = min(before)
    delete = f'mutation {{ deleteRun(runId: "{one}") {{ __typename }} }}'
    searched = f"/graphql?query={delete.replace(' ', '%20').replace(chr(34), '%22')}"
    assert over_http(port, "GET", searched)[0] == 405
    assert over_http(port, "GET", searched, Host="evil.example")[0] == 403
    assert over_http(port, "POST", searched, **{"Content-Type": "text/plain"})[0] == 415
    assert over_http(port, "POST", "/graphql", delete)[0] == 403
    assert over_http(port, "POST", "/graphql", delete, Origin="http://evil.example", **{HEADER: token})[0] == 403
    assert runs(home) == before
    status, told = over_http(port, "POST", "/graphql", "{ assetNodes { assetKey { path } } }")
    assert status == 200
    assert {"path": ["features"]} in [node["assetKey"] for node in told["data"]["assetNodes"]]
    assert over_http(port, "POST", "/graphql", delete, **{HEADER: token})[1]["data"]["deleteRun"] == {
        "__typename": "DeletePipelineRunSuccess"
    }
    assert runs(home) == before - {one}


def test_no_socket_opens_to_another_page_and_none_changes_anything(page):
    client = pytest.importorskip("websockets.sync.client")
    home, port, _ = page
    before = runs(home)
    where = {"uri": f"ws://127.0.0.1:{port}/graphql", "subprotocols": ["graphql-ws"]}
    with pytest.raises(Exception, match="403"):
        client.connect(**where, origin="http://evil.example")
    with client.connect(**where, origin=f"http://127.0.0.1:{port}") as socket:
        socket.send(json.dumps({"type": "connection_init"}))
        assert json.loads(socket.recv()) == {"type": "connection_ack"}
        change = f'mutation {{ deleteRun(runId: "{min(before)}") {{ __typename }} }}'
        socket.send(json.dumps({"type": "start", "id": "1", "payload": {"query": change}}))
        assert json.loads(socket.recv(timeout=60))["type"] == "error"
    assert runs(home) == before


def browse(address: str, profile: Path) -> str:
    """The document as the browser has it after 30 s of the page's own time."""
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
    done = subprocess.run(
        [str(CHROMIUM), *options, "--virtual-time-budget=30000", "--dump-dom", address],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_page_works_in_a_browser(page, tmp_path):
    home, port, token = page
    seen = browse(f"http://127.0.0.1:{port}/runs?token={token}", tmp_path / "profile")
    assert "token=" not in seen
    assert any(run[:8] in seen for run in runs(home)), seen[-2000:]


class Evil(http.server.SimpleHTTPRequestHandler):
    """A page of another origin on this machine that tries what a page can."""

    page = b""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(self.page)

    def log_message(self, *_: object) -> None: ...


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_another_page_in_the_browser_changes_nothing(page, tmp_path):
    home, port, token = page
    before = runs(home)
    change = json.dumps({"query": f'mutation {{ deleteRun(runId: "{min(before)}") {{ __typename }} }}'})
    at = f"http://127.0.0.1:{port}"
    Evil.page = f"""<img src="{at}/?token={token}"><script>
    const change = {change!r}, send = (how) => fetch('{at}/graphql', {{method: 'POST', body: change, ...how}});
    const tries = [send({{mode: 'no-cors', credentials: 'include'}}),
      send({{credentials: 'include', headers: {{'Content-Type': 'application/json'}}}}),
      fetch('{at}/graphql?query=' + encodeURIComponent(JSON.parse(change).query), {{mode: 'no-cors'}})];
    Promise.allSettled(tries).then((all) => document.title = 'tried ' + all.length);
    </script>""".encode()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Evil) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        seen = browse(f"http://127.0.0.1:{server.server_port}/", tmp_path / "profile")
        server.shutdown()
    assert "tried 3" in seen
    assert runs(home) == before


def test_a_taken_port_is_said_in_one_line(page, sample_landing):
    home, port, _ = page
    words = ("ui", "--landing", str(sample_landing), "--home", str(home), "--port", str(port), "--no-daemon")
    command = [sys.executable, "-c", "from pipelines.cli import main; main()", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    assert done.returncode == 2
    assert "name another --port" in done.stderr
    assert len(done.stderr.splitlines()) == 1
