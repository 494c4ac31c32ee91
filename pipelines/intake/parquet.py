"""Read columns of Parquet files with Arrow, within a memory limit, whatever the bytes."""

import csv
import io
from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import datetime

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipelines.intake.columns import Contract, match_header
from pipelines.intake.faults import Fault, first_line, panics_as_errors
from pipelines.intake.text import parse_numbers

MAX_ROWS = 2_000_000
MAX_BYTES = 1 << 30
"""Limit of a file's unpacked size; a file that claims more is rejected before any of it is unpacked."""
MAX_LISTED = 100_000
"""Most rows of a list, which is read whole."""
MAX_WORD = 200
"""Longest text in a column, in bytes: one long word repeated by a dictionary unpacks to gigabytes."""

_FLIGHT = "flight_id"
_TIME = "report_time"
_CALENDAR_S = (-62_135_596_800, 253_402_300_799)
"""First and last second of the years 1 to 9999, counted from 1970."""


def open_parquet(
    content: bytes, contract: Contract, only: Collection[str] | None = None
) -> tuple[pl.DataFrame, int, list[Fault]]:
    """Read the contract columns (or `only` some) of a Parquet file with `row` from 1; the rows delivered; the faults.

    Arrow reads and not Polars, because a damaged page can make Polars panic, which is no ordinary exception.
    """
    try:
        schema = pq.read_schema(io.BytesIO(content))
        words = [f.name for f in schema if _is_text(f.type)]  # kept as codes: never unpacked beyond what was stored
        parquet = pq.ParquetFile(io.BytesIO(content), read_dictionary=words, page_checksum_verification=True)
        meta = parquet.metadata
        n_bytes = sum(meta.row_group(i).total_byte_size for i in range(meta.num_row_groups))
    except (pa.ArrowException, OSError, ValueError) as error:
        return pl.DataFrame(), 0, [_damage_fault(error)]
    if not 0 <= meta.num_rows <= MAX_ROWS or n_bytes > MAX_BYTES:
        return pl.DataFrame(), 0, [Fault("too_large", detail=f"It claims {meta.num_rows} rows and {n_bytes} bytes.")]
    try:
        with panics_as_errors():
            frame, faults = _read_table(parquet, meta.num_rows, only, contract)
    except Exception as error:
        return pl.DataFrame(), meta.num_rows, [_damage_fault(error, meta.num_rows)]
    return frame, meta.num_rows, faults


def _read_table(
    parquet: pq.ParquetFile, n_rows: int, only: Collection[str] | None, contract: Contract
) -> tuple[pl.DataFrame, list[Fault]]:
    names_of_file = parquet.schema_arrow.names
    header = match_header(tuple(names_of_file), contract)
    if header.fault is not None:
        return pl.DataFrame(), [replace(header.fault, n_rows=n_rows)]
    if n_rows == 0:
        return pl.DataFrame(), [*header.notes, Fault("no_rows")]
    columns_of = [(f, n) for f, n in zip(names_of_file, header.names, strict=True) if n and n in (only or (n,))]
    if odd := [n for f, n in columns_of if not _fits(parquet.schema_arrow.field(f).type, n, contract)]:
        return pl.DataFrame(), [Fault("wrong_type", None, ", ".join(odd), n_rows=n_rows)]
    table = parquet.read(columns=[f for f, _ in columns_of], use_threads=False)
    table.validate(full=True)
    if (longest := max((_longest_text_bytes(c) for c in table.columns), default=0)) > MAX_WORD:
        return pl.DataFrame(), [Fault("too_large", detail=f"A text has {longest} bytes.", n_rows=n_rows)]
    columns, notes = _to_polars_types(table, [n for _, n in columns_of])
    plain = pa.Table.from_arrays(columns, names=[n for _, n in columns_of])  # metadata of fields may make Polars panic
    frame = pl.DataFrame(pl.from_arrow(plain))
    frame, faults = _to_types(frame.with_row_index("row", 1).with_columns(pl.col("row").cast(pl.Int64)), contract)
    return frame, [*header.notes, *notes, *faults]


