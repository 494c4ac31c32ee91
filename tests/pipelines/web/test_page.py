"""Dagster's page: to look at unless runs are asked for, then for who brings the token alone; and it still works."""

import http.client
import json
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from browsers import CHROMIUM, NEEDS_CHROMIUM
from command import command_line

from pipelines.orchestration.runs import open_instance

QUERY = "{ assetNodes { assetKey { path } } }"


@contextmanager
def open_page(landing: Path, home: Path, *options: str) -> Iterator[tuple[int, str]]:
    """The command itself on a free port: port and token, which may be none."""
    command = command_line("ui", "--landing", landing, "--home", home, "--port", "0", "--no-daemon", *options)
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        line = next(line for line in server.stdout if line.startswith("Dagster's page"))
        address, _, token = line.split()[-1].partition("?token=")
        yield int(address.rstrip("/").rpartition(":")[2]), token
        server.send_signal(signal.SIGTERM)
        _, stderr = server.communicate(timeout=60)
    assert (server.returncode, stderr.splitlines()[-1]) == (143, "hdt: stopped"), stderr


@pytest.fixture(scope="module")
def home(sample_home, tmp_path_factory) -> Path:
    return Path(shutil.copytree(sample_home, tmp_path_factory.mktemp("page") / "home"))


@pytest.fixture(scope="module")
def page(sample_landing, home) -> Iterator[tuple[int, str]]:
    """Port and token of the page that may launch, where a session is open."""
    with open_page(sample_landing, home, "--launch") as (port, token):
        yield port, token


def over_http(port: int, method: str, path: str, query: str | None = None, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    own = {"Host": f"127.0.0.1:{port}", "Content-Type": "application/json", "Origin": f"http://127.0.0.1:{port}"}
    try:
        connection.request(method, path, json.dumps({"query": query}) if query else None, own | headers)
        answer = connection.getresponse()
        return answer.status, answer.getheader("set-cookie", "").partition(";")[0].encode() or answer.read()
    finally:
        connection.close()


def ask(port: int, query: str, **headers: str) -> tuple[int, bytes]:
    return over_http(port, "POST", "/graphql", query, **headers)


def session(port: int, token: str) -> dict[str, str]:
    status, cookie = over_http(port, "GET", f"/runs?token={token}")
    assert status == 303
    return {"Cookie": cookie.decode()}


def runs(home: Path) -> set[str]:
    with open_instance(home) as instance:
        return {run.run_id for run in instance.get_runs()}


def deletion(home: Path) -> str:
    return f'mutation {{ deleteRun(runId: "{min(runs(home))}") {{ __typename }} }}'


CHANGES = {
    "deleteRun": 'deleteRun(runId: "a") { __typename }',
    "startSchedule": 'startSchedule(scheduleSelector: {repositoryName: "__repository__", repositoryLocationName: '
    '"pipelines.definitions", scheduleName: "every_night"}) { __typename }',
    "startSensor": 'startSensor(sensorSelector: {repositoryName: "__repository__", repositoryLocationName: '
    '"pipelines.definitions", sensorName: "landing_zone"}) { __typename }',
    "wipeAssets": 'wipeAssets(assetPartitionRanges: [{assetKey: {path: ["features"]}}]) { __typename }',
    "reportRunlessAssetEvents": "reportRunlessAssetEvents(eventParams: {eventType: ASSET_MATERIALIZATION, "
    'assetKey: {path: ["features"]}}) { __typename }',
    "addDynamicPartition": 'addDynamicPartition(partitionsDefName: "flight", partitionKey: "x", repositorySelector: '
    '{repositoryName: "__repository__", repositoryLocationName: "pipelines.definitions"}) { __typename }',
    "setConcurrencyLimit": 'setConcurrencyLimit(concurrencyKey: "a", limit: 1)',
}


def test_page_changes_nothing_unasked(sample_landing, home):
    before = runs(home)
    with open_page(sample_landing, home) as (plain_port, token):
        assert token == ""
        status, answer = ask(plain_port, QUERY)
        assert status == 200
        assert {"path": ["features"]} in [node["assetKey"] for node in json.loads(answer)["data"]["assetNodes"]]
        for name, change in CHANGES.items():
            _, answer = ask(plain_port, f"mutation {{ {change} }}")
            assert b"UnauthorizedError" in answer, (name, answer)
        assert over_http(plain_port, "POST", "/report_asset_materialization/features", "x")[0] == 401
        assert b"UnauthorizedError" in ask(plain_port, deletion(home))[1]
        assert over_http(plain_port, "GET", "/graphql?query=mutation")[0] == 405
        assert ask(plain_port, QUERY, Origin="http://evil.example")[0] == 403
        assert over_http(plain_port, "GET", "/", Host="evil.example")[0] == 403
    assert runs(home) == before


def test_deletion_needs_the_token(page, home):
    port, token = page
    before = runs(home)
    delete = deletion(home)
    searched = f"/graphql?query={delete.replace(' ', '%20').replace(chr(34), '%22')}"
    assert over_http(port, "GET", "/?token=another")[0] == 403
    assert [ask(port, query)[0] for query in (delete, QUERY)] == [401, 401]
    own = session(port, token)
    assert over_http(port, "GET", searched, **own)[0] == 405
    assert ask(port, delete, Origin="http://evil.example", **own)[0] == 403
    assert ask(port, delete, Origin="http://127.0.0.1:1", **own)[0] == 403
    assert ask(port, delete, Cookie=f"hdt_session_{port}={token}")[0] == 401
    assert runs(home) == before
    _, answer = ask(port, delete, **own)
    assert json.loads(answer)["data"]["deleteRun"] == {"__typename": "DeletePipelineRunSuccess"}
    assert runs(home) == before - {min(before)}
    assert over_http(port, "POST", "/logout", **own)[0] == 200
    assert ask(port, QUERY, **own)[0] == 401


def test_socket_changes_nothing(page, home):
    client = pytest.importorskip("websockets.sync.client")
    port, token = page
    before = runs(home)
    where = {"uri": f"ws://127.0.0.1:{port}/graphql", "subprotocols": ["graphql-ws"]}
    own = session(port, token)
    with pytest.raises(Exception, match="403"):
        client.connect(**where, origin="http://evil.example", additional_headers=own)
    with pytest.raises(Exception, match="403"):
        client.connect(**where, origin=f"http://127.0.0.1:{port}")
    with client.connect(**where, origin=f"http://127.0.0.1:{port}", additional_headers=own) as socket:
        socket.send(json.dumps({"type": "connection_init"}))
        assert json.loads(socket.recv()) == {"type": "connection_ack"}
        socket.send(json.dumps({"type": "start", "id": "1", "payload": {"query": deletion(home)}}))
        assert json.loads(socket.recv(timeout=60))["type"] == "error"
    assert runs(home) == before


@NEEDS_CHROMIUM
def test_page_works_in_browser(page, home, tmp_path):
    port, token = page
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    address = f"http://127.0.0.1:{port}/runs?token={token}"  # after 30 s of the page's own time
    command = [str(CHROMIUM), *options, "--virtual-time-budget=30000", "--dump-dom", address]
    html = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert "token=" not in html
    assert any(run[:8] in html for run in runs(home)), html[-2000:]


def test_taken_port_gets_one_line(page, home, sample_landing):
    port, _ = page
    command = command_line("ui", "--landing", sample_landing, "--home", home, "--port", port, "--no-daemon")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "name another --port" in done.stderr
    assert len(done.stderr.splitlines()) == 1
