"""Tables as objects of an S3 store, which knows no rename: fresh names, then one put of a manifest that names them.

    data/<table>/<operator>/<tail>/<shard>.<fresh>.parquet    written once, never changed
    manifests/<table>/<operator>/<tail>/manifest.json         which of them are the table's shards now
    published.json                                            which of them the catalog reads
    unnamed.json                                              which nobody names, and since when

A writer killed at any moment leaves the old manifest. A manifest is put on condition that it is still the one that was
read, so of two writers of one aircraft the second does its work again on what the first left. Server and keys are those
of the usual AWS_* variables.
"""

import io
import json
import os
import time
import uuid
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import polars as pl

from pipelines.storage.fault_points import fault_point
from pipelines.storage.files import Change

if TYPE_CHECKING:
    import duckdb
    from obstore.store import S3Store

GRACE_S = 24 * 3600.0
_AT_ONCE = 32  # requests under way: each waits for the network far longer than it works
_PUBLISHED, _UNNAMED = "published.json", "unnamed.json"


class StoreError(OSError):
    """What keeps the tables from being read or written, in one line."""


@dataclass(frozen=True)
class Manifest:
    """Objects of a folder's shards, and by what the store knows this version of the manifest; None: there is none."""

    shards: dict[str, str] = field(default_factory=dict)
    e_tag: str | None = None


