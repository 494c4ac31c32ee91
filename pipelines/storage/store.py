"""Read and write the tables of a home by aircraft and flight, in a folder or an object store.

A table by flight has a file for each month of an aircraft. The write that adds a month folds those that are no longer
among the newest into files by year, in the same commit, since late flights have become unlikely: after four years a
seventh of the files.
"""

import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl

from hdt_core.tables import TABLES, StoredTable
from hdt_core.tables.base import AIRFRAME_TAIL, OPERATOR
from pipelines.storage.delta import Change, Deltas, StoredShards, Version
from pipelines.storage.files import Folder, sweep
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
        if folders is None or flights is None:
            frame = self.tables.scan(table, folders)
        else:
            frame = self.tables.scan(table, partial(_shards_with, TABLES[table], folders, flights))
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
        entry = TABLES[table]
        owners = list(aircraft)
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
    if not (re.fullmatch(OPERATOR, operator) and re.fullmatch(AIRFRAME_TAIL, tail)):
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


OPEN = 3
"""Newest months of an aircraft with a file each; late flights seldom reach further back, and then rewrite a year."""
_MONTH = re.compile(r"\d{4}-\d{2}")


def _shards_with(
    entry: StoredTable, folders: Iterable[str], flights: Iterable[str], stored: Collection[str]
) -> list[str]:
    """List shards of some aircraft in which some flights can be; `stored` are those of the whole table."""
    names = _with_shard(flights, entry.shard_of)["shard"].unique().sort()
    pairs = ((f"{folder}/{n}", f"{folder}/{_year(n)}") for folder in folders for n in names)
    return list(dict.fromkeys(shard if shard in stored else year for shard, year in pairs))


def in_shard(name: str) -> pl.Expr:
    """Return whether a row whose own shard would be the column `shard` can be in the shard `name`."""
    own = pl.col("shard")
    return (own == name) | (own.str.contains(f"^{_MONTH.pattern}$") & (own.str.head(4) == name))


def without_folded(entry: StoredTable, frames: Mapping[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """Drop months of an aircraft that are in their year already: a folded file stays until it is vacuumed."""
    current = {}
    for shard, frame in frames.items():
        folder, _, name = shard.rpartition("/")
        year = frames.get(f"{folder}/{_year(name)}") if _MONTH.fullmatch(name) else None
        if not _holds(entry, year, name):
            current[shard] = frame
    return current


def merge_flights(entry: StoredTable, folder: str, flights: Iterable[str], frame: pl.DataFrame) -> Change:
    """Replace the rows of `flights` in an aircraft's shards by `frame`."""
    own_shard = entry.shard_of
    ids = {name: rows["flight_id"] for name, rows in _by_shard(_with_shard(flights, own_shard)).items()}
    fresh = _by_shard(frame.with_columns(own_shard))

    def change(shards: StoredShards) -> Iterator[tuple[str, pl.DataFrame | None]]:
        stored = {s for s in shards if s.startswith(f"{folder}/")}
        for shard, names in _targets(entry, folder, ids, fresh, shards, stored).items():
            months = [s for name in names if (s := f"{folder}/{name}") in stored and s != shard]
            rows = [entry.conform(shards[s]) for s in (shard, *months) if s in stored]
            new = [entry.conform(fresh[name]) for name in names if name in fresh]
            flight_ids = [flight for name in names for flight in ids.get(name, ())]
            others = [frame.filter(~pl.col("flight_id").is_in(flight_ids)) for frame in rows]
            if others or new:
                yield shard, pl.concat([*others, *new], how="diagonal").sort(entry.key)
                yield from dict.fromkeys(months).items()

    return change


def _targets(
    entry: StoredTable, folder: str, names_to_write: Collection[str], fresh: Collection[str], shards: StoredShards,
    stored: Collection[str],
) -> dict[str, list[str]]:  # fmt: skip
    """Map shards to write to the months (or flights, where a shard is one) whose rows they will hold."""
    names = {s.removeprefix(f"{folder}/") for s in stored}
    months = sorted(name for name in names.union(fresh) if _MONTH.fullmatch(name))
    old = set(months[:-OPEN])
    targets = dict[str, list[str]]()
    for name in sorted(old.union(names_to_write)):
        year = _year(name)
        is_folded = name not in names and year in names and _holds(entry, shards[f"{folder}/{year}"], name)
        in_year = name in old or is_folded
        targets.setdefault(f"{folder}/{year if in_year else name}", []).append(name)
    return targets


def _holds(entry: StoredTable, year: pl.DataFrame | None, month: str) -> bool:
    return year is not None and bool(year.select((entry.shard_of == month).any()).item())


def _year(name: str) -> str:
    """Name the shard into which a month is folded; any other name is its own."""
    return name[:4] if _MONTH.fullmatch(name) else name


def _by_shard(rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
    parts = rows.partition_by("shard", as_dict=True, include_key=False)
    return {str(name): part for (name,), part in parts.items()}


def _with_shard(flights: Iterable[Any], own_shard: pl.Expr) -> pl.DataFrame:
    return pl.DataFrame({"flight_id": list(flights)}, schema={"flight_id": pl.String}).with_columns(own_shard)
