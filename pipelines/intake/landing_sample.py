"""Check the contents of a landing zone before a night: a few files of each aircraft, validated and not stored."""

from collections.abc import Iterable
from datetime import datetime
from pathlib import Path

import duckdb
import polars as pl

from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.refusals import silent_columns, silent_lines
from pipelines.intake.snapshots import read_snapshots
from pipelines.lineage import FLIGHT_FILES
from pipelines.storage.publication import views

SAMPLE_SIZE = 3
"""Files of a folder of an aircraft that are checked: the oldest and the newest."""
AT_ONCE = 100
"""Files in memory at a time."""


def sample(files: Iterable[LandingFile]) -> list[LandingFile]:
    """Select the oldest and newest files of flights in each folder of an aircraft, of recordings one."""
    folders: dict[str, list[LandingFile]] = {}
    for file in sorted(files, key=lambda f: (f.name[-16:], f.path)):
        if file.kind in FLIGHT_FILES:
            folders.setdefault(file.path.rpartition("/")[0], []).append(file)
    return [f for own in folders.values() for f in _oldest_and_newest(own)]


def _oldest_and_newest(files: list[LandingFile]) -> list[LandingFile]:
    newest = files[-1:] if files[-1].is_recording else files[1 - SAMPLE_SIZE :]
    return newest if files[-1].is_recording or len(files) < SAMPLE_SIZE else [files[0], *newest]


def silent_in_landing(landing: Path, now: datetime) -> tuple[int, list[str]]:
    """Check a sample of a landing zone: the number of files, and a line for each silent column; nothing is stored."""
    files = sample(list_landing(landing).files)
    with duckdb.connect() as con:
        con.execute("create schema tables")
        for start in range(0, max(len(files), 1), AT_ONCE):
            _load(con, files[start : start + AT_ONCE], now)
        con.execute(views()["silent_columns"])
        return len(files), silent_lines(silent_columns(con))


def _load(con: duckdb.DuckDBPyConnection, files: list[LandingFile], now: datetime) -> None:
    """Load accounts and quarantine rows of some files into the tables that the view reads."""
    intake = read_snapshots(files, now)
    both = pl.concat([intake.rows.select("file", "flight_id"), intake.quarantine.select("file", "flight_id")])
    flights = both.drop_nulls().group_by("file").agg(pl.col("flight_id").max())
    names = dict.fromkeys(("file", "operator", "tail"), pl.String)
    place = pl.DataFrame([(f.path, f.operator, f.tail) for f in files], schema=names, orient="row")
    accounts = place.join(intake.delivered.rename({"n_delivered": "delivered"}), on="file", validate="1:1")
    accounts = accounts.join(flights, on="file", how="left", validate="1:1")
    for table, frame in (("raw_deliveries", accounts), ("raw_quarantine", intake.quarantine)):
        con.register("frame", frame)
        con.execute(f"create table if not exists tables.{table} as select * from frame limit 0")
        con.execute(f"insert into tables.{table} select * from frame")