@dataclass(frozen=True)
class Objects:
    """Shards as objects below one URL, `s3://bucket/prefix`.

    An object that nobody names is removed once it has been seen so for `grace_s`: as long as a reader of an earlier
    manifest, or a writer that has not yet put its own, may take.
    """

    url: str
    grace_s: float = GRACE_S

    @cached_property
    def store(self) -> "S3Store":
        """The client; it tries again by itself where the network fails."""
        try:
            from obstore.store import S3Store
        except ImportError:
            raise StoreError("an object store needs the extra s3: pip install 'hybrid-digital-twin[s3]'") from None
        return S3Store.from_url(self.url, client_options={"allow_http": _plain_http()})

    def sources(self, table: str, folders: Iterable[str] | None = None) -> list[str]:
        """URLs of the table's objects, or of those of some folders of it, as the manifests name them now."""
        keys = self._list(f"manifests/{table}") if folders is None else [_manifest(f) for f in folders]
        return sorted(f"{self.url}/{key}" for m in self._manifests(keys) for key in m.shards.values())

    def scan(self, table: str, folders: Iterable[str] | None = None) -> pl.LazyFrame | None:
        """The table, or some folders of it, as one lazy frame, of which only the columns asked for are fetched.

        None where nothing is stored.
        """
        sources = self.sources(table, folders)
        if not sources:
            return None
        how = {"aws_allow_http": str(_plain_http()).lower()}
        return pl.scan_parquet(sources, missing_columns="insert", extra_columns="ignore", storage_options=how)

    def change(self, folder: str, change: Change) -> None:
        """Write shards of a folder, all or none."""
        done = False
        while not done:
            now = self._read(_manifest(folder))

            def held(shard: str, now: Manifest = now) -> pl.DataFrame | None:
                return pl.read_parquet(io.BytesIO(self.get(now.shards[shard]))) if shard in now.shards else None

            new = {shard: self._put_shard(folder, shard, frame) for shard, frame in change(held)}
            done = not new or self._commit(folder, now, new)

    def snapshot(self, tables: Iterable[str]) -> dict[str, list[str]]:
        """The objects of this moment, which stay until the next snapshot has been taken."""
        taken = {table: self.sources(table) for table in tables}
        keys = [url.removeprefix(f"{self.url}/") for url in chain.from_iterable(taken.values())]
        self._put(_PUBLISHED, json.dumps(keys).encode())
        return taken

    def open_to(self, con: "duckdb.DuckDBPyConnection") -> None:
        """Let a DuckDB connection read the objects, and nothing else of the store."""
        from pipelines.storage.object_reader import Window

        if not con.filesystem_is_registered("s3"):  # connections of one process share one database
            con.register_filesystem(Window(self))

    def sweep(self) -> int:
        """Remove objects that nobody has named for long; called by the one who holds the home's lock.

        Once in `grace_s` is enough: it reads every manifest.
        """
        seen, since_s = self._unnamed()
        if since_s < self.grace_s:
            return 0
        there = set(self._list("data"))  # listed first: what is named in between is found among the named
        named = {key for m in self._manifests(self._list("manifests")) for key in m.shards.values()}
        published = self._ask(_PUBLISHED)
        stray = there - named - set(json.loads(published.content) if published else ())
        now = time.time()
        gone = {key for key in stray if now - seen.get(key, now) >= self.grace_s}
        self._delete(gone)
        self._put(_UNNAMED, json.dumps({key: seen.get(key, now) for key in stray - gone}).encode())
        return len(gone)

    def sizes(self, prefix: str) -> dict[str, int]:
        """Bytes of each object below a prefix."""
        import obstore

        with _told():
            found = chain.from_iterable(obstore.list(self.store, prefix))
            return {meta["path"]: meta["size"] for meta in found}

    def _list(self, prefix: str) -> list[str]:
        return list(self.sizes(prefix))

    def _unnamed(self) -> tuple[dict[str, float], float]:
        """What nobody named at the last sweep, each since when, and how long ago that sweep was."""
        answer = self._ask(_UNNAMED)
        if answer is None:
            return {}, float("inf")
        return json.loads(answer.content), time.time() - answer.meta["last_modified"].timestamp()

    def _manifests(self, keys: list[str]) -> list[Manifest]:
        if len(keys) < 2:
            return [self._read(key) for key in keys]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            return list(pool.map(self._read, keys))

    def _read(self, key: str) -> Manifest:
        answer = self._ask(key)
        return Manifest(json.loads(answer.content), answer.meta["e_tag"]) if answer else Manifest()

    def _commit(self, folder: str, before: Manifest, new: dict[str, str]) -> bool:
        """Name the new objects beside those that stay; False if another writer has named his own meanwhile."""
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        shards = json.dumps(before.shards | new, sort_keys=True).encode()
        fault_point("before_manifest")
        try:
            self._put(_manifest(folder), shards, mode={"e_tag": before.e_tag} if before.e_tag else "create")
        except (AlreadyExistsError, PreconditionError):
            return False
        fault_point("after_manifest")
        return True

    def _put_shard(self, folder: str, shard: str, frame: pl.DataFrame) -> str:
        fault_point("before_write")
        key, packed = f"data/{folder}/{shard}.{uuid.uuid4().hex}.parquet", io.BytesIO()
        frame.write_parquet(packed, compression="zstd")
        self._put(key, packed.getvalue())
        return key

    def get(self, key: str) -> bytes:
        """An object whole."""
        answer = self._ask(key)
        if answer is None:
            raise StoreError(f"{self.url}/{key} is gone; it was replaced more than {self.grace_s / 3600:.0f} hours ago")
        return answer.content

    def _ask(self, key: str) -> "_Answer | None":
        import obstore

        with _told():
            try:
                answer = obstore.get(self.store, key)
                return _Answer(bytes(answer.bytes()), answer.meta)
            except FileNotFoundError:
                return None

    def _put(self, key: str, content: bytes, **how: Any) -> None:
        import obstore

        with _told():
            obstore.put(self.store, key, content, **how)

    def _delete(self, keys: set[str]) -> None:
        import obstore

        with _told():
            if keys:
                obstore.delete(self.store, sorted(keys))


class _Answer(NamedTuple):
    """An object and what the store says of it."""

    content: bytes
    meta: Any


@contextmanager
def _told() -> Iterator[None]:
    """What the server or the network says, in one line; a refused condition goes on its way."""
    from obstore.exceptions import AlreadyExistsError, BaseError, PreconditionError

    try:
        yield
    except (AlreadyExistsError, PreconditionError):
        raise
    except BaseError as error:
        raise StoreError(str(error).splitlines()[0]) from None


@cache
def objects(url: str) -> Objects:
    """The store at a URL, with the one client this process needs for it."""
    return Objects(url.rstrip("/"))


def _manifest(folder: str) -> str:
    return f"manifests/{folder}/manifest.json"


def _plain_http() -> bool:
    """Only a server named by an address without encryption is spoken to without."""
    return os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
