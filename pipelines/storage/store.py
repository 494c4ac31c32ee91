"""Which shard of which table holds what, whether a folder or an object store keeps the files."""

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
from pipelines.storage.delta import Change, Deltas, Held, Version
from pipelines.storage.files import Folder, sweep
from pipelines.storage.months import merged, shards_with
from pipelines.storage.objects import Bucket, StoreError, bucket

if TYPE_CHECKING:
    import duckdb

Aircraft = tuple[str, str]
FLEET = ("", "")  # the one shard of a table that belongs to the whole fleet
URL = "HDT_STORE_URL"
_AIRCRAFT = ["operator", "tail"]
EMPTY = "empty"
"""A shard without rows: it has a table's columns while nothing else is stored."""


@dataclass(frozen=True)
class Store:
    """All tables of one home.

    They lie below `<home>/tables` or, where `url` (by default the variable HDT_STORE_URL) says so, in another folder or
    in an object store, `s3://bucket/prefix`.
    """

    home: Path
    url: str = field(default_factory=lambda: os.environ.get(URL, ""))

    @cached_property
    def place(self) -> Folder | Bucket:
        """Who keeps the files."""
        if self.url.startswith("s3://"):
            return bucket(self.url)
        if "://" in self.url.removeprefix("file://"):
            raise StoreError(f"{URL} is a folder or s3://bucket/prefix, not {self.url!r}")
        root = Path(self.url.removeprefix("file://")) if self.url else self.home / "tables"
        return Folder(root, str(root.resolve()))

    @cached_property
    def tables(self) -> Deltas:
        """The tables as Delta Lake keeps them."""
        return Deltas(self.place)

    def scan(
        self, table: str, aircraft: Iterable[Aircraft] | None = None, flights: Iterable[str] | None = None
    ) -> pl.LazyFrame:
        """The table as a lazy frame in its declared types, of all or some aircraft; empty where nothing is stored.

        Where only some `flights` of these aircraft are asked for, no file is read in which none of them can be. Columns
        that are declared since are null.
        """
        folders = None if aircraft is None else [shard_of(a) for a in aircraft]
        if folders is not None and flights is not None:
            folders = shards_with(TABLES[table], folders, flights, self.tables.shards(table))
        stored = self.tables.scan(table, folders)
        if stored is None:
            return TABLES[table].schema.create_empty().lazy()
        held = stored.collect_schema()
        new = {c: d.dtype for c, d in TABLES[table].schema.columns().items() if c not in held}
        return stored.with_columns(pl.lit(None, dtype).alias(c) for c, dtype in new.items()) if new else stored

    def read(self, table: str, aircraft: Iterable[Aircraft] | None = None) -> pl.DataFrame:
        """The table, of the whole fleet or of some aircraft."""
        return self.scan(table, aircraft).collect()

    def replace(self, table: str, aircraft: Iterable[Aircraft], frame: pl.DataFrame) -> None:
        """Let `frame` be all that the table holds of these aircraft, or of the `FLEET`; no rows make no shard."""
        entry, asked = TABLES[table], list(aircraft)
        frame = entry.conform(frame).sort(entry.key)
        if asked != [FLEET]:
            _refuse_others(table, frame, pl.DataFrame(asked, schema=_AIRCRAFT, orient="row"))
        shards = {shard_of(a, "all"): _own(frame, a) for a in asked}
        self._change(table, lambda held: ((s, own) for s, own in shards.items() if own.height or s in held))

    def merge(self, table: str, flights: Mapping[Aircraft, Iterable[str]], frame: pl.DataFrame) -> None:
        """Replace the rows of some flights of each aircraft by `frame`; other flights stay as they are."""
        asked = [(*a, flight) for a, ids in flights.items() for flight in ids]
        _refuse_others(table, frame, pl.DataFrame(asked, schema=[*_AIRCRAFT, "flight_id"], orient="row"))
        changes = [merged(TABLES[table], shard_of(a), ids, _own(frame, a)) for a, ids in flights.items()]
        self._change(table, lambda held: chain.from_iterable(change(held) for change in changes))

    def _change(self, table: str, change: Change) -> None:
        """Write shards of a table in one commit, if each holds every key once."""

        def checked(held: Held) -> Iterator[tuple[str, pl.DataFrame | None]]:
            for shard, frame in change(held):
                if frame is not None and (twice := TABLES[table].doubled(frame)).height:
                    first = ", ".join(f"{value}" for value in twice.row(0))
                    raise StoreError(f"{table}: {shard} would hold {twice.height} keys more than once, such as {first}")
                yield shard, frame

        self.tables.change(table, checked)

    def declare(self, table: str) -> Version:
        """The table now, which has its columns even while nothing is stored."""
        self.tables.put(table, {EMPTY: TABLES[table].schema.create_empty()})  # no commit where it is there as it is
        now = self.tables.at(table)
        assert now is not None
        return now

    def retype(self, table: str) -> int:
        """Write shards anew that hold a column in another type than is declared now, in one commit; how many."""
        entry, before = TABLES[table], self.tables.shards(table)
        declared = entry.schema.create_empty().schema

        def change(held: Held) -> Iterator[tuple[str, pl.DataFrame]]:
            if EMPTY in held and held[EMPTY].schema == declared:  # nothing has changed since a night published it
                return
            for shard, frame in held.items():
                if any(declared.get(column, dtype) != dtype for column, dtype in frame.schema.items()):
                    yield shard, entry.conform(frame)

        self.tables.change(table, change)
        return len(set(before.values()).difference(self.tables.shards(table).values()))

    def doubled(self, table: str) -> dict[Aircraft, int]:
        """How many primary keys of each aircraft, or of the `FLEET`, are stored more than once."""
        entry = TABLES[table]
        if not (key := entry.schema.primary_key()):
            return {}
        owner = [pl.lit("") if entry.grain == "fleet" else pl.col(c).first() for c in _AIRCRAFT]
        counted = self.scan(table).group_by(key).agg(pl.len(), o=owner[0], t=owner[1]).filter(pl.col("len") > 1)
        return {(o, t): n for o, t, n in counted.group_by("o", "t").len("n").collect().rows()}

    def snapshot(self, versions: Mapping[str, int] | None = None) -> dict[str, tuple[int, list[str]]]:
        """Of every table its version, and the files below its place that it is; now, or of some at other versions."""
        if versions is None:
            held = {t: self.declare(t) for t in TABLES}
        else:
            held = {t: d for t in TABLES if t in versions and (d := self.tables.at(t, versions[t]))}
        return {t: (d.number, sorted(f"{t}/{f}" for f in d.shards.values())) for t, d in held.items()}

    def open_to(self, con: "duckdb.DuckDBPyConnection") -> None:
        """Let a DuckDB connection read what the catalog's views name; local files it reads by itself."""
        if isinstance(self.place, Bucket) and not con.filesystem_is_registered("s3"):
            from pipelines.storage.object_reader import Window

            con.register_filesystem(Window(self.place))  # connections of one process share one database

    def sweep(self) -> int:
        """Remove what killed writers left; called by the one who holds the home's lock."""
        return sweep(self.home) + self.place.sweep()


def shard_of(aircraft: Aircraft, shard: str = "") -> str:
    """A shard, or all of an aircraft. Operator and tail are checked again here: they become names of folders."""
    if aircraft == FLEET:
        return "fleet"
    operator, tail = aircraft
    if not (re.fullmatch(OPERATOR, operator) and re.fullmatch(TAIL, tail)):
        raise ValueError(f"not an operator and tail: {operator!r}, {tail!r}")
    return f"{operator}/{tail}/{shard}".rstrip("/")


def _refuse_others(table: str, frame: pl.DataFrame, asked: pl.DataFrame) -> None:
    """Raise an error where a frame has rows of another aircraft or flight than the `asked`."""
    others = frame.join(asked.cast(pl.String), on=asked.columns, how="anti")
    if others.height:
        first = " ".join(others.select(asked.columns).row(0))
        raise StoreError(f"{table}: {others.height} rows are of nothing that was asked for, such as {first}")


def _own(frame: pl.DataFrame, aircraft: Aircraft) -> pl.DataFrame:
    """Rows of one aircraft."""
    return frame if aircraft == FLEET else frame.filter(operator=aircraft[0], tail=aircraft[1])
