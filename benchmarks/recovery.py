"""Recovery time after a killed night, at 100,000 flights: `python -m benchmarks.recovery [--flights N] [--write]`.

Claim: the home is open again within 2 s. A real night over one small aircraft is killed (SIGKILL) between two
marks; then the home is given the weight of a fleet, with nothing estimated: a file a flight in the landing zone, its
lines in the ledger, the store's files by name, Dagster's partitions and events. Timed, in a process of its own, imports
left out, is `run_night` up to where it begins to make the first block: what a killed writer left is swept, the landing
zone listed against the ledger, the killed run marked as failed, and it is known what is stale. The medians of several
reopenings count. `--write` puts the table into docs/scale.md.
"""

import json
import signal
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing, suppress
from datetime import date, timedelta
from pathlib import Path
from statistics import median
from typing import Any

import polars as pl

import pipelines.definitions  # noqa: F401  what is imported is no matter of recovery's
from benchmarks.fault_points import arm
from benchmarks.harness import Texts, count_time, machine, markdown, run
from benchmarks.scale import PAGE, Silent
from hdt_core.simulate.design import FleetSettings
from hdt_core.tables import TABLES
from pipelines import resources
from pipelines.intake.simulated import write_fleet
from pipelines.lineage import LINEAGE
from pipelines.orchestration import around_night, nightly, runs
from pipelines.storage.ledger import Ledger
from pipelines.versions import expected_versions

AIRCRAFT = [(operator, f"T-{operator}{n:02d}") for operator in ("QAA", "QBB", "QCC", "QDD", "QEE") for n in range(10)]
LEGS = 4
Spent = dict[str, list[float]]
"""Wall and processor seconds, by part."""
PARTS = {
    "sweep": "sweep what a killed writer left",
    "scan": "list the landing zone against the ledger",
    "ready": "open Dagster's instance, mark the killed run as failed",
    "stale": "find out what is stale",
    "all": "all, from the start to the first block",
}


def killed(root: Path) -> tuple[Path, Path]:
    """Landing zone and home of a small night that was killed between its marks."""
    list(write_fleet(root, 3, FleetSettings(operators=1, tails=1, flights=30)))
    landing = root / "landing"
    home = root / "home"
    command = [sys.executable, "-m", "benchmarks.recovery", "--child", "night", str(landing), str(home)]
    done = subprocess.run(command, check=False)
    assert done.returncode == -signal.SIGKILL, done
    return landing, home


