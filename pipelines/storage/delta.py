"""Store tables in an open format, Delta Lake: Parquet files, written once, and a log of those that form each version.

    <table>/<operator>/<tail>/<shard>.<hash>.parquet    rows of one aircraft; the name holds the hash of the content
    <table>/_delta_log/                                 commits: files added and removed, with size and row count

A change is one commit: all of it or nothing. A commit that another has overtaken is made again on top of that one.
Any version is readable until its files are vacuumed.
"""

import io
import os
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import polars as pl
from deltalake import DeltaTable, Field, Schema
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.transaction import (
    AddAction,
    CommitProperties,
    PostCommitHookProperties,
    RemoveAction,
    create_table_with_add_actions,
)

from pipelines.storage.files import FILE_NAME, LOG, Folder, hash_in, hash_of, pack
from pipelines.storage.objects import Bucket, StoreError, message_of

StoredShards = Mapping[str, pl.DataFrame]
"""Shards of a table by name, each read on access."""
Commit = tuple[str, int, int]
"""Commit of a table's log: name, time in ns, size."""
Change = Callable[[StoredShards], Iterable[tuple[str, pl.DataFrame | None]]]
"""From the stored shards, the shards to write; None for a shard to remove, since another takes its rows."""
QUIET = PostCommitHookProperties(create_checkpoint=False, cleanup_expired_logs=False)  # upkeep has its own time
_ONCE: dict[str, Any] = {  # a commit that another has overtaken is made again by `change`
    "commit_properties": CommitProperties(max_commit_retries=0),
    "post_commithook_properties": QUIET,
}
_RETENTION: Mapping[str, str] = {"delta.deletedFileRetentionDuration": "interval 30 days"}


class Version(NamedTuple):
    """A table at a version: the file of each shard, below the table's folder."""

    number: int
    shards: dict[str, str]


class _OpenTable(NamedTuple):
    """A table as one writer has opened it, None where there is none, with its newest commit as far as known."""

    log: DeltaTable | None
    shards: dict[str, str]
    commit: Commit | None

    @classmethod
    def of(cls, log: DeltaTable | None, newest: Commit | None) -> "_OpenTable":
        if log is None:
            return cls(None, {}, None)
        return cls(log, shards_of(log), newest if newest and newest[0] == f"{log.version():020}.json" else None)

    @property
    def version(self) -> Version | None:
        return Version(self.log.version(), self.shards) if self.log is not None else None


@lru_cache(maxsize=2)
def _open_tables(_place: str) -> dict[str, _OpenTable]:
    """Cache of a place's tables that this process has opened and no writer uses at the moment.

    A night opens tables some five hundred times, through several stores, and a log of years takes a while to read.
    """
    return {}


class _CommitContent(NamedTuple):
    """Content of a commit: the columns of the rows written, the files added and removed."""

    columns: list[Field]
    added: list[AddAction]
    removed: list[RemoveAction]


class DamageError(StoreError):
    """A file is not what was written."""


class LogError(DamageError):
    """A table's log names files that can't be those of one version."""


