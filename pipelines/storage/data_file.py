"""Encode a table's Parquet files: written once, named by their content."""

import hashlib
import io
import json
import re
from typing import Any, NamedTuple

import polars as pl

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
