"""Read and write the tables of a home by aircraft and flight, in a folder or an object store."""

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from hdt_core.tables import TABLES
from hdt_core.tables.base import OPERATOR, TAIL
from pipelines.storage.delta import Change, Deltas, StoredShards, Version
from pipelines.storage.files import Folder, sweep
from pipelines.storage.months import merge_flights, shards_with
from pipelines.storage.objects import Bucket, StoreError, bucket

if TYPE_CHECKING:
    import duckdb

Aircraft = tuple[str, str]
FLEET = ("", "")  # the one shard of a table that belongs to the whole fleet
URL = "HDT_STORE_URL"
_AIRCRAFT = ["operator", "tail"]
EMPTY = "empty"
"""Name of a shard without rows: it gives a table its columns while nothing else is stored."""


@dataclass(frozen=True)
class Store:
    """All tables of one home.

    Their files are below `<home>/tables`, or in the folder or object store (`s3://bucket/prefix`) that `url` names, by
    default the variable HDT_STORE_URL.
    """

    home: Path
    url: str = field(default_factory=lambda: os.environ.get(URL, ""))

    @cached_property
    def place(self) -> Folder | Bucket:
        """Folder or bucket of the files."""
        if self.url.startswith("s3://"):
            return bucket(self.url)
        if "://" in self.url.removeprefix("file://"):
            raise StoreError(f"{URL} is a folder or s3://bucket/prefix, not {self.url!r}")
        root = Path(self.url.removeprefix("file://")) if self.url else self.home / "tables"
        return Folder(root, str(root.resolve()))

    @cached_property
    def tables(self) -> Deltas:
        """The tables as Delta Lake stores them."""
        return Deltas(self.place)

    def scan(
        self, table: str, aircraft: Iterable[Aircraft] | None = None, flights: Iterable[str] | None = None
    ) -> pl.LazyFrame:
        """Scan the table, of all or some aircraft, as a lazy frame; empty where nothing is stored.

        With `flights`, files that can hold none of them are left out; other flights may still be among the rows.
        Columns that were declared after a file was written are null.
        """
        folders = None if aircraft is None else [shard_of(a) for a in aircraft]
        if folders is not None and flights is not None:
            folders = shards_with(TABLES[table], folders, flights, self.tables.shards(table))
        frame = self.tables.scan(table, folders)
        if frame is None:
            return TABLES[table].schema.create_empty().lazy()
        present = frame.collect_schema()
        new = {c: d.dtype for c, d in TABLES[table].schema.columns().items() if c not in present}
        return frame.with_columns(pl.lit(None, dtype).alias(c) for c, dtype in new.items()) if new else frame

    def read_table(self, table: str, aircraft: Iterable[Aircraft] | None = None) -> pl.DataFrame:
        """Read the table, of the whole fleet or of some aircraft."""
        return self.scan(table, aircraft).collect()

    def replace(self, table: str, aircraft: Iterable[Aircraft], frame: pl.DataFrame) -> None:
        """Replace all rows of these aircraft, or of the `FLEET`, by `frame`; no rows make no shard."""
        entry, owners = TABLES[table], list(aircraft)
        frame = entry.conform(frame).sort(entry.key)
        if owners != [FLEET]:
            _refuse_others(table, frame, pl.DataFrame(owners, schema=_AIRCRAFT, orient="row"))
        rows_of_shard = {shard_of(a, "all"): _rows_of(frame, a) for a in owners}
        self._change(
            table, lambda shards: ((s, rows) for s, rows in rows_of_shard.items() if rows.height or s in shards)
        )

    def merge(self, table: str, flights: Mapping[Aircraft, Iterable[str]], frame: pl.DataFrame) -> None:
        """Replace the rows of some flights of each aircraft by `frame`; other flights stay as they are."""
        cells = [(*a, flight) for a, ids in flights.items() for flight in ids]
        _refuse_others(table, frame, pl.DataFrame(cells, schema=[*_AIRCRAFT, "flight_id"], orient="row"))
        changes = [merge_flights(TABLES[table], shard_of(a), ids, _rows_of(frame, a)) for a, ids in flights.items()]
        self._change(table, lambda shards: chain.from_iterable(change(shards) for change in changes))

    def _change(self, table: str, change: Change) -> None:
        """Write shards of a table in one commit, provided each holds every key once."""

        def with_unique_keys(shards: StoredShards) -> Iterator[tuple[str, pl.DataFrame | None]]:
            for shard, frame in change(shards):
                if frame is not None and (twice := TABLES[table].repeated_keys(frame)).height:
                    first = ", ".join(f"{value}" for value in twice.row(0))
                    raise StoreError(f"{table}: {shard} would hold {twice.height} keys more than once, such as {first}")
                yield shard, frame

        self.tables.change(table, with_unique_keys)

    def declare(self, table: str) -> Version:
        """Give the table its columns even while nothing is stored; its newest version."""
        version = self.tables.write(table, {EMPTY: TABLES[table].schema.create_empty()})  # no commit if nothing changes
        assert version is not None
        return version

    def snapshot(self, versions: Mapping[str, int] | None = None) -> dict[str, tuple[int, list[str]]]:
        """List each table's version and its files; the newest, or some tables at other versions."""
        if versions is None:
            tables = {t: self.declare(t) for t in TABLES}
        else:
            tables = {t: v for t in TABLES if t in versions and (v := self.tables.version(t, versions[t]))}
        return {t: (v.number, sorted(f"{t}/{f}" for f in v.shards.values())) for t, v in tables.items()}

    def allow_reads(self, con: "duckdb.DuckDBPyConnection") -> None:
        """Let a DuckDB connection read the objects that the catalog's views name; local files it reads by itself."""
        if isinstance(self.place, Bucket) and not con.filesystem_is_registered("s3"):
            from pipelines.storage.object_reader import ObjectFiles

            con.register_filesystem(ObjectFiles(self.place))  # connections of one process share one database

    def sweep(self) -> int:
        """Remove temporary files of killed writers; the caller holds the home's lock."""
        return sweep(self.home) + self.place.sweep()


def shard_of(aircraft: Aircraft, shard: str = "") -> str:
    """Name a shard, or the folder of an aircraft; operator and tail are checked, since they become folder names."""
    if aircraft == FLEET:
        return "fleet"
    operator, tail = aircraft
    if not (re.fullmatch(OPERATOR, operator) and re.fullmatch(TAIL, tail)):
        raise ValueError(f"not an operator and tail: {operator!r}, {tail!r}")
    return f"{operator}/{tail}/{shard}".rstrip("/")


def _refuse_others(table: str, frame: pl.DataFrame, cells: pl.DataFrame) -> None:
    """Raise where a frame has rows of another aircraft or flight than those of `cells`."""
    others = frame.join(cells.cast(pl.String), on=cells.columns, how="anti")
    if others.height:
        first = " ".join(others.select(cells.columns).row(0))
        raise StoreError(f"{table}: {others.height} rows are of nothing that was asked for, such as {first}")


def _rows_of(frame: pl.DataFrame, aircraft: Aircraft) -> pl.DataFrame:
    return frame if aircraft == FLEET else frame.filter(operator=aircraft[0], tail=aircraft[1])
