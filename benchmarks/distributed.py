"""Several machines for one fleet: `python -m benchmarks.distributed [--flights N] [--write]`.

Claims: a backfill on two workers gives the tables of one process, by hash; its throughput is at least 1.7 times that of
one worker where two cores are free; a worker killed in the middle (SIGKILL, its whole process group) or a broker that
restarts loses nothing; of two schedulers one works, and one that is killed is followed without doubling a run. Twenty
aircraft of the project's simulator as history files; Celery on RabbitMQ, PostgreSQL, machines as benchmarks/site.py
plays them. Needs HDT_TEST_POSTGRES and HDT_TEST_BROKER. `--write` puts the table into docs/storage.md.
"""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dagster import DagsterRun, RunsFilter

from benchmarks.fault_points import fingerprint
from benchmarks.harness import DOCS, Texts, machine, markdown, run
from benchmarks.site import Site, restart_broker, site, wait
from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.resources import NIGHT

PAGE = DOCS / "storage.md"
SHARED = {"raw_flights", "twin_flights", "features"}
"""A table of each step whose blocks are made side by side."""
N_STORED = "select count(distinct tail) from done where asset = 'raw_flights'"


@dataclass
class Row:
    """Measurements of one backfill."""

    how: str
    wall_s: float
    shared_s: float  # of the steps whose blocks are made side by side, from the first run sent to the last one done
    work_s: float  # within their steps
    runs: int
    retried: int
    twice: int
    tables: dict[str, str]
    load: float

    def line(self, first: "Row", flights: int, workers: int) -> list[str]:
        """Of the table."""
        same = "equal" if self.tables == first.tables else "DIFFER: " + ", ".join(
            t for t in self.tables if self.tables[t] != first.tables[t]
        )  # fmt: skip
        aside = f"{1 - self.work_s / (workers * self.shared_s):.0%}" if self.shared_s else ""
        rate = f"{flights / self.shared_s:.0f}" if self.shared_s else ""
        counts = [str(n) for n in (self.runs, self.retried, self.twice)]
        return [self.how, f"{self.wall_s:.0f}", rate, aside, *counts, same, f"{self.load:.1f}"]


def alone(fleet: Site) -> Row:
    """One process: ledger, history and tables below its home."""
    home = fleet.root / "alone"
    began = time.monotonic()
    words = ("nightly", "--landing", str(fleet.landing), "--home", str(home), "--jobs", "1", "--json")
    summary = fleet.by_itself(*words)
    assert not summary["failed"], summary
    load = os.getloadavg()[0]
    return Row("one process", time.monotonic() - began, 0, 0, summary["runs"], 0, 0, fingerprint(home, ""), load)


def together(fleet: Site, how: str, meanwhile: Callable[[], str | None] | None = None) -> Row:
    """Run a backfill on the running workers; half-way `meanwhile` disturbs it and names a new machine, if any."""
    fleet.forget()
    since = fleet.now()
    began = time.monotonic()
    fleet.night("night")
    ends_on = "night"
    if meanwhile:  # once half of the aircraft have their flights stored
        half = len(list(fleet.landing.glob("*/*/acms"))) // 2
        wait(lambda: fleet.rows(N_STORED)[0][0] >= half, 1800, "the backfill does not begin")
        ends_on = meanwhile() or ends_on
    assert fleet.processes[ends_on].wait() == 0, fleet.read_log(ends_on)[-2000:]
    wall = time.monotonic() - began
    with fleet.instance() as instance:
        records = instance.get_run_records(RunsFilter(tags=NIGHT))
        mine = [r for r in records if str(r.create_timestamp.replace(tzinfo=None)) >= since]
        shared_s = _steps(mine)
        work_s = 0.0
        for record in (r for r in mine if _shared(r.dagster_run)):
            stats = instance.get_run_step_stats(record.dagster_run.run_id)
            work_s += sum(s.end_time - s.start_time for s in stats if s.start_time and s.end_time)
    retried = sum("dagster/retry_number" in r.dagster_run.tags for r in mine)
    fingerprints = fingerprint(fleet.home("night"), str(fleet.root / "store"))
    twice = len(fleet.made_twice(since))
    return Row(how, wall, shared_s, work_s, len(mine), retried, twice, fingerprints, os.getloadavg()[0])


def _shared(run: DagsterRun) -> bool:
    return any(key.path[-1] in SHARED for key in run.asset_selection or ())


def _steps(records: list) -> float:
    """Seconds of the shared steps, each from the first run made to the last one done."""
    spans: dict[str, list[tuple[float, float]]] = {}
    for r in records:
        for table in SHARED & {key.path[-1] for key in r.dagster_run.asset_selection or ()}:
            spans.setdefault(table, []).append((r.create_timestamp.timestamp(), r.end_time or 0.0))
    return sum(max(end for _, end in s) - min(start for start, _ in s) for s in spans.values())


def measured(root: Path, flights: int, aircraft: int) -> list[tuple[Row, int]]:
    """Every row, with the number of its workers, printed as it comes."""
    list(write_fleet(root, 11, FleetSettings(operators=4, tails=aircraft // 4, flights=flights // aircraft)))
    servers = os.environ["HDT_TEST_POSTGRES"], os.environ["HDT_TEST_BROKER"]
    rows: list[tuple[Row, int]] = []
    with site(root / "site", root / "landing", *servers, ("one", "two")) as fleet:

        def note(row: Row, workers: int = 2) -> None:
            rows.append((row, workers))
            print(row.line(rows[0][0], flights, workers), flush=True)

        def schedulers() -> str:
            assert fleet.night("other").wait() == 2, "two nights at once"
            assert "another run (process" in fleet.read_log("other")
            fleet.kill("night")
            fleet.night("other")
            return "other"

        note(alone(fleet), 1)
        fleet.daemon()
        fleet.worker("one")
        note(together(fleet, "one worker"), 1)
        fleet.worker("two")
        note(together(fleet, "two workers"))
        note(together(fleet, "two, one killed half-way", lambda: fleet.kill("one")))
        fleet.worker("one")
        note(together(fleet, "two, broker restarted half-way", restart_broker))
        note(together(fleet, "two, a second scheduler; the first killed", schedulers))
        print(f"addresses: {fleet.names or 'this machine has one'}", flush=True)
    return rows


def table(rows: list[tuple[Row, int]], flights: int, aircraft: int) -> str:
    """Return the table as Markdown."""
    first = rows[0][0]
    by = {row.how: row for row, _ in rows}
    speedup = by["one worker"].shared_s / by["two workers"].shared_s
    head = ["backfill", "wall [s]", "flights/s", "not in steps", "runs", "retried", "cells twice", "tables", "load"]
    lines = [head, *(row.line(first, flights, workers) for row, workers in rows)]
    whole = by["one worker"].wall_s / by["two workers"].wall_s
    shared = (
        f"Throughput of the steps that are shared out, two workers to one: {speedup:.2f}; of the whole: {whole:.2f}."
    )
    return f"{aircraft} aircraft, {flights:,} flights:\n\n{markdown(lines)}\n\n{shared}\n\n{machine()}"


def main(flights: int = 10_000, aircraft: int = 20) -> Texts:
    """Flights of the whole fleet."""
    with tempfile.TemporaryDirectory() as scratch:
        yield "table", table(measured(Path(scratch), flights, aircraft), flights, aircraft)


if __name__ == "__main__":
    run(main, page=PAGE)
