"""A power cut: what was not synced is gone, content by content and name by name.

POSIX promises no more: content is there once the file was synced, a name (new or renamed) once its folder was, a folder
once the one it lies in was. SQLite keeps that promise by itself (`pragma synchronous`), so of its files the cut takes
what a commit had not reached: garbage stands behind the last commit of the ledger's log, and Dagster's history may be
lost altogether.
"""

import os
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any


class Disk:
    """Watches how this process writes below `home`, from now on."""

    def __init__(self, home: Path, shadow: Path) -> None:
        self.home = home.resolve()
        self.shadow = shadow
        shadow.mkdir()
        if (home / "dagster").exists():
            shutil.copytree(home / "dagster", shadow / "dagster")
        self.safe = {_which(f): _state(f) for f in self._files()}
        self.names: dict[str, list[tuple[Path, Path | None]]] = defaultdict(list)
        self._fsync = os.fsync
        self._mkdir = os.mkdir
        self._moves = {name: getattr(os, name) for name in ("rename", "replace")}
        os.fsync = self.fsync
        os.mkdir = self.mkdir
        for name in self._moves:
            setattr(os, name, lambda *a, _name=name, **kw: self.move(_name, *a, **kw))

    def _files(self) -> list[Path]:
        return [f for f in (*self.home.glob("tables/**/*"), *self.home.glob("*.duckdb")) if f.is_file()]

    def fsync(self, fd: int) -> None:
        """What this file holds, or the names this folder holds, is safe."""
        self._fsync(fd)
        path = os.readlink(f"/proc/self/fd/{fd}")
        self.names.pop(path, None)
        if os.path.isfile(path):
            self.safe[_which(path)] = _state(path)

    def mkdir(self, path: Any, *a: Any, **kw: Any) -> None:
        """A name not yet safe."""
        self._mkdir(path, *a, **kw)
        self._name(Path(path).absolute(), None)

    def move(self, name: str, source: Any, target: Any, **kw: Any) -> None:
        """A name not yet safe; what it stood for before is kept."""
        to = Path(target).absolute()
        copy = None
        if to.is_file():
            copy = self.shadow / str(len(list(self.shadow.iterdir())))
            os.link(to, copy)
        self._moves[name](source, target, **kw)
        self._name(to, copy)

    def _name(self, path: Path, before: Path | None) -> None:
        if path.is_relative_to(self.home / "tables") or path.suffix == ".duckdb":
            self.names[str(path.parent)].append((path, before))

    def cut(self, lose_history: bool) -> None:
        """Leave of the home what is safe."""
        for file in self._files():
            if self.safe.get(_which(file)) != _state(file):
                os.truncate(file, 0)
        for path, before in (n for names in self.names.values() for n in reversed(names)):
            if before is not None:
                self._moves["replace"](before, path)
            elif path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        for log in self.home.glob("ledger.sqlite-wal"):
            log.write_bytes(log.read_bytes() + b"\xa5" * 4096)
        if lose_history:
            shutil.rmtree(self.home / "dagster", ignore_errors=True)
            if (self.shadow / "dagster").exists():
                shutil.copytree(self.shadow / "dagster", self.home / "dagster")


def _which(path: Any) -> tuple[int, int]:
    stat = os.stat(path)
    return stat.st_dev, stat.st_ino


def _state(path: Any) -> tuple[int, int]:
    stat = os.stat(path)
    return stat.st_size, stat.st_mtime_ns
