"""What years of nights do to a home: `python -m benchmarks.nights [--nights N] [--write]`.

Fifty aircraft with a hundred flights of history; then a night a day, each of which brings a flight of two aircraft, the
next in turn, a CSV file each. Every one is a whole night in one process: intake, chain, catalog, upkeep, seal. An
aircraft's flights of its history are flown again under later dates, so a thousand nights spread over 33 months. Upkeep
is due every night, and what thirty days do to replaced files and to logs is done every thirty nights. A row tells
medians of the ten nights up to its own, so that a month that begins, in which prognosis learns anew, decides none.
`--write` puts the table into docs/scale.md. A thousand nights take two to three hours of one core.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from datetime import date, datetime, timedelta
from pathlib import Path
from statistics import median
from unittest.mock import patch

import duckdb
import polars as pl

from benchmarks.harness import Texts, machine, markdown, run
from benchmarks.scale import PAGE, RANKING, Silent, fly_again, query_ms
from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration.around_night import lock_home
from pipelines.orchestration.nightly import run_night
from pipelines.orchestration.runs import publish_night
from pipelines.storage import delta, seal

FLEET = FleetSettings(operators=5, tails=10, flights=100)
TABLE_NIGHTS = (10, 30, 100, 200, 300, 500, 700, 1000)
AROUND, KEPT_DAYS, A_NIGHT = 10, 30, 2
GOAL = 1.3


class Flown:
    """An aircraft's history, to be flown again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        files = sorted((folder / "acms").glob("*.parquet"))
        self.rows = pl.concat([pl.read_parquet(f) for f in files], how="diagonal_relaxed")
        self.flights, self.again = self.rows["flight_id"].unique().sort(), 0
        self.last = self.rows["report_time"].max().date()

    def fly(self, day: date) -> None:
        """The next flight of the history once more, on `day`."""
        flight = self.flights[self.again % self.flights.len()]
        fly_again(self.folder, self.rows.filter(flight_id=flight), day, leg=1)
        self.again += 1


def night(landing: Path, home: Path) -> dict[str, float]:
    """What a night took."""
    commits, began, cpu = list[float](), time.monotonic(), time.process_time()
    commit = delta.Deltas._commit

    def timed(*arguments: object) -> bool:
        since = time.perf_counter()
        done = commit(*arguments)
        commits.append(1e3 * (time.perf_counter() - since))
        return done

    with patch.object(delta.Deltas, "_commit", timed), lock_home(home):
        done = run_night(landing, home, Silent())
        assert not done.failed, done.failed
        assert not done.idle
        publish_night(home)
    took = {"wall_s": time.monotonic() - began, "cpu_s": time.process_time() - cpu}
    return took | {"commit_ms": median(commits) if commits else 0.0}


def sizes_of_home(home: Path) -> dict[str, float]:
    """Files of the tables as they are now and of earlier nights, size of Dagster's history, time of the ranking."""
    with duckdb.connect(str(home / "catalog.duckdb"), read_only=True) as con:
        live = con.execute("select count(*) from tables.files").fetchall()[0][0]
    there = sum(f.suffix == ".parquet" for f in (home / "tables").rglob("*"))
    history = sum(f.stat().st_size for f in (home / "dagster").rglob("*") if f.is_file()) / 1e6
    return {"files": live, "on_disk": there, "history_mb": history, "ranking_ms": query_ms(home, RANKING)}


def pass_day(home: Path) -> None:
    """Let upkeep be due again."""
    os.utime(home / seal.MARKER, (0, 0))


@contextmanager
def days_passed(home: Path, days: int) -> Iterator[None]:
    """Let the logs and what was replaced be older by so many days than a night needs."""
    for commit in home.glob("tables/*/_delta_log/*.json"):
        status = commit.stat()
        os.utime(commit, (status.st_atime, status.st_mtime - 86_400 * (days + 1)))
    with patch.object(seal, "retention", lambda _: seal.Retention(0)):
        yield


def years(nights: int, scratch: Path) -> list[dict[str, float]]:
    """A row for each of the nights that are shown."""
    list(write_fleet(scratch, 11, FLEET))
    landing, home, rows, measurements = scratch / "landing", scratch / "home", list[dict[str, float]](), list[dict]()
    night(landing, home)
    fleet = [Flown(f.parent) for f in sorted(landing.glob("*/*/acms"))]
    first = max(aircraft.last for aircraft in fleet) + timedelta(days=1)
    for n in range(1, nights + 1):
        for k in range(A_NIGHT):
            fleet[(A_NIGHT * n + k) % len(fleet)].fly(first + timedelta(days=n))
        pass_day(home)
        with nullcontext() if n % KEPT_DAYS else days_passed(home, KEPT_DAYS):
            measurements.append(night(landing, home))
        if n in TABLE_NIGHTS or n == nights:
            last = measurements[-AROUND:]
            rows.append({"night": n} | {c: median(t[c] for t in last) for c in last[0]} | sizes_of_home(home))
            print(datetime.now(), rows[-1], flush=True)
    return rows


def table(rows: list[dict[str, float]]) -> str:
    """As Markdown, with each night's cost by that of night 10."""
    first = rows[0]
    head = ["night", "wall [s]", "processor [s]", "of night 10's", "a commit [ms]", "files", "on the disk",
            "Dagster's history [MB]", "ranking [ms]"]  # fmt: skip
    lines = [head] + [
        [f"{r['night']:.0f}", f"{r['wall_s']:.1f}", f"{r['cpu_s']:.1f}", f"{r['cpu_s'] / first['cpu_s']:.2f}",
         f"{r['commit_ms']:.1f}", f"{r['files']:,.0f}", f"{r['on_disk']:,.0f}", f"{r['history_mb']:.0f}",
         f"{r['ranking_ms']:.0f}"] for r in rows
    ]  # fmt: skip
    return f"{markdown(lines)}\n\n{machine()} Goal: {GOAL} times night 10."


def main(nights: int = 1000) -> Texts:
    """So many nights after the first."""
    with tempfile.TemporaryDirectory() as scratch:
        yield "nights", table(years(nights, Path(scratch)))


if __name__ == "__main__":
    run(main, PAGE)
