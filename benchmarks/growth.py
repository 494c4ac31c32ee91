"""What grows with a fleet and with years: `python -m benchmarks.growth files [--aircraft N ...] [--write]`.

A real night over fleet S of benchmarks/scale.py (250 flights an aircraft); its aircraft are then stored again and again
under other tails, every table of them, through the store itself. At each size: files, bytes, the time to publish the
catalog, and of some questions, each the median of several askings.

    python -m benchmarks.growth nights [--nights N] [--write]

Fifty aircraft with a hundred flights of history; then a night a day, each of which brings a flight of two aircraft, the
next in turn, a CSV file each. Every one is a whole night in one process: intake, chain, catalog, upkeep, seal. An
aircraft's flights of its history are flown again under later dates, so a thousand nights spread over 33 months. Upkeep
is due every night, and what thirty days do to replaced files and to logs is done every thirty nights. A row tells
medians of the ten nights up to its own, so that a month that begins, in which prognosis learns anew, decides none.
A thousand nights take two to three hours of one core. `--write` puts the tables into docs/scale.md.
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
from benchmarks.scale import PAGE, RANKING, SIZES, Silent, fly_again, measured, query_ms
from hdt_core.simulate.design import FleetSettings
from hdt_core.tables import TABLES
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration.around_night import lock_home
from pipelines.orchestration.nightly import run_night
from pipelines.orchestration.runs import publish_night
from pipelines.storage import delta, retention
from pipelines.storage.publication import publish
from pipelines.storage.settings import Retention
from pipelines.storage.store import FLEET, Store

QUESTIONS = {
    "fleet's ranking": RANKING,
    "one pack's fouling": "select * from health_parameters where tail = (select min(tail) from fleet_ranking)"
    " and pack = 1 and parameter = 'hx_fouling'",
    "open alerts": "select * from alerts where closed_at is null",
    "flights a month": "select date_trunc('month', departed_at), count(*) from flights group by all",
    "mean residual by signal": "select signal, avg(mean) from residuals group by signal",
}
Aircraft = tuple[str, str]


def multiply(store: Store, originals: list[Aircraft], first: int, last: int) -> None:
    """Store the aircraft again under the numbers from `first` to `last`."""
    for table, entry in TABLES.items():
        if entry.grain == "fleet":
            _multiply_fleet(store, table, len(originals), first, last)
            continue
        for k, (operator, tail) in enumerate(originals):
            frame = store.read_table(table, [(operator, tail)]).filter(pl.col("tail") == tail)
            for name in (f"N{number:05}" for number in range(first, last) if number % len(originals) == k):
                renamed = _renamed(frame, tail, name)
                if entry.grain == "flight":
                    store.merge(table, {(operator, name): renamed["flight_id"].unique().drop_nulls()}, renamed)
                else:
                    store.replace(table, [(operator, name)], renamed)


def _multiply_fleet(store: Store, table: str, count: int, first: int, last: int) -> None:
    """Rows of aircraft in a table of the whole fleet; a model stays the one row it is."""
    rows = store.read_table(table)
    if "tail" not in rows.columns or not rows.height or table == "raw_fleet":
        return
    own = rows.filter(~pl.col("tail").str.starts_with("N")).partition_by("tail", as_dict=True)
    more = [
        _renamed(frame, str(tail), f"N{number:05}")
        for k, ((tail,), frame) in enumerate(own.items())
        for number in range(first, last)
        if tail and number % count == k
    ]
    store.replace(table, [FLEET], pl.concat([rows, *more]))


def _renamed(frame: pl.DataFrame, tail: str, name: str) -> pl.DataFrame:
    ids = [c for c in ("flight_id", "raised_flight_id", "alert_id", "file") if c in frame.columns]
    renamed = [pl.col(c).str.replace(tail, name, literal=True) for c in ids]
    return frame.with_columns(pl.lit(name).alias("tail"), *renamed)


def row(home: Path, aircraft: int) -> dict[str, float]:
    """Measure size and response times of a home."""
    stored = list((home / "tables").rglob("*.parquet"))
    began = time.perf_counter()
    publish(home)
    sizes = {"publish_s": time.perf_counter() - began, "files": len(stored)}
    sizes |= {"megabytes": sum(f.stat().st_size for f in stored) / 1e6, "aircraft": aircraft}
    return sizes | {name: query_ms(home, sql) for name, sql in QUESTIONS.items()}


def size_table(rows: list[dict[str, float]], flights: int) -> str:
    """Return the table as Markdown."""
    lines = [["aircraft", "flights", "files", "MB", "publish [s]", *(f"{q} [ms]" for q in QUESTIONS)]]
    for r in rows:
        cells = [f"{r['aircraft']:,}", f"{r['aircraft'] * flights:,}", f"{r['files']:,}", f"{r['megabytes']:,.0f}"]
        lines.append([*cells, f"{r['publish_s']:.1f}", *(f"{r[q]:,.0f}" for q in QUESTIONS)])
    return f"{markdown(lines)}\n\n{machine()}"


def files(aircraft: tuple[int, ...] = (4, 20, 100, 400)) -> Texts:
    """One row a number of aircraft."""
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        home = Path(scratch) / "home"
        rows = []
        list(write_fleet(root, 11, SIZES["S"]))
        measured(root / "landing", home)
        store = Store(home)
        originals = sorted(store.read_table("raw_flights").select("operator", "tail").unique().rows())
        there = len(originals)
        for count in aircraft:
            multiply(store, originals, there, count)
            there = count
            rows.append(row(home, count))
            print(rows[-1], flush=True)
    yield "growth", size_table(rows, SIZES["S"].flights)


FIFTY = FleetSettings(operators=5, tails=10, flights=100)
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
    commits = list[float]()
    began = time.monotonic()
    cpu = time.process_time()
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
    os.utime(home / retention.MARKER, (0, 0))


@contextmanager
def days_passed(home: Path, days: int) -> Iterator[None]:
    """Let the logs and what was replaced be older by so many days than a night needs."""
    for commit in home.glob("tables/*/_delta_log/*.json"):
        status = commit.stat()
        os.utime(commit, (status.st_atime, status.st_mtime - 86_400 * (days + 1)))
    with patch.object(retention, "retention", lambda _: Retention(0)):
        yield


def years(nights: int, scratch: Path) -> list[dict[str, float]]:
    """A row for each of the nights that are shown."""
    list(write_fleet(scratch, 11, FIFTY))
    landing = scratch / "landing"
    home = scratch / "home"
    rows = list[dict[str, float]]()
    measurements = list[dict]()
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


def night_table(rows: list[dict[str, float]]) -> str:
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


def nights(nights: int = 1000) -> Texts:
    """So many nights after the first."""
    with tempfile.TemporaryDirectory() as scratch:
        yield "nights", night_table(years(nights, Path(scratch)))


if __name__ == "__main__":
    run(files, nights, page=PAGE)
