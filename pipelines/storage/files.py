"""Tables as local files, and how any file gets there whole or not at all: temporary name, fsync, rename."""

import fcntl
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from pipelines.storage.fault_points import fault_point

if TYPE_CHECKING:
    import duckdb


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block ends well.

    Temporary name, fsync, rename, fsync of the folder: none of Polars, PyArrow and DuckDB syncs, and a file written
    straight to its final name was corrupt after 20 to 25 of 25 kills.

    Raises
    ------
    FileExistsError
        `path` is a folder, a pipe or a device, which a rename would put an end to.
    """
    if path.exists() and not path.is_file():
        raise FileExistsError(f"{path} is not overwritten: it is no regular file; name another")
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


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Two runs may hold flights of one aircraft and month: the second waits, and finds the rows of the first.

    The lock is on a file, since a shared folder of another machine (NFS) locks only what is open for writing.
    """
    _make_folder(folder)
    with open(folder / ".lock", "ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


Held = Callable[[str], pl.DataFrame | None]
"""What a shard of a folder holds, by the shard's name; None where there is none."""
Change = Callable[[Held], Iterable[tuple[str, pl.DataFrame]]]
"""Of what a folder holds, the shards to write."""


@dataclass(frozen=True)
class Files:
    """Shards as files below one folder, each replaced by a rename."""

    root: Path

    def sources(self, table: str, folders: Iterable[str] | None = None) -> list[Path]:
        """The table's files, or those of some folders of it."""
        if folders is None:
            return sorted((self.root / table).glob("**/[!.]*.parquet"))
        return sorted(f for folder in folders for f in (self.root / folder).glob("[!.]*.parquet"))

    def scan(self, table: str, folders: Iterable[str] | None = None) -> pl.LazyFrame | None:
        """The table, or some folders of it, as one lazy frame; None where nothing is stored."""
        sources = self.sources(table, folders)
        return pl.scan_parquet(sources, missing_columns="insert", extra_columns="ignore") if sources else None

    def change(self, folder: str, change: Change) -> None:
        """Write shards of a folder, one after the other."""

        own = self.root / folder

        def held(shard: str) -> pl.DataFrame | None:
            path = own / f"{shard}.parquet"
            return pl.read_parquet(path) if path.exists() else None

        with _alone_in(own):
            for shard, frame in change(held):
                with replacing(own / f"{shard}.parquet") as temporary:
                    frame.write_parquet(temporary, compression="zstd")

    def snapshot(self, tables: Iterable[str]) -> dict[str, list[str]]:
        """What the catalog's views read, below `root`: whatever lies there when they are asked."""
        return {table: [f"{table}/**/*.parquet"] for table in tables}

    def open_to(self, con: "duckdb.DuckDBPyConnection") -> None:
        """DuckDB reads files by itself."""

    def sweep(self) -> int:
        """Remove what a killed writer left; called by the one who holds the home's lock."""
        return sweep(self.root)


def sweep(folder: Path) -> int:
    """Remove temporary files of killed writers below a folder."""
    left = [f for f in folder.glob("**/.*.part") if f.is_file()]
    for f in left:
        f.unlink()
    return len(left)