def grow(landing: Path, home: Path, flights: int) -> None:
    """Extend landing zone, ledger, store and history by some flights."""
    days = [date(2018, 1, 1) + timedelta(d) for d in range(flights // len(AIRCRAFT) // LEGS)]
    ids = [f"{day:%Y%m%d}_{leg:02d}" for day in days for leg in range(1, LEGS + 1)]
    ledger = Ledger(home)
    files = []
    flights_of_file = {}
    for operator, tail in AIRCRAFT:
        folder = landing / operator / tail / "acms"
        folder.mkdir(parents=True)
        for flight in (f"{tail}_{i}" for i in ids):
            path = folder / f"{flight}.csv"
            path.touch()
            name = str(path.relative_to(landing))
            files.append((name, operator, tail, "acms", 0, path.stat().st_mtime_ns, name))
            flights_of_file[name] = [(operator, tail, flight)]
    ledger.register(files, flights_of_file)
    for table in LINEAGE:  # parents stand before their children
        cells = expected_versions(ledger, table)
        ledger.mark(table, cells.filter(pl.col("tail").is_in(["", *(t for _, t in AIRCRAFT)])))
    _fill_store(home, days)
    _fill_history(home, ids)


def _fill_store(home: Path, days: list[date]) -> None:
    """The files of every table, by name."""
    months = sorted({f"{day:%Y-%m}" for day in days})
    for table, entry in TABLES.items():
        for operator, tail in AIRCRAFT if entry.grain != "fleet" else ():
            folder = home / "tables" / table / operator / tail
            folder.mkdir(parents=True)
            for shard in {"month": months, "all": ["all"], "flight": [f"{d:%Y%m%d}" for d in days[::7]]}[entry.shard]:
                (folder / f"{shard}.{0:020x}.parquet").touch()


def _fill_history(home: Path, ids: list[str]) -> None:
    """Partitions, and an event for each asset and flight; of their text, which reopening does not read, a line."""
    instance = runs.open_instance(home)
    aircraft = [resources.aircraft_key(*a) for a in AIRCRAFT]
    instance.add_dynamic_partitions(str(resources.AIRCRAFT.name), aircraft)
    instance.add_dynamic_partitions(str(resources.FLIGHTS.name), ids)
    instance.dispose()
    with closing(sqlite3.connect(home / "dagster/history/index.db")) as con, con:
        query = "select * from event_logs where dagster_event_type = 'ASSET_MATERIALIZATION' limit 1"
        (_, run, text, kind, at, *_) = con.execute(query).fetchone()
        rows = (
            (run, text[:200], kind, at, table, json.dumps([table]), f"{a}|{i}")
            for table, entry in TABLES.items() if entry.grain == "flight"
            for a in aircraft
            for i in ids
        )  # fmt: skip
        into = "event_logs (run_id, event, dagster_event_type, timestamp, step_key, asset_key, partition)"
        con.executemany(f"insert into {into} values (?, ?, ?, ?, ?, ?, ?)", rows)


class BegunError(Exception):
    """The first block is about to be made."""


class Until:
    """Progress that ends where work begins."""

    def start(self, label: str, total: int) -> None:
        """A step begins."""
        raise BegunError(label)

    def advance(self, cells: int) -> None:
        """Never reached."""


def reopen(landing: Path, home: Path) -> Spent:
    """Seconds of each part, up to the first block."""
    spent: Spent = {part: [0.0, 0.0] for part in PARTS}
    places: list[tuple[str, Any, str]] = [("sweep", nightly.Store, "sweep"), ("scan", nightly, "scan")]
    places += [
        ("ready", runs, "open_instance"),
        ("ready", runs.Runner, "fail_orphaned_runs"),
        ("stale", nightly, "find_stale_cells"),
    ]
    for part, owner, name in [*places, ("all", nightly, "run_night")]:
        count_time(owner, name, spent[part])
    with suppress(BegunError), around_night.lock_home(home):
        nightly.run_night(landing, home, Until())
    return spent


def measured(landing: Path, home: Path, rounds: int) -> Spent:
    """Medians over reopenings, each in a new process that finds the run still started."""
    history = home / "dagster/history/runs.db"
    database = history.read_bytes()
    results = []
    for _ in range(rounds):
        history.write_bytes(database)
        command = [sys.executable, "-m", "benchmarks.recovery", "--child", "reopen", str(landing), str(home)]
        results.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    return {part: [median(row[part][k] for row in results) for k in range(2)] for part in PARTS}


def table(flights: int, spent: Spent) -> str:
    """Return the table as Markdown."""
    lines = [[f"reopening at {flights:,} flights", "wall [s]", "processor [s]"]]
    lines += [[label, *(f"{seconds:.2f}" for seconds in spent[part])] for part, label in PARTS.items()]
    return f"{markdown(lines)}\n\n{machine()}"


def run_child(what: str, landing: Path, home: Path) -> None:
    """Run a night to be killed, or a reopening."""
    if what == "night":
        arm("before_mark:9")
        nightly.run_night(landing, home, Silent())
    else:
        print(json.dumps(reopen(landing, home)))


def main(flights: int = 100_000, rounds: int = 5, child: tuple[str, ...] = ()) -> Texts:
    """Reopenings of a home of so many flights; `child` is a process of them: what it does, landing zone, home."""
    if child:
        run_child(child[0], Path(child[1]), Path(child[2]))
        return
    with tempfile.TemporaryDirectory() as scratch:
        landing, home = killed(Path(scratch))
        grow(landing, home, flights)
        yield "recovery", table(flights, measured(landing, home, rounds))


if __name__ == "__main__":
    run(main, page=PAGE)
