"""A fleet on several machines, played on one: for benchmarks/distributed.py and the tests of the same claims.

Every machine is processes with a home of their own and, where namespaces can be made (as root, with iproute2), an
address of their own and a way from it to this machine's servers; they
share a PostgreSQL database, a virtual host of RabbitMQ, the landing zone and the store. All is gone with the block.
"""

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import psycopg2
from dagster import DagsterInstance
from dagster._daemon.controller import all_daemons_live

from pipelines.orchestration.runs import open_instance
from pipelines.storage.ledger import NAMES
from pipelines.storage.seal import NAME

BIN = Path(sys.executable).parent
SETTINGS = Path(__file__).parents[1] / "deploy/celery.yaml"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS"), "1")
SOONER = {
    "poll_interval_seconds: 10": "poll_interval_seconds: 1",
    "start_timeout_seconds: 600": "start_timeout_seconds: 30",  # runs are of seconds here
    # a broker that restarts here is back in a few seconds; 60 by default
    "broker: {env: HDT_BROKER_URL}\n": "broker: {env: HDT_BROKER_URL}\n    grace_s: 6\n",
}
"""What the daemon waits for a lost run, as shipped and here."""


@dataclass
class Site:
    """What the machines share, and the processes that were started."""

    root: Path
    landing: Path
    database: str
    broker: str
    names: dict[str, str] = field(default_factory=dict)  # namespace of each machine that has one
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def home(self, machine: str) -> Path:
        """The machine's own, with the settings that the project ships; lost runs are found sooner."""
        settings = self.root / machine / "dagster" / "dagster.yaml"
        settings.parent.mkdir(parents=True, exist_ok=True)
        text = SETTINGS.read_text()
        for shipped, here in SOONER.items():
            assert shipped in text
            text = text.replace(shipped, here)
        settings.write_text(text)
        return self.root / machine

    def environment(self, machine: str) -> dict[str, str]:
        """The variables that make it part of the fleet."""
        home = self.home(machine)
        at = BRIDGE_IP if machine in self.names else "127.0.0.1"
        folders = {"HDT_LANDING": str(self.landing), "HDT_HOME": str(home), "DAGSTER_HOME": str(home / "dagster")}
        database, broker = (url.replace("127.0.0.1", at) for url in (self.database, self.broker))
        servers = {"HDT_POSTGRES_URL": database, "HDT_LEDGER_URL": database, "HDT_BROKER_URL": broker}
        return folders | servers | {"HDT_STORE_URL": str(self.root / "store")}

    def start(self, machine: str, *command: str) -> subprocess.Popen[bytes]:
        """A process group on a machine; what it says goes to `<root>/<machine>.log`."""
        within = ["ip", "netns", "exec", self.names[machine]] if machine in self.names else []
        with open(self.root / f"{machine}.log", "ab") as log:
            env = os.environ | ONE_THREAD | self.environment(machine)
            started = subprocess.Popen([*within, *command], env=env, stdout=log, stderr=log, start_new_session=True)
        self.processes[machine] = started
        return started

    def daemon(self) -> None:
        """Dagster's daemon; back when it answers."""
        self.start("daemon", str(BIN / "dagster-daemon"), "run", "--module-name", "pipelines.definitions")
        with self.instance() as instance:
            wait(lambda: all_daemons_live(instance), 60, "the daemon does not answer")

    def worker(self, machine: str) -> None:
        """One that makes a run at a time; back when it takes runs."""
        quiet = ("--without-gossip", "--without-mingle", "--loglevel", "info")
        words = ("worker", "--concurrency", "1", "--hostname", f"{machine}@%h", *quiet)
        before = self.read_log(machine).count(" ready.")
        self.start(machine, str(BIN / "celery"), "--app", "pipelines.celery_worker", *words)
        wait(lambda: self.read_log(machine).count(" ready.") > before, 60, f"{machine} does not begin")

    def night(self, machine: str, *words: str) -> subprocess.Popen[bytes]:
        """Start a night."""
        return self.start(machine, str(BIN / "hdt"), "nightly", "--json", *words)

    def by_itself(self, *words: str) -> dict:
        """Run `hdt` without the site's variables and return its JSON."""
        env = {k: v for k, v in os.environ.items() if not k.startswith(("HDT_", "DAGSTER_"))} | ONE_THREAD
        done = subprocess.run([BIN / "hdt", *words], env=env, check=True, capture_output=True, text=True)
        return dict(json.loads(done.stdout))

    def kill(self, machine: str) -> None:
        """Kill the machine's whole process group at once, as a power cut would."""
        with suppress(ProcessLookupError):
            os.killpg(self.processes[machine].pid, signal.SIGKILL)
        self.processes.pop(machine).wait()

    def read_log(self, machine: str) -> str:
        """Return the output of a machine's processes."""
        log = self.root / f"{machine}.log"
        return log.read_text(errors="replace") if log.exists() else ""

    @contextmanager
    def instance(self) -> Iterator[DagsterInstance]:
        """Dagster's, as a machine of no address of its own has it."""
        with patch.dict(os.environ, self.environment("onlooker")), open_instance(self.home("onlooker")) as instance:
            yield instance

    def rows(self, sql: str) -> list[tuple]:
        """Query the database."""
        connection = psycopg2.connect(self.database)
        try:
            with connection, connection.cursor() as cursor:
                cursor.execute(sql)
                return cursor.fetchall() if cursor.description else []
        finally:
            connection.close()

    def forget(self) -> None:
        """Empty the fleet; Dagster keeps its history."""
        shutil.rmtree(self.root / "store", ignore_errors=True)
        for sealed in self.root.glob(f"*/{NAME}"):  # or the next night takes the store for damaged
            sealed.unlink()
        for table in NAMES:
            with suppress(psycopg2.errors.UndefinedTable):
                self.rows(f"truncate {table}")

    def made_twice(self, since: str) -> list[tuple]:
        """Cells of an asset that were made more than once after an hour of the clock."""
        return self.rows(
            "select asset_key, partition, count(*) from event_logs where dagster_event_type = 'ASSET_MATERIALIZATION'"
            f" and timestamp > '{since}' group by 1, 2 having count(*) > 1"
        )

    def now(self) -> str:
        """As the events' time is written."""
        return str(self.rows("select (now() at time zone 'utc')::text")[0][0])