@dataclass(frozen=True)
class Deltas:
    """All tables of one place."""

    place: Folder | Bucket
    _verified_paths: set[str] = field(default_factory=set)  # files whose hash this process has checked

    def open(self, table: str, version: int | None = None) -> DeltaTable | None:
        """Open the table at its newest or another version; None where there is none."""
        try:
            return DeltaTable(f"{self.place.url}/{table}", version, self.place.options)
        except TableNotFoundError:
            return None
        except (DeltaError, OSError) as error:
            raise self._unreadable(table, error) from None

    def _opened(self, table: str, log: DeltaTable | None, newest: Commit | None) -> _OpenTable:
        try:
            return _OpenTable.of(log, newest)
        except LogError as error:
            raise self._unreadable(table, error) from None

    def shards(self, table: str) -> dict[str, str]:
        """Map each shard to its file below the table's folder."""
        version = self.version(table)
        return version.shards if version else {}

    def version(self, table: str, number: int | None = None) -> Version | None:
        """Return the table's newest or another version; None where there is none."""
        if number is not None:
            return self._opened(table, self.open(table, number), None).version
        current = self._take(table)
        self._put_back(table, current)
        return current.version

    def newest_version(self, table: str) -> int | None:
        """Return the number of the table's newest version, of local files by their names; None where there is none."""
        commit = self._newest_commit(table)
        if commit is not None:
            return int(commit[0].removesuffix(".json"))
        version = self.version(table)
        return version.number if version else None

    def _take(self, table: str) -> _OpenTable:
        """Take the current table out of the cache, for one writer alone: a commit advances it under its readers."""
        entry = _open_tables(self.place.url).pop(table, None)
        newest = self._newest_commit(table)
        return entry if entry and entry.commit == newest else self._opened(table, self.open(table), newest)

    def _newest_commit(self, table: str) -> Commit | None:
        """Find the newest commit of a table's log; None where there is none, or it would take as long as opening it."""
        if isinstance(self.place, Bucket):
            return None
        try:
            log = os.scandir(self.place.root / table / LOG)
            newest = max((f for f in log if f.name.endswith(".json")), key=lambda f: f.name)
            now = newest.stat()
        except (FileNotFoundError, ValueError):
            return None
        return newest.name, now.st_mtime_ns, now.st_size

    def _put_back(self, table: str, current: _OpenTable) -> None:
        if current.commit is not None:
            _open_tables(self.place.url)[table] = current

    def scan(
        self, table: str, folders: Iterable[str] | Callable[[Collection[str]], Iterable[str]] | None = None
    ) -> pl.LazyFrame | None:
        """Scan the table, or some folders or shards of it, as one lazy frame; None where nothing is stored.

        `folders` names them, or is a function that chooses them from the names of the stored shards.

        Raises
        ------
        DamageError
            A file is missing or its content is not what was written.
        """
        files = self.shards(table)
        if folders is not None:
            prefixes = tuple(f"{folder}/" for folder in (folders(files) if callable(folders) else folders))
            files = {shard: file for shard, file in files.items() if f"{shard}/".startswith(prefixes)}
        sources = sorted(self.verify(f"{table}/{file}") for file in files.values())
        if not sources:
            return None
        options = self.place.options or None
        return pl.scan_parquet(
            sources, missing_columns="insert", extra_columns="ignore", storage_options=options, glob=False
        )

    def change(self, table: str, change: Change) -> Version | None:
        """Write shards of a table in one commit, all or none; the version that holds them."""
        while True:
            current = self._take(table)
            content = self._write(table, change(_ShardReader(self, table, current.shards)), current.shards)
            if content.added or content.removed:
                log = current.log
                advanced = self._begin(table, content) if log is None else self._commit(table, log, content)
                if advanced is None:
                    continue
                current = advanced
            self._put_back(table, current)
            return current.version

    def write(self, table: str, shards: Mapping[str, pl.DataFrame]) -> Version | None:
        """Write some shards of a table whole, in one commit."""
        return self.change(table, lambda _: shards.items())

    def remove_files(self, table: str, files: Iterable[str]) -> None:
        """Remove damaged files from the table."""
        log = self.open(table)
        names = set(files)
        now_ms = _now_ms()
        if log is not None and (current := names & set(shards_of(log).values())):
            self._commit(table, log, _CommitContent([], [], [RemoveAction(f, True, now_ms) for f in sorted(current)]))

    def read_file(self, path: str) -> bytes:
        """Read a data file whole and check its hash."""
        try:
            content = self.place.get(path)
        except OSError as error:
            raise self._damage(f"{path} can't be read ({error})") from None
        if hash_of(content) != hash_in(path):
            raise self._damage(f"{path} is not what was written")
        return content

    def verify(self, path: str) -> str:
        """Check a data file's hash, once in a process, and return the file's place."""
        if path not in self._verified_paths and not self.place.remote:
            self.read_file(path)
            self._verified_paths.add(path)
        return f"{self.place.url}/{path}"

    def _write(
        self, table: str, shards: Iterable[tuple[str, pl.DataFrame | None]], files: Mapping[str, str]
    ) -> _CommitContent:
        """Write the changed shards of a table, one after the other; a commit is yet to name their files."""
        content = _CommitContent([], [], [])
        fields = dict[str, Field]()
        now_ms = _now_ms()
        for shard, frame in shards:
            name = files.get(shard)
            if frame is not None:
                fields |= {f.name: f for f in Schema.from_arrow(frame.clear().to_arrow().schema).fields}
                file = pack(shard, frame)
                if file.name == name:
                    continue
                self.place.put(f"{table}/{file.name}", file.content)
                content.added.append(AddAction(file.name, len(file.content), {}, now_ms, True, file.stats))
            if name is not None:
                content.removed.append(RemoveAction(name, True, now_ms))
        return content._replace(columns=list(fields.values()))

    def _unreadable(self, table: str, error: Exception) -> StoreError:
        return self._damage(f"the log of {table} can't be read ({message_of(error)})")

    def _damage(self, fault: str) -> StoreError:
        """Make an error about stored files and have the next night read them all; a night restores no objects."""
        if self.place.remote:
            return StoreError(fault)
        self.place.mark_suspect()
        return DamageError(f"{fault}; `hdt nightly` makes it again")

    def _begin(self, table: str, content: _CommitContent) -> _OpenTable | None:
        """Make a table's first commit; None where another process began it."""
        sys.audit("hdt.before_commit")
        try:
            create_table_with_add_actions(
                f"{self.place.url}/{table}",
                Schema(content.columns),
                content.added,
                "error",
                storage_options=self.place.options,
                configuration=_RETENTION,
                **_ONCE,
            )
        except (DeltaError, OSError) as error:
            if self.open(table) is None:
                raise self._unreadable(table, error) from None
            return None
        sys.audit("hdt.after_commit")
        self.place.sync_commit(table, 0)
        return self._opened(table, self.open(table), self._newest_commit(table))

    def _commit(self, table: str, log: DeltaTable, content: _CommitContent) -> _OpenTable | None:
        """Make one commit; None where another came first."""
        sys.audit("hdt.before_commit")
        present = {f.name for f in log.schema().fields}
        new = [f for f in content.columns if f.name not in present]
        try:
            if new:
                log.alter.add_columns(new, **_ONCE)
            log.create_write_transaction([*content.added, *content.removed], "append", log.schema(), **_ONCE)
        except CommitFailedError:
            return None
        except DeltaError as error:
            raise StoreError(f"{table}: {message_of(error)}") from None
        sys.audit("hdt.after_commit")
        log.update_incremental()
        self.place.sync_commit(table, log.version())
        return self._opened(table, log, self._newest_commit(table))


@dataclass(frozen=True)
class _ShardReader(StoredShards):
    """A table's shards, each read on access."""

    tables: Deltas
    table: str
    files: Mapping[str, str]

    def __getitem__(self, shard: str) -> pl.DataFrame:
        return pl.read_parquet(io.BytesIO(self.tables.read_file(f"{self.table}/{self.files[shard]}")))

    def __contains__(self, shard: object) -> bool:  # inherited, it would read the file
        return shard in self.files

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


def shards_of(table: DeltaTable) -> dict[str, str]:
    """Map each shard of a table to its file, below the table's folder.

    Raises
    ------
    LogError
        A shard has two files, or a file's name is none of ours: an action of the log is not what was written.
    """
    shards: dict[str, str] = {}
    for path in pl.DataFrame(table.get_add_actions(flatten=True))["path"].to_list():
        match = FILE_NAME.fullmatch(path)
        if match is None or match["shard"] in shards:
            raise LogError(f"it has {path} beside others" if match else f"it names {path}")
        shards[match["shard"]] = path
    return shards


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
