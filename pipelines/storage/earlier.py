"""Tables as versions before Delta Lake kept them, taken over: one file a shard, or objects that a manifest names."""

import io
import json
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import polars as pl

from hdt_core.tables import TABLES
from pipelines.storage.data_file import hash_in
from pipelines.storage.files import LOG, Folder
from pipelines.storage.objects import Bucket
from pipelines.storage.store import Store

_BEGUN = ".converting"


def fault_of(store: Store) -> str | None:
    """Why a night can't go on from these tables, and what to do; None where it can."""
    if isinstance(store.place, Bucket):  # a listing a night would cost more than it is worth
        return None
    root = store.place.root
    lacking = [t for t in TABLES if (root / t).is_dir() and not (root / t / LOG).exists()]
    if (root / _BEGUN).exists() or any(_old_files(store.place, table) for table in lacking):
        return (
            f"the tables of {store.home} are of an earlier version; `hdt convert --home {store.home}` takes them over"
        )
    return None


def convert(store: Store) -> dict[str, int]:
    """Shards taken over of each table, one commit an aircraft; what was there before goes once it is in the table.

    It may be stopped and started again.
    """
    if isinstance(store.place, Folder) and fault_of(store):
        (store.place.root / _BEGUN).touch()
    taken = {table: n for table in TABLES if (n := sum(_take_over(store, table)))}
    if isinstance(store.place, Folder):
        for left in (*store.place.root.glob("**/.lock"), store.place.root / _BEGUN):
            left.unlink(missing_ok=True)
    return taken


def _take_over(store: Store, table: str) -> Iterator[int]:
    place = store.place
    old = _objects(place, table) if isinstance(place, Bucket) else _old_files(place, table)
    for _, found in groupby(sorted(old.items()), key=lambda item: item[0].rpartition("/")[0]):
        shards = dict(found)
        frames = {s: pl.read_parquet(io.BytesIO(place.get(path))) for s, path in shards.items()}
        store.tables.put(table, frames)
        if isinstance(place, Folder):
            for path in shards.values():
                (place.root / path).unlink()
        yield len(shards)


def _old_files(place: Folder, table: str) -> dict[str, str]:
    """The file of each shard, below the place."""
    found = (file.relative_to(place.root) for file in sorted((place.root / table).glob("**/[!.]*.parquet")))
    return {_shard(p): str(p) for p in found if not hash_in(str(p)) and LOG not in p.parts}


def _objects(place: Bucket, table: str) -> dict[str, str]:
    """The object of each shard, as the manifests name them."""
    manifests = sorted(place.sizes(f"manifests/{table}"))
    folders = {m: Path(m).relative_to(f"manifests/{table}").parent for m in manifests}
    return {str(folders[m] / s): key for m in manifests for s, key in json.loads(place.get(m)).items()}


def _shard(file: Path) -> str:
    return str(Path(*file.parts[1:]).with_suffix(""))