def _fits(kind: pa.DataType, name: str, contract: Contract) -> bool:
    """Return whether a column of this type holds the column `name` of the contract without loss."""
    if pa.types.is_dictionary(kind):
        return _fits(kind.value_type, name, contract)
    if pa.types.is_null(kind):
        return name not in contract.keys
    if name in (_FLIGHT, *contract.words) or _is_text(kind):
        return _is_text(kind)
    if name == _TIME:
        return bool(pa.types.is_timestamp(kind))
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind))


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))


def _longest_text_bytes(column: pa.ChunkedArray) -> int:
    """Return the bytes of a column's longest text, 0 where it holds none."""
    if not pa.types.is_dictionary(column.type):
        return 0
    return max(
        (pc.max(pc.binary_length(c.dictionary)).as_py() or 0 for c in column.chunks if _is_text(c.type.value_type)),
        default=0,
    )


def _to_types(frame: pl.DataFrame, contract: Contract) -> tuple[pl.DataFrame, list[Fault]]:
    """Cast text to String, times to Datetime or String, all else to Float64."""
    faults: list[Fault] = []
    texts = (_FLIGHT, _TIME, *contract.words)
    for name, dtype in frame.drop("row").schema.items():
        if dtype in (pl.Categorical, pl.Enum) or (dtype == pl.Null and name in texts):
            frame = frame.with_columns(pl.col(name).cast(pl.String))
        if name in texts:
            continue
        if frame.schema[name] == pl.String:
            frame, bad = parse_numbers(frame, name)
            faults.extend(fault for _, fault in bad)
        frame = frame.with_columns(pl.col(name).cast(pl.Float64))
    return frame, faults


def _to_polars_types(table: pa.Table, names: Sequence[str]) -> tuple[list[pa.ChunkedArray], list[Fault]]:
    """Convert times to UTC in microseconds and decimals to floats; a note where times have no zone."""
    columns = []
    notes = []
    for name, column in zip(names, table.columns, strict=True):
        if pa.types.is_timestamp(column.type):
            notes += [] if column.type.tz else [Fault("time_without_zone", column_name=name)]
            columns.append(_utc(column))
        else:  # Polars has no wide decimals
            columns.append(column.cast(pa.float64()) if pa.types.is_decimal(column.type) else column)
    return columns, notes


def _utc(times: pa.ChunkedArray) -> pa.ChunkedArray:
    """Convert instants of any unit and zone to UTC, null outside the years 1 to 9999, at which Polars panics.

    Arrow holds an instant as a count from 1970 in UTC, whatever zone it is to be shown in.
    """
    per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[times.type.unit]
    counts = times.cast(pa.int64())
    first, last = (max(-(2**63), min(s * per_second, 2**63 - 1)) for s in _CALENDAR_S)
    within = pc.and_(pc.greater_equal(counts, first), pc.less_equal(counts, last))
    counts = pc.if_else(within, counts, pa.scalar(None, pa.int64()))
    microseconds = (
        pc.multiply(counts, 10**6 // per_second) if per_second <= 10**6 else pc.divide(counts, per_second // 10**6)
    )
    return microseconds.cast(pa.timestamp("us", "UTC"))


def _damage_fault(error: Exception, n_rows: int = 0) -> Fault:
    return Fault("cannot_read_parquet", detail=first_line(error), n_rows=n_rows)


def parquet_as_text(content: bytes) -> tuple[bytes | None, list[Fault]]:
    """Convert a small list from Parquet to CSV; None and the fault where that fails.

    Line 2 of the CSV is row 1 of the file.
    """
    try:
        with pq.ParquetFile(io.BytesIO(content), page_checksum_verification=True) as parquet:
            if parquet.metadata.num_rows > MAX_LISTED:
                return None, [Fault("too_large", detail=f"It claims {parquet.metadata.num_rows} rows.")]
            columns = parquet.read(use_threads=False).to_pydict()
    except (pa.ArrowException, OSError, ValueError) as error:
        return None, [_damage_fault(error)]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_as_word(v) for v in row] for row in zip(*columns.values(), strict=True))
    return out.getvalue().encode(), []


def _as_word(value: object) -> str:
    """Format a value of a list as text on one line; of a time only the day."""
    text = "" if value is None else " ".join(str(value).split())[:MAX_WORD]
    return text.partition(" ")[0] if isinstance(value, datetime) else text
