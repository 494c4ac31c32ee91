"""Tables in an open format, Delta Lake: Parquet files, written once, and a log that says which of them a table is now.

    <table>/<operator>/<tail>/<shard>.<hash>.parquet    rows of one aircraft; the name holds the hash of the content
    <table>/_delta_log/                                 commits: which files came and went, with size and row count

A change is one commit: all of it or nothing. A commit that another has overtaken is made again on what that one left.
Any version is readable until its files are vacuumed.
"""

import io
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
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

from pipelines.storage.data_file import NAMED, hash_in, hash_of, pack
from pipelines.storage.files import Folder
from pipelines.storage.objects import Bucket, StoreError
from pipelines.storage.panics import message_of

Held = Mapping[str, pl.DataFrame]
"""What a table holds, by the names of its shards; a shard is read when it is asked for."""
Change = Callable[[Held], Iterable[tuple[str, pl.DataFrame | None]]]
"""Of what a table holds, the shards to write; None where a shard goes, since another takes its rows."""
QUIET = PostCommitHookProperties(create_checkpoint=False, cleanup_expired_logs=False)  # upkeep has its own time
_ONCE: dict[str, Any] = {  # a commit that was overtaken is made anew here
    "commit_properties": CommitProperties(max_commit_retries=0),
    "post_commithook_properties": QUIET,
}


class Version(NamedTuple):
    """A table as it is at a version: the file of each shard, below the table's folder."""

    number: int
    shards: dict[str, str]


class _TableState(NamedTuple):
    """A table as one writer has opened it, None where there is none, and the file of each of its shards."""

    table: DeltaTable | None
    shards: dict[str, str]


@lru_cache(maxsize=2)
def _opened(_place: str) -> dict[str, tuple[object, _TableState]]:
    """Tables of a place that this process has opened and no writer holds, each with its newest commit then.

    A night asks some five hundred times, through several stores, and a log of years takes a while to read.
    """
    return {}


class _CommitContent(NamedTuple):
    """What a commit will say: the columns of what was written, files that came and files that go."""

    columns: list[Field]
    added: list[AddAction]
    gone: list[RemoveAction]


class DamageError(StoreError):
    """A file is not what was written."""