@contextmanager
def site(root: Path, landing: Path, postgres: str, broker: str, machines: tuple[str, ...] = ()) -> Iterator[Site]:
    """A database, a virtual host and, where they can be made, a namespace for each of `machines`."""
    name = f"hdt_{uuid.uuid4().hex[:12]}"
    root.mkdir(parents=True, exist_ok=True)
    admin = psycopg2.connect(postgres)
    admin.autocommit = True
    admin.cursor().execute(f"create database {name}")
    control("add_vhost", name)
    control("set_permissions", "-p", name, "guest", ".*", ".*", ".*")
    with namespaces(machines) as names:
        handle = Site(root, landing, f"{postgres.rpartition('/')[0]}/{name}", f"{broker.rstrip('/')}/{name}", names)
        try:
            yield handle
        finally:
            for machine in list(handle.processes):
                handle.kill(machine)
            control("delete_vhost", name)
            admin.cursor().execute(f"drop database {name} with (force)")
            admin.close()


def control(*words: str) -> None:
    """Run `rabbitmqctl`."""
    subprocess.run(["rabbitmqctl", "--quiet", *words], check=True, capture_output=True, text=True)


def restart_broker() -> None:
    """Every connection is cut; what is kept on disk is there again."""
    control("stop_app")
    control("start_app")
    control("await_startup")


def wait(ready: Callable[[], bool], seconds: float, why: str) -> None:
    """Wait until a condition holds; raise TimeoutError after the limit."""
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            raise TimeoutError(why)
        time.sleep(0.1)


BRIDGE_IP = "10.77.0.1"
PORTS = (5432, 5672)
_BRIDGE = "hdtbr0"


@contextmanager
def namespaces(machines: tuple[str, ...]) -> Iterator[dict[str, str]]:
    """Create a namespace for each machine; empty where that is not permitted."""
    if not machines or os.geteuid() or not shutil.which("ip"):
        yield {}
        return
    names = {machine: f"hdt-{machine}" for machine in machines}
    _ip(f"link add {_BRIDGE} type bridge", f"address add {BRIDGE_IP}/24 dev {_BRIDGE}", f"link set {_BRIDGE} up")
    try:
        for k, name in enumerate(names.values(), 2):
            here = f"hdtv{k}"
            there = f"hdtp{k}"
            _ip(f"netns add {name}", f"link add {here} type veth peer name {there} netns {name}")
            _ip(f"link set {here} master {_BRIDGE}", f"link set {here} up")
            inside = (f"address add 10.77.0.{k}/24 dev {there}", f"link set {there} up", "link set lo up")
            _ip(*(f"-n {name} {word}" for word in inside))
        with forwarding():
            yield names
    finally:
        for name in names.values():
            with suppress(subprocess.CalledProcessError):
                _ip(f"netns delete {name}")
        _ip(f"link delete {_BRIDGE}")


def _ip(*words: str) -> None:
    for line in words:
        subprocess.run(["ip", *line.split()], check=True, capture_output=True, text=True)


@contextmanager
def forwarding() -> Iterator[None]:
    """Forward connections from the bridge to the servers, which listen on loopback only."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    async def serve() -> None:
        for port in PORTS:
            await asyncio.start_server(lambda r, w, p=port: _pass_on(r, w, p), BRIDGE_IP, port)

    asyncio.run_coroutine_threadsafe(serve(), loop).result(10)
    try:
        yield
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, port: int) -> None:
    try:
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
    except OSError:
        writer.close()
        return
    await asyncio.gather(_pump(reader, far_writer), _pump(far_reader, writer))


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    writer.close()
