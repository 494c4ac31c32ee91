"""Cost of a first night by size of the fleet: `python -m benchmarks.scale [--sizes S M L] [--rounds N] [--write]`.

S, M, L: 1,000, 10,000 and 100,000 flights of the project's own simulator, as history files. Goals: a first night of L
in 7 minutes, 100 new flights for 2 % of it, nothing new in 1 s, peak memory at most 1.2 GB. Every night is a process of
its own; medians. `--write` puts the table into docs/scale.md.
"""

import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from datetime import date, timedelta
from multiprocessing import forkserver
from pathlib import Path
from statistics import median

import polars as pl

from benchmarks.harness import DOCS, Texts, machine, markdown, run
from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import around_night, nightly
from pipelines.orchestration.local_executor import cores
from pipelines.storage.catalog import connect
from pipelines.storage.publication import publish

SIZES = {
    "S": FleetSettings(operators=2, tails=2, flights=250),
    "M": FleetSettings(operators=4, tails=5, flights=500),
    "L": FleetSettings(operators=5, tails=10, flights=2000),
}
NEW_FLIGHTS = 100
RANKING = "select * from fleet_ranking order by place"
_WHO = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
PAGE = DOCS / "scale.md"


class Silent:
    """Progress without output."""

    def start(self, label: str, total: int) -> None:
        """A step begins."""

    def advance(self, cells: int) -> None:
        """Some of it is done."""


def night(landing: Path, home: Path, shared: bool = True) -> None:
    """Run a night as `hdt nightly` does, in parallel where that pays."""
    with around_night.lock_home(home):
        done = nightly.run_night(landing, home, Silent(), jobs=cores() if shared else 1)
        assert not done.failed, done.failed
        if not done.idle:
            publish(home)


def deliver(landing: Path, count: int) -> None:
    """So many new flights, a CSV file each: the last ones of every aircraft flown again within days after its last.

    Dates differ from aircraft to aircraft, as those of late files do.
    """
    aircraft = sorted({f.parent.parent for f in landing.glob("*/*/acms/*.parquet")})
    for place, folder in enumerate(aircraft):
        rows = pl.read_parquet(sorted((folder / "acms").glob("*.parquet"))[-1])
        day = rows["report_time"].max().date() + timedelta(days=1 + place % 5)
        flights = rows["flight_id"].unique().sort()[-math.ceil(count / len(aircraft)) :]
        for leg, flight in enumerate(flights, 1):
            fly_again(folder, rows.filter(flight_id=flight), day, leg)


def fly_again(folder: Path, flight: pl.DataFrame, day: date, leg: int) -> None:
    """Deliver an aircraft's flight once more, as a CSV file, as if it were of another day."""
    later = flight.with_columns(pl.col("report_time") + (day - flight["report_time"].min().date()))
    name = f"{folder.name}_{day:%Y%m%d}_{leg:02}"
    stamped = pl.col("report_time").dt.strftime("%Y-%m-%dT%H:%M:%SZ")
    later.with_columns(stamped, flight_id=pl.lit(name)).write_csv(folder / "acms" / f"{name}.csv")


def measured(landing: Path, home: Path) -> dict[str, float]:
    """Wall and processor seconds and peak memory of a night in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.scale", "--night", str(landing), str(home)]
    line = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
    return dict(json.loads(line))


def measure_night(landing: Path, home: Path) -> None:
    """Run a night and print its cost, imports excluded."""
    began = time.monotonic()
    before = _cpu_s()
    night(landing, home)
    wall = time.monotonic() - began
    forkserver._forkserver._stop()  # its processes count as ours once they have ended
    here, below = (resource.getrusage(who).ru_maxrss / 1024 for who in _WHO)
    peak_mb = max(here, below)  # of the largest process
    print(json.dumps({"wall_s": wall, "cpu_s": _cpu_s() - before, "peak_mb": peak_mb}))


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in _WHO]
    return sum(u.ru_utime + u.ru_stime for u in used)


def query_ms(home: Path, sql: str, rounds: int = 7) -> float:
    """Median time of a query over a home's catalog. [ms]"""
    times_ms = []
    with connect(home) as con:
        for _ in range(rounds):
            began = time.perf_counter()
            con.execute(sql).fetchall()
            times_ms.append(1e3 * (time.perf_counter() - began))
    return median(times_ms)


def sized(name: str, rounds: int, scratch: Path) -> dict[str, float]:
    """Medians of one size: a night, an idle one, and one of few new flights."""
    size = SIZES[name]
    rows = []
    list(write_fleet(scratch / name, 11, size))
    landing = scratch / name / "landing"
    for k in range(rounds):
        home = scratch / name / f"home{k}"
        nights = {what: measured(landing, home) for what in ("night", "idle")}
        rows.append({f"{what}_{cost}": value for what, row in nights.items() for cost, value in row.items()})
    deliver(landing, NEW_FLIGHTS)
    medians = {key: median(row[key] for row in rows) for key in rows[0]}
    cpu_s = measured(landing, home)["cpu_s"]
    return medians | {"flights": size.operators * size.tails * size.flights, "new_cpu_s": cpu_s}


def table(rows: dict[str, dict[str, float]]) -> str:
    """Return the table as Markdown."""
    head = ["size", "flights", "wall [s]", "processor [s]", "peak [MB]", "idle, processor [s]"]
    lines = [[*head, f"{NEW_FLIGHTS} new, processor [s]", "of the night's"]]
    for name, r in rows.items():
        costs = [f"{r['night_wall_s']:.0f}", f"{r['night_cpu_s']:.0f}", f"{r['night_peak_mb']:.0f}"]
        costs += [f"{r['idle_cpu_s']:.1f}", f"{r['new_cpu_s']:.0f}", f"{r['new_cpu_s'] / r['night_cpu_s']:.1%}"]
        lines.append([name, f"{r['flights']:,.0f}", *costs])
    return f"{markdown(lines)}\n\n{machine()}"


def main(sizes: tuple[str, ...] = ("S", "M"), rounds: int = 1, night: tuple[str, ...] = ()) -> Texts:
    """Fleets of these sizes; or `night`, landing zone and home, measured alone."""
    if night:
        measure_night(*map(Path, night))
        return
    with tempfile.TemporaryDirectory() as scratch:
        yield "table", table({name: sized(name, rounds, Path(scratch)) for name in sizes})


if __name__ == "__main__":
    run(main, page=PAGE)
