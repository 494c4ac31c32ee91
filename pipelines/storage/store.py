"""Parquet is the store: which shard of which table holds what, whether files or objects keep it."""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from hdt_core.tables import TABLES
from hdt_core.tables.base import OPERATOR, TAIL
from pipelines.storage.files import Change, Files, Held, sweep
from pipelines.storage.objects import Objects, StoreError, objects

if TYPE_CHECKING:
    import duckdb

FLEET = ("", "")  # the one shard of a table that belongs to the whole fleet
URL = "HDT_STORE_URL"
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
    def shelf(self) -> Files | Objects:
        """Who keeps the shards."""
        if self.url.startswith("s3://"):
            return objects(self.url)
        if "://" in self.url.removeprefix("file://"):
            raise StoreError(f"{URL} is a folder or s3://bucket/prefix, not {self.url!r}")
        return Files(Path(self.url.removeprefix("file://")) if self.url else self.home / "tables")

    @property
    def root(self) -> str:
        """What the place of every shard begins with."""
        return self.shelf.url if isinstance(self.shelf, Objects) else str(self.shelf.root.resolve())

    @property
    def remote(self) -> bool:
        """Whether objects keep the shards, which no other program changes, moves or copies."""
        return isinstance(self.shelf, Objects)

    def folder(self, table: str, aircraft: tuple[str, str]) -> str:
        """Where the shards lie. Operator and tail are checked again here: they become names of folders."""
        if aircraft == FLEET:
            return table
        operator, tail = aircraft
        if not (re.fullmatch(OPERATOR, operator) and re.fullmatch(TAIL, tail)):
            raise ValueError(f"not an operator and tail: {operator!r}, {tail!r}")
        return f"{table}/{operator}/{tail}"

    def scan(self, table: str, aircraft: Iterable[tuple[str, str]] | None = None) -> pl.LazyFrame:
        """The table as a lazy frame in its declared types, of all or some aircraft; empty where nothing is stored."""
        folders = None if aircraft is None else [self.folder(table, a) for a in aircraft]
        stored = self.shelf.scan(table, folders)
        return TABLES[table].schema.create_empty().lazy() if stored is None else stored

    def read(self, table: str, aircraft: Iterable[tuple[str, str]] | None = None) -> pl.DataFrame:
        """The table, of the whole fleet or of some aircraft."""
        return self.scan(table, aircraft).collect()

    def replace(self, table: str, aircraft: tuple[str, str], frame: pl.DataFrame, shard: str = "all") -> None:
        """Write one shard whole."""
        name = "fleet" if aircraft == FLEET else shard
        self.shelf.change(self.folder(table, aircraft), lambda _: [(name, TABLES[table].conform(frame))])

    def merge(self, table: str, aircraft: tuple[str, str], flights: Iterable[str], frame: pl.DataFrame) -> None:
        """Replace the rows of `flights` by `frame`, shard by shard; other flights stay as they are."""
        self.shelf.change(self.folder(table, aircraft), _merged(table, flights, frame))

    def declare(self, table: str) -> None:
        """Let the table have its columns even while nothing is stored."""
        empty = TABLES[table].schema.create_empty()

        def lacking(held: Held) -> Iterable[tuple[str, pl.DataFrame]]:
            there = held(EMPTY)
            return [(EMPTY, empty)] if there is None or there.schema != empty.schema else []

        self.shelf.change(table, lacking)

    def snapshot(self) -> dict[str, list[str]]:
        """Of every table the files or objects, or their common pattern, that a catalog's view reads."""
        return self.shelf.snapshot(TABLES)

    def open_to(self, con: "duckdb.DuckDBPyConnection") -> None:
        """Let a DuckDB connection read what the catalog's views name."""
        self.shelf.open_to(con)

    def sweep(self) -> int:
        """Remove what killed writers left; called by the one who holds the home's lock."""
        return sweep(self.home) + self.shelf.sweep()


def _merged(table: str, flights: Iterable[str], frame: pl.DataFrame) -> Change:
    """Shards with the rows of `flights` replaced by `frame`."""
    entry = TABLES[table]
    asked = pl.DataFrame({"flight_id": list(flights)}, schema={"flight_id": pl.String}).with_columns(entry.shard_of)
    fresh = frame.with_columns(entry.shard_of).partition_by("shard", as_dict=True, include_key=False)

    def change(held: Held) -> Iterable[tuple[str, pl.DataFrame]]:
        for (shard,), own in asked.partition_by("shard", as_dict=True).items():
            new, before = fresh.get((shard,)), held(str(shard))
            if new is None and before is None:
                continue
            new = entry.conform(frame.clear() if new is None else new)
            if before is not None:
                kept = before.filter(~pl.col("flight_id").is_in(own["flight_id"].implode()))
                new = pl.concat([entry.conform(kept), new], how="diagonal")
            yield str(shard), new.sort(entry.key)

    return change