@dataclass(frozen=True)
class Deltas:
    """All tables of one place."""

    place: Folder | Bucket
    _sound: set[str] = field(default_factory=set)  # files this process has read whole and found as they were written

    def open(self, table: str, version: int | None = None) -> DeltaTable | None:
        """The table now, or at a version; None where there is none."""
        try:
            return DeltaTable(f"{self.place.url}/{table}", version, self.place.options)
        except TableNotFoundError:
            return None
        except (DeltaError, OSError) as error:
            raise self._unreadable(table, error) from None

    def shards(self, table: str) -> dict[str, str]:
        """The file of each shard, below the table's folder."""
        taken = self._take(table)
        self._leave(table, taken)
        return taken.shards

    def at(self, table: str, version: int | None = None) -> Version | None:
        """The table now, or at a version, as data; None where there is none."""
        taken = self._take(table) if version is None else _taken(self.open(table, version))
        if taken.table is None:
            return None
        number = taken.table.version()
        if version is None:
            self._leave(table, taken)
        return Version(number, taken.shards)

    def _take(self, table: str) -> _TableState:
        """The table now, for one writer alone: a commit moves it on, and another thread must not find it moved."""
        newest = self.place.newest_commit(table)
        known, taken = _opened(self.place.url).pop(table, (None, None))
        if taken is not None and newest == known:
            return taken
        return _taken(self.open(table))

    def _leave(self, table: str, taken: _TableState) -> None:
        """Leave a table to the next who asks, unless another commit has come since."""
        newest = self.place.newest_commit(table)
        if taken.table is not None and newest is not None and newest[0] == f"{taken.table.version():020}.json":
            _opened(self.place.url)[table] = newest, taken

    def sources(self, table: str, shards: Iterable[str] | None = None) -> list[str]:
        """Places of the files of all or some shards; of a folder's name, all below it."""
        held = self.shards(table).items()
        wanted = None if shards is None else tuple(f"{s}/" for s in shards)
        return sorted(self.sound(f"{table}/{f}") for s, f in held if wanted is None or f"{s}/".startswith(wanted))

    def scan(self, table: str, shards: Iterable[str] | None = None) -> pl.LazyFrame | None:
        """The table, or some folders of it, as one lazy frame; None where nothing is stored.

        Raises
        ------
        DamageError
            A file is missing or its content is not what was written.
        """
        sources = self.sources(table, shards)
        if not sources:
            return None
        how = self.place.options or None
        return pl.scan_parquet(sources, missing_columns="insert", extra_columns="ignore", storage_options=how)

    def change(self, table: str, change: Change) -> None:
        """Write shards of a table in one commit, all or none."""
        while True:
            now, files = taken = self._take(table)
            made = self._write(table, change(_Shards(self, table, files)), files)
            if not (made.added or made.gone):
                return self._leave(table, taken)
            if self._begin(table, made) if now is None else self._commit(table, now, made):
                return None

    def put(self, table: str, shards: Mapping[str, pl.DataFrame]) -> None:
        """Write some shards of a table whole, in one commit."""
        self.change(table, lambda _: shards.items())

    def drop(self, table: str, files: Iterable[str]) -> None:
        """Let the table be without some of its files, which are not what was written."""
        now, lost = self.open(table), set(files)
        if now is not None and (left := lost & set(shards_of(now).values())):
            self._commit(table, now, _CommitContent([], [], [_removed(file) for file in sorted(left)]))

    def read(self, path: str) -> bytes:
        """A data file whole."""
        try:
            content = self.place.get(path)
        except OSError as error:
            raise self._damage(f"{path} can't be read ({error})") from None
        if hash_of(content) != hash_in(path):
            raise self._damage(f"{path} is not what was written")
        return content

    def sound(self, path: str) -> str:
        """The place of a data file, whose content this process has seen to be what was written."""
        if path not in self._sound and not self.place.remote:
            self.read(path)
            self._sound.add(path)
        return f"{self.place.url}/{path}"

    def _write(
        self, table: str, shards: Iterable[tuple[str, pl.DataFrame | None]], files: Mapping[str, str]
    ) -> "_CommitContent":
        """Write what is new of a table's shards, one after the other; a commit is yet to name it."""
        written, fields = _CommitContent([], [], []), dict[str, Field]()
        for shard, frame in shards:
            name = files.get(shard)
            if frame is not None:
                fields |= {f.name: f for f in Schema.from_arrow(frame.clear().to_arrow().schema).fields}
                file = pack(shard, frame)
                if file.name == name:
                    continue
                self.place.put(f"{table}/{file.name}", file.content)
                now_ms = time.time_ns() // 1_000_000
                written.added.append(AddAction(file.name, len(file.content), {}, now_ms, True, file.stats))
            if name is not None:
                written.gone.append(_removed(name))
        return written._replace(columns=list(fields.values()))

    def _unreadable(self, table: str, error: Exception) -> StoreError:
        """What keeps a log from being read, in one line."""
        return self._damage(f"the log of {table} can't be read ({message_of(error)})")

    def _damage(self, fault: str) -> StoreError:
        """An error about what is stored; the next night reads every file. Of objects no night makes any again."""
        if self.place.remote:
            return StoreError(fault)
        self.place.doubt()
        return DamageError(f"{fault}; `hdt nightly` makes it again")

    def _begin(self, table: str, made: "_CommitContent") -> bool:
        """A table's first commit; False where another began it."""
        where, how = f"{self.place.url}/{table}", self.place.options
        sys.audit("hdt.before_commit")
        try:
            create_table_with_add_actions(
                where, Schema(made.columns), made.added, "error", storage_options=how, configuration=_KEPT, **_ONCE
            )
        except (DeltaError, OSError) as error:
            if self.open(table) is None:
                raise self._unreadable(table, error) from None
            return False
        sys.audit("hdt.after_commit")
        self.place.settle(table, 0)
        return True

    def _commit(self, table: str, now: DeltaTable, made: "_CommitContent") -> bool:
        """One commit; False where another came first."""
        sys.audit("hdt.before_commit")
        have = {f.name for f in now.schema().fields}
        more = [f for f in made.columns if f.name not in have]
        try:
            if more:
                now.alter.add_columns(more, **_ONCE)
            now.create_write_transaction([*made.added, *made.gone], "append", now.schema(), **_ONCE)
        except CommitFailedError:
            return False
        except DeltaError as error:
            raise StoreError(f"{table}: {message_of(error)}") from None
        sys.audit("hdt.after_commit")
        now.update_incremental()
        self.place.settle(table, now.version())
        self._leave(table, _taken(now))
        return True


@dataclass(frozen=True)
class _Shards(Held):
    """A table's shards, each read when it is asked for."""

    tables: Deltas
    table: str
    files: Mapping[str, str]

    def __getitem__(self, shard: str) -> pl.DataFrame:
        return pl.read_parquet(io.BytesIO(self.tables.read(f"{self.table}/{self.files[shard]}")))

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


_KEPT: Mapping[str, str] = {"delta.deletedFileRetentionDuration": "interval 30 days"}


def shards_of(table: DeltaTable) -> dict[str, str]:
    """The file of each shard of a table, below its folder."""
    paths = pl.DataFrame(table.get_add_actions(flatten=True))["path"].to_list()
    return {named["shard"]: path for path in paths if (named := NAMED.fullmatch(path))}


def _taken(table: DeltaTable | None) -> _TableState:
    return _TableState(table, {} if table is None else shards_of(table))


def _removed(file: str) -> RemoveAction:
    return RemoveAction(file, True, time.time_ns() // 1_000_000)
