"""Fingerprint of a home: a hash of every table's rows, independent of how they were made."""

import hashlib
from pathlib import Path

import polars as pl

from hdt_core.tables import TABLES
from pipelines.storage.store import Store


def fingerprint(home: Path, *url: str) -> dict[str, str]:
    """Hash of every table's rows, sorted; of the home's store, or of that at `url`.

    Of a fitted model its `model_version`, which is a hash of what it knows: the archive holds the hour it was packed,
    card and service what was in service before.
    """
    store = Store(home, *url)
    return {table: _hash(store.read_table(table).drop("card", "service", strict=False)) for table in TABLES}


def _hash(frame: pl.DataFrame) -> str:
    frame = frame.with_columns(pl.col(pl.List(pl.Float64)).cast(pl.List(pl.String)).list.join(","))
    plain = pl.concat_str((~pl.selectors.binary()).cast(pl.String).fill_null("\0"), separator="\x1f")
    return hashlib.blake2b("\n".join(frame.select(plain).to_series().sort()).encode(), digest_size=16).hexdigest()
