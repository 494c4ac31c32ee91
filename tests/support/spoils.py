"""Ways to spoil one good flight: each takes the bytes of a file as delivered and gives other bytes."""

import io
import re
from collections.abc import Callable
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.intake.columns import SIGNAL_NAMES

Spoil = Callable[[bytes], bytes]


def fields_of(content: bytes) -> list[list[bytes]]:
    """Fields of each line."""
    return [line.split(b",") for line in content.splitlines()]


def joined(lines: list[list[bytes]]) -> bytes:
    """Lines of fields as a file."""
    return b"".join(b",".join(line) + b"\n" for line in lines)


def field(row: int, column: str, value: bytes) -> Spoil:
    """Write `value` into one field; rows count from 1."""

    def spoil(content: bytes) -> bytes:
        lines = fields_of(content)
        lines[row][lines[0].index(column.encode())] = value
        return joined(lines)

    return spoil


def column(names: str | tuple[str, ...], change: Callable[[float], float]) -> Spoil:
    """Change every value of some columns."""

    def spoil(content: bytes) -> bytes:
        lines = fields_of(content)
        for name in (names,) if isinstance(names, str) else names:
            at = lines[0].index(name.encode())
            for line in lines[1:]:
                line[at] = f"{change(float(line[at])):.4f}".encode() if line[at] else b""
        return joined(lines)

    return spoil


def rename(old: str, new: str) -> Spoil:
    """Give a column another name."""
    return lambda content: content.replace(old.encode(), new.encode(), 1)


def exchanged(one: str, other: str) -> Spoil:
    """Write two columns in each other's place."""
    return lambda content: rename("\0", other)(rename(other, one)(rename(one, "\0")(content)))


def drop(*names: str) -> Spoil:
    """Leave columns out."""

    def spoil(content: bytes) -> bytes:
        lines = fields_of(content)
        at = [lines[0].index(n.encode()) for n in names]
        return joined([[f for i, f in enumerate(line) if i not in at] for line in lines])

    return spoil


def reorder(content: bytes) -> bytes:
    """Write the columns in the opposite order."""
    return joined([line[::-1] for line in fields_of(content)])


def extra(content: bytes) -> bytes:
    """Add a column nobody asked for."""
    head, *rows = fields_of(content)
    return joined([[*head, b"operator_remark"], *([*row, b"ok"] for row in rows)])


def line_as(row: int, text: bytes) -> Spoil:
    """Replace a line."""
    return lambda content: b"\n".join(text if i == row else x for i, x in enumerate(content.split(b"\n")))


def retimed(text: Callable[[str], str]) -> Spoil:
    """Write every time differently."""
    return lambda c: re.sub(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", lambda m: text(m[0].decode()).encode(), c)


def parquet(content: bytes, change: Callable[[pl.DataFrame], pl.DataFrame] = lambda frame: frame) -> bytes:
    """The good flight as history."""
    frame = pl.read_csv(content, schema_overrides=dict.fromkeys(SIGNAL_NAMES, pl.Float64))
    time = pl.col("report_time").str.to_datetime("%Y-%m-%dT%H:%M:%SZ", time_zone="UTC")
    frame = frame.with_columns(time, pl.col("phase_code").fill_null(""))
    sink = io.BytesIO()
    change(frame).write_parquet(sink)
    return sink.getvalue()


def retyped(change: pl.Expr) -> Spoil:
    """The good flight as history, a column changed."""
    return lambda content: parquet(content, lambda frame: frame.with_columns(change))


def history_table(content: bytes) -> pa.Table:
    """The good flight as an Arrow table of history."""
    return pq.read_table(io.BytesIO(parquet(content)))


def annotated(content: bytes) -> bytes:
    """History with a note on one field that is not UTF-8, as a logger abroad writes "°C"."""
    table = history_table(content)
    at = table.schema.get_field_index("tat_degc")
    noted = table.schema.set(at, table.schema.field(at).with_metadata({b"note": b"\xb0C"}))
    return written(table.cast(noted))


def written(table: pa.Table, **options: Any) -> bytes:
    """An Arrow table as a Parquet file."""
    sink = io.BytesIO()
    pq.write_table(table, sink, **options)
    return sink.getvalue()


def timed(unit: str, zone: str | None, counts: list[int | None]) -> Spoil:
    """The good flight as history, times as counts of a unit that need not be of any calendar; None keeps the time."""

    def spoil(content: bytes) -> bytes:
        table = history_table(content)
        at = table.schema.get_field_index("report_time")
        good = table.column(at).cast(pa.timestamp(unit, "UTC"), safe=False).cast(pa.int64()).to_pylist()
        stamps = pa.array([g if c is None else c for g, c in zip(good, counts, strict=True)], pa.int64())
        return written(table.set_column(at, "report_time", stamps.view(pa.timestamp(unit, zone))))

    return spoil


def decimals(content: bytes) -> bytes:
    """History with Mach numbers as decimals wider than Polars knows."""
    table = history_table(content)
    at = table.schema.get_field_index("mach")
    return written(table.set_column(at, "mach", table.column(at).cast(pa.decimal256(50, 3), safe=False)))


def flip(content: bytes) -> bytes:
    """History with a byte of its data pages flipped, pages carrying checksums."""
    table = history_table(content)
    spoiled = bytearray(written(table, write_page_checksum=True, compression="none"))
    spoiled[2000] ^= 0x10
    return bytes(spoiled)


def claims_too_much(_: bytes) -> bytes:
    """Under half a megabyte that unpacks to a gigabyte."""
    zeros = pa.nulls(3_000_000, pa.int32()).fill_null(0)
    big = pa.table(dict.fromkeys(("flight_id", "report_time", "pack", *SIGNAL_NAMES), zeros))
    bomb = written(big, compression="zstd", row_group_size=3_000_000)
    assert len(bomb) < 500_000
    return bomb


def long_words(content: bytes) -> bytes:
    """A flight_id of a megabyte in every row, stored once."""
    return parquet(content, lambda f: f.with_columns(pl.lit("X" * 1_000_000).alias("flight_id")))
