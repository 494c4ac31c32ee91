"""Parquet is the store: where each table lies below home, and how a file gets there whole or not at all."""

import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import polars as pl

from hdt_core.tables import TABLES
from hdt_core.tables.base import OPERATOR, TAIL
from pipelines.faults import fault_point

FLEET = ("", "")  # the one shard of a table that belongs to the whole fleet


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block ends well.

    Temporary name, fsync, rename, fsync of the folder: none of Polars, PyArrow and DuckDB syncs, and a file written
    straight to its final name was corrupt after 20 to 25 of 25 kills.
    """
    _make_folder(path.parent)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        fault_point("before_write")
        yield temporary
        _sync(temporary)
        fault_point("before_rename")
        temporary.replace(path)
        fault_point("after_rename")
        _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path, ours: Collection[str]) -> Iterator[Path]:
    """A temporary folder beside `path` that becomes `path` when the block ends well: all its files or none.

    An earlier folder gives way only if it holds nothing but files named in `ours`.

    Raises
    ------
    FileExistsError
        Something else is in it, or `path` is a file.
    """
    if path.exists() and (not path.is_dir() or (strange := sorted({f.name for f in path.iterdir()} - set(ours)))):
        held = f"it holds {strange[0]!r}, which no export wrote" if path.is_dir() else "it is a file"
        raise FileExistsError(f"{path} is not overwritten: {held}; name a new folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep_folders(path)
    temporary, old = (path.with_name(f".{path.name}.{os.getpid()}.{end}") for end in ("part", "old.part"))
    temporary.mkdir()
    try:
        yield temporary
        for file in (*temporary.iterdir(), temporary):
            _sync(file)
        fault_point("before_rename")
        if path.exists():
            path.rename(old)
        temporary.rename(path)
        fault_point("after_rename")
        _sync(path.parent)
    finally:
        for left in (temporary, old):
            shutil.rmtree(left, ignore_errors=True)


def _sweep_folders(path: Path) -> None:
    """Remove what killed writers of the folder `path` left beside it."""
    for left in path.parent.glob(f".{path.name}.*.part"):
        pid = left.name.removeprefix(f".{path.name}.").split(".")[0]
        if pid.isdigit() and not Path("/proc", pid).exists():
            shutil.rmtree(left)


def _make_folder(path: Path) -> None:
    """Make a folder whose name a power cut leaves: each new one is synced into the one above it."""
    new = list(takewhile(lambda p: not p.exists(), (path, *path.parents)))
    path.mkdir(parents=True, exist_ok=True)
    for folder in new:
        _sync(folder.parent)


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@dataclass(frozen=True)
class Store:
    """All tables below one home."""

    home: Path

    def folder(self, table: str) -> Path:
        """Where a table's files lie."""
        return self.home / "tables" / table

    def path(self, table: str, aircraft: tuple[str, str], shard: str = "all") -> Path:
        """File of one shard. Operator and tail are checked again here: they become folder names."""
        if aircraft == FLEET:
            return self.folder(table) / "fleet.parquet"
        operator, tail = aircraft
        if not (re.fullmatch(OPERATOR, operator) and re.fullmatch(TAIL, tail)):
            raise ValueError(f"not an operator and tail: {operator!r}, {tail!r}")
        return self.folder(table) / operator / tail / f"{shard}.parquet"

    def files(self, table: str, aircraft: Iterable[tuple[str, str]] | None = None) -> list[Path]:
        """The table's files, of the whole fleet or of some aircraft."""
        if aircraft is None:
            return sorted(self.folder(table).glob("**/[!.]*.parquet"))
        return sorted(f for a in aircraft for f in self.path(table, a).parent.glob("[!.]*.parquet"))

    def scan(self, table: str, aircraft: Iterable[tuple[str, str]] | None = None) -> pl.LazyFrame:
        """The table as a lazy frame in its declared types; empty where nothing is stored yet."""
        files = self.files(table, aircraft)
        if not files:
            return TABLES[table].schema.create_empty().lazy()
        return pl.scan_parquet(files, missing_columns="insert", extra_columns="ignore")

    def read(self, table: str, aircraft: Iterable[tuple[str, str]] | None = None) -> pl.DataFrame:
        """The table, of the whole fleet or of some aircraft."""
        return self.scan(table, aircraft).collect()

    def replace(self, table: str, aircraft: tuple[str, str], frame: pl.DataFrame, shard: str = "all") -> None:
        """Write one shard whole."""
        with replacing(self.path(table, aircraft, shard)) as temporary:
            TABLES[table].conform(frame).write_parquet(temporary, compression="zstd")

    def merge(self, table: str, aircraft: tuple[str, str], flights: Iterable[str], frame: pl.DataFrame) -> None:
        """Replace the rows of `flights` by `frame`, shard by shard; other flights stay as they are."""
        entry = TABLES[table]
        asked = pl.DataFrame({"flight_id": list(flights)}, schema={"flight_id": pl.String}).with_columns(entry.shard_of)
        fresh = frame.with_columns(entry.shard_of).partition_by("shard", as_dict=True, include_key=False)
        for (shard,), own in asked.partition_by("shard", as_dict=True).items():
            path, new = self.path(table, aircraft, str(shard)), fresh.get((shard,))
            if new is None and not path.exists():
                continue
            new = entry.conform(frame.clear() if new is None else new)
            if path.exists():
                kept = pl.read_parquet(path).filter(~pl.col("flight_id").is_in(own["flight_id"].implode()))
                new = pl.concat([entry.conform(kept), new], how="diagonal")
            self.replace(table, aircraft, new.sort(entry.key), str(shard))

    def sweep(self) -> int:
        """Remove what a killed writer left; called by the one who holds the home's lock."""
        left = [f for f in self.home.glob("**/.*.part") if f.is_file()]
        for f in left:
            f.unlink()
        return len(left)
