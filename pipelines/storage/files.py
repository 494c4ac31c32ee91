"""Write local files whole or not at all: temporary name, fsync, rename; encode tables' files, named by content."""

import hashlib
import io
import json
import os
import re
import shutil
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import polars as pl

LOG = "_delta_log"
_SUSPECT = ".suspect"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; it becomes `path` when the block ends without an error.

    Temporary name, fsync, rename, fsync of the folder: none of Polars, PyArrow and DuckDB syncs, and a file written
    straight to its final name was corrupt after 20 to 25 of 25 kills.

    Raises
    ------
    FileExistsError
        `path` is a folder, a pipe or a device, which a rename would replace.
    """
    if path.exists() and not path.is_file():
        raise FileExistsError(f"{path} is not overwritten: it is no regular file; name another")
    _make_folder(path.parent)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        sys.audit("hdt.before_write")  # for tests, which kill at named places (benchmarks/fault_points.py)
        yield temporary
        _sync(temporary)
        sys.audit("hdt.before_rename")
        temporary.replace(path)
        sys.audit("hdt.after_rename")
        _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def narrow_umask() -> int:
    """Hide what this process writes from others, not from the group; the earlier mask. A narrower mask stays."""
    earlier = os.umask(0o077)
    os.umask(earlier | 0o027)
    return earlier


def make_private(path: Path) -> Path:
    """Restrict a file to its owner, creating it empty where it is missing: SQLite fills an empty file."""
    os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
    with suppress(PermissionError):  # not ours to change, but we may write it
        path.chmod(0o600)
    return path


@contextmanager
def replacing_folder(path: Path, ours: Collection[str]) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; it becomes `path` when the block ends without an error.

    An earlier folder is replaced only if it holds nothing but files named in `ours`.

    Raises
    ------
    FileExistsError
        Something else is in it, or `path` is a file.
    """
    if path.exists() and (not path.is_dir() or (strange := sorted({f.name for f in path.iterdir()} - set(ours)))):
        reason = f"it holds {strange[0]!r}, which no export wrote" if path.is_dir() else "it is a file"
        raise FileExistsError(f"{path} is not overwritten: {reason}; name a new folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep_folders(path)
    temporary, old = (path.with_name(f".{path.name}.{os.getpid()}.{end}") for end in ("part", "old.part"))
    temporary.mkdir()
    try:
        yield temporary
        for file in (*temporary.iterdir(), temporary):
            _sync(file)
        sys.audit("hdt.before_rename")
        if path.exists():
            path.rename(old)
        temporary.rename(path)
        sys.audit("hdt.after_rename")
        _sync(path.parent)
    finally:
        for folder in (temporary, old):
            shutil.rmtree(folder, ignore_errors=True)


def _sweep_folders(path: Path) -> None:
    """Remove temporary folders of killed writers beside `path`."""
    for folder in path.parent.glob(f".{path.name}.*.part"):
        pid = folder.name.removeprefix(f".{path.name}.").split(".")[0]
        if pid.isdigit() and not Path("/proc", pid).exists():
            shutil.rmtree(folder)


def _make_folder(path: Path) -> None:
    """Make a folder that survives a power cut: each new one is synced into the one above it."""
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
class Folder:
    """Tables below one local folder."""

    root: Path
    url: str
    """Prefix of the place of every file."""
    remote: ClassVar[bool] = False
    options: ClassVar[dict[str, str]] = {}
    """Storage options for readers of the files: none."""

    def get(self, path: str) -> bytes:
        """Read a file whole."""
        return (self.root / path).read_bytes()

    def put(self, path: str, content: bytes) -> None:
        """Write a file; it is synced to disk, name and all, on return."""
        with replacing(self.root / path) as temporary:
            temporary.write_bytes(content)

    def mark_suspect(self) -> None:
        """Have the next night read every file, since one is damaged; if this process may write here.

        Commands that only read call it too: an empty file more changes no answer of a damaged home.
        """
        with suppress(OSError):
            (self.root / _SUSPECT).touch()

    @property
    def suspect(self) -> bool:
        """Whether a damaged file has been met since the last repair."""
        return (self.root / _SUSPECT).exists()

    def clear_suspicion(self) -> None:
        """Note that every file has been checked or repaired."""
        (self.root / _SUSPECT).unlink(missing_ok=True)

    def sync_commit(self, table: str, version: int) -> None:
        """Sync a commit, the one before it and the log's own name to disk: Delta Lake's writer does not."""
        log = self.root / table / LOG
        for name in (f"{v:020}.{end}" for v in (version - 1, version) for end in ("json", "checkpoint.parquet")):
            with suppress(FileNotFoundError):
                _sync(log / name)
        for folder in (log, log.parent) if version == 0 else (log,):
            _sync(folder)

    def sweep(self) -> int:
        """Remove partial files of killed writers, and a last commit that a power cut truncated."""
        for log in self.root.glob(f"*/{LOG}"):
            last = max(log.glob("*.json"), default=None)
            if last is not None and not last.read_bytes().endswith((b"}", b"}\n")):
                last.unlink()
            if not any(log.glob("*.json")):  # its first commit was never made
                shutil.rmtree(log)
        for file in self.root.glob(f"*/{LOG}/*#*"):
            file.unlink()
        return sweep(self.root)


def sweep(folder: Path) -> int:
    """Remove temporary files of killed writers below a folder; their number."""
    files = [f for f in files_below(folder) if f.name.startswith(".") and f.name.endswith(".part")]
    for file in files:
        os.unlink(file)
    return len(files)


def files_below(folder: Path | str) -> Iterator[os.DirEntry[str]]:
    """Yield every file below a folder; `os.scandir`, since a home has ten thousand and `Path` is slow."""
    try:
        entries = list(os.scandir(folder))
    except FileNotFoundError:
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from files_below(entry.path)
        elif entry.is_file():
            yield entry


FILE_NAME = re.compile(r"(?P<shard>.+)\.(?P<hash>[0-9a-f]{20})\.parquet")
_KEY_COLUMNS = ("operator", "tail", "flight_id")  # whose span in each file lets a reader leave files out


class DataFile(NamedTuple):
    """A data file to be written: its name below the table's folder, its bytes, and its statistics for the commit."""

    name: str
    content: bytes
    stats: str


def pack(shard: str, frame: pl.DataFrame) -> DataFile:
    """Encode a shard as a Parquet file."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer, compression="zstd")
    content = buffer.getvalue()
    return DataFile(f"{shard}.{hash_of(content)}.parquet", content, json.dumps(_stats(frame)))


def hash_of(content: bytes) -> str:
    """Hash content for a file's name: the first 20 hexadecimal digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:20]


def hash_in(path: str) -> str:
    """Return the hash in a data file's name; empty where there is none."""
    match = FILE_NAME.fullmatch(path)
    return match["hash"] if match else ""


def _stats(frame: pl.DataFrame) -> dict[str, Any]:
    """Count the rows and find the span of the columns that name an aircraft and its flights."""
    names = frame.select(pl.selectors.by_name(*_KEY_COLUMNS, require_all=False) & pl.selectors.string())
    spans = {side: names.select(getattr(pl.all(), side)()).to_dicts() for side in ("min", "max")}
    limits = {f"{side}Values": {k: v for row in rows for k, v in row.items() if v} for side, rows in spans.items()}
    return {"numRecords": frame.height, **limits, "nullCount": {c: names[c].null_count() for c in names.columns}}
