"""One Parquet file of a table: written once, named by its content."""

import hashlib
import io
import json
import re
from typing import Any, NamedTuple

import polars as pl

NAMED = re.compile(r"(?P<shard>.+)\.(?P<hash>[0-9a-f]{20})\.parquet")
_SKIPPED_BY = ("operator", "tail", "flight_id")  # whose span in each file lets a reader leave files out


class File(NamedTuple):
    """A data file to be written: its name below the table's folder, its bytes, and what a commit says of its rows."""

    name: str
    content: bytes
    stats: str


def pack(shard: str, frame: pl.DataFrame) -> File:
    """A shard as it is written."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer, compression="zstd")
    content = buffer.getvalue()
    return File(f"{shard}.{hash_of(content)}.parquet", content, json.dumps(_stats(frame)))


def hash_of(content: bytes) -> str:
    """What names a file by its content: 20 digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:20]


def hash_in(path: str) -> str:
    """The hash that a data file's name holds."""
    named = NAMED.fullmatch(path)
    return named["hash"] if named else ""


def _stats(frame: pl.DataFrame) -> dict[str, Any]:
    """Row count, and the span of the columns that name an aircraft and its flights."""
    named = frame.select(pl.selectors.by_name(*_SKIPPED_BY, require_all=False) & pl.selectors.string())
    spans = {side: named.select(getattr(pl.all(), side)()).to_dicts() for side in ("min", "max")}
    told = {f"{side}Values": {k: v for row in rows for k, v in row.items() if v} for side, rows in spans.items()}
    return {"numRecords": frame.height, **told, "nullCount": {c: named[c].null_count() for c in named.columns}}
