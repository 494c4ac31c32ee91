"""Local files, and how any gets there whole or not at all: temporary name, fsync, rename."""

import os
import shutil
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import ClassVar

LOG = "_delta_log"
_DOUBTED = ".doubted"


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
    """Keep from others, not from the group, what this process makes from now on; the mask that was before.

    A narrower mask stays.
    """
    before = os.umask(0o077)
    os.umask(before | 0o027)
    return before


def private(path: Path) -> Path:
    """A file that its owner alone may read, made where it is missing: SQLite fills an empty one."""
    os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
    with suppress(PermissionError):  # not ours to change, but we may write it
        path.chmod(0o600)
    return path


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
        sys.audit("hdt.before_rename")
        if path.exists():
            path.rename(old)
        temporary.rename(path)
        sys.audit("hdt.after_rename")
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
class Folder:
    """Tables below one local folder."""

    root: Path
    url: str
    """What the place of every file begins with."""
    remote: ClassVar[bool] = False
    options: ClassVar[dict[str, str]] = {}
    """What a reader of the files must be told beside their names: nothing."""

    def get(self, path: str) -> bytes:
        """A file whole."""
        return (self.root / path).read_bytes()

    def put(self, path: str, content: bytes) -> None:
        """Write a file that is on the disk, name and all, when this returns."""
        with replacing(self.root / path) as temporary:
            temporary.write_bytes(content)

    def doubt(self) -> None:
        """Note that a file is not what was written, so that the next night reads all, if this process may write here.

        Commands that only read call it too: of a damaged home an empty file more is no answer changed.
        """
        with suppress(OSError):
            (self.root / _DOUBTED).touch()

    @property
    def doubted(self) -> bool:
        """Whether a file was not what was written when it was last read."""
        return (self.root / _DOUBTED).exists()

    def trust(self) -> None:
        """Note that every file is what was written."""
        (self.root / _DOUBTED).unlink(missing_ok=True)

    def newest_commit(self, table: str) -> tuple[str, int, int] | None:
        """Name, time and size of the newest commit of a table's log; None where there is none."""
        try:
            log = os.scandir(self.root / table / LOG)
            newest = max((f for f in log if f.name.endswith(".json")), key=lambda f: f.name)
            now = newest.stat()
        except (FileNotFoundError, ValueError):
            return None
        return newest.name, now.st_mtime_ns, now.st_size

    def settle(self, table: str, version: int) -> None:
        """Wait until a commit, the one before it and the log's own name are on the disk: who wrote the log did not."""
        log = self.root / table / LOG
        for name in (f"{v:020}.{end}" for v in (version - 1, version) for end in ("json", "checkpoint.parquet")):
            with suppress(FileNotFoundError):
                _sync(log / name)
        for folder in (log, log.parent) if version == 0 else (log,):
            _sync(folder)

    def sweep(self) -> int:
        """Remove what killed writers left: parts of files, and a last commit that a power cut tore."""
        for log in self.root.glob(f"*/{LOG}"):
            last = max(log.glob("*.json"), default=None)
            if last is not None and not last.read_bytes().endswith((b"}", b"}\n")):
                last.unlink()
            if not any(log.glob("*.json")):  # its first commit was never made
                shutil.rmtree(log)
        for left in self.root.glob(f"*/{LOG}/*#*"):
            left.unlink()
        return sweep(self.root)


def sweep(folder: Path) -> int:
    """Remove temporary files of killed writers below a folder."""
    left = [f for f in files_below(folder) if f.name.startswith(".") and f.name.endswith(".part")]
    for f in left:
        os.unlink(f)
    return len(left)


def files_below(folder: Path | str) -> Iterator[os.DirEntry[str]]:
    """Every file below a folder; a home has ten thousand, and paths that are taken apart would cost most of a look."""
    try:
        there = list(os.scandir(folder))
    except FileNotFoundError:
        return
    for entry in there:
        if entry.is_dir(follow_symlinks=False):
            yield from files_below(entry.path)
        elif entry.is_file():
            yield entry
