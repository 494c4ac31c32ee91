"""Files and answers of a store that grows: `python -m benchmarks.growth [--aircraft N ...] [--write]`.

A real night over fleet S of benchmarks/scale.py (250 flights an aircraft); its aircraft are then stored again and again
under other tails, every table of them, through the store itself. At each size: files, bytes, the time to publish the
catalog, and of some questions, each the median of several askings. `--write` puts the table into docs/scale.md.
"""

import tempfile
import time
from pathlib import Path

import polars as pl

from benchmarks.harness import Texts, machine, markdown, run
from benchmarks.scale import PAGE, RANKING, SIZES, measured, query_ms
from hdt_core.tables import TABLES
from pipelines.intake.simulated import write_fleet
from pipelines.storage.publication import publish
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
            for number in range(first, last):
                if number % len(originals) == k:
                    _keep(store, table, (operator, f"N{number:05}"), _renamed(frame, tail, f"N{number:05}"))


def _keep(store: Store, table: str, aircraft: Aircraft, frame: pl.DataFrame) -> None:
    entry = TABLES[table]
    if entry.grain == "flight":
        store.merge(table, {aircraft: frame["flight_id"].unique().drop_nulls()}, frame)
    else:
        store.replace(table, [aircraft], frame)


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
    files = list((home / "tables").rglob("*.parquet"))
    began = time.perf_counter()
    publish(home)
    sizes = {"publish_s": time.perf_counter() - began, "files": len(files)}
    sizes |= {"megabytes": sum(f.stat().st_size for f in files) / 1e6, "aircraft": aircraft}
    return sizes | {name: query_ms(home, sql) for name, sql in QUESTIONS.items()}


def table(rows: list[dict[str, float]], flights: int) -> str:
    """Return the table as Markdown."""
    lines = [["aircraft", "flights", "files", "MB", "publish [s]", *(f"{q} [ms]" for q in QUESTIONS)]]
    for r in rows:
        cells = [f"{r['aircraft']:,}", f"{r['aircraft'] * flights:,}", f"{r['files']:,}", f"{r['megabytes']:,.0f}"]
        lines.append([*cells, f"{r['publish_s']:.1f}", *(f"{r[q]:,.0f}" for q in QUESTIONS)])
    return f"{markdown(lines)}\n\n{machine()}"


def main(aircraft: tuple[int, ...] = (4, 20, 100, 400)) -> Texts:
    """One row a number of aircraft."""
    with tempfile.TemporaryDirectory() as scratch:
        root, home, rows = Path(scratch), Path(scratch) / "home", []
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
    yield "growth", table(rows, SIZES["S"].flights)


if __name__ == "__main__":
    run(main, PAGE)
