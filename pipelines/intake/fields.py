"""Check delivered names (operators, tails, flights, files); parse times: ISO 8601 with Z, an offset or neither."""

import re
from datetime import UTC, date, datetime

import polars as pl

from hdt_core.tables.base import FLIGHT_ID, OPERATOR, TAIL
from pipelines.intake.faults import Fault

MAX_PACKS = 4
EARLIEST = date(1980, 1, 7)
"""A clock that was never set gives 1970, or 6 January 1980 where it is GPS; an older date is a typing error."""
_OPERATOR, _TAIL, _FLIGHT_ID = (re.compile(p, re.ASCII) for p in (OPERATOR, TAIL, FLIGHT_ID))
_HISTORY = re.compile(r"history_\d{4}-\d{2}\.parquet", re.ASCII)


def is_operator(name: str) -> bool:
    """Return whether `name` is that of an operator."""
    return _OPERATOR.fullmatch(name) is not None


def is_tail(name: str) -> bool:
    """Return whether `name` is a registration."""
    return _TAIL.fullmatch(name) is not None


def is_history(name: str) -> bool:
    """Return whether `name` is that of a history file."""
    return _HISTORY.fullmatch(name) is not None


def flight_day(flight_id: str) -> date | None:
    """Parse the UTC day of departure of a flight_id; None where it is none: bad pattern, no such day, leg 00.

    Examples
    --------
    >>> flight_day("LX-AAA_20240229_01")
    datetime.date(2024, 2, 29)
    >>> flight_day("LX-AAA_20230229_01"), flight_day("../X_20240101_01"), flight_day("LX-AAA_20240101_00")
    (None, None, None)
    """
    if _FLIGHT_ID.fullmatch(flight_id) is None or flight_id.endswith("_00"):
        return None
    digits = flight_id[-11:-3]
    try:
        return date(int(digits[:4]), int(digits[4:6]), int(digits[6:]))
    except ValueError:
        return None


def flight_tail(flight_id: str) -> str:
    """Return the tail of a well-formed flight_id."""
    return flight_id[:-12]


def flight_of_file(name: str, tail: str) -> str | None:
    """Return the flight that a file is named after; None where the name is no flight_id of this tail."""
    stem = name.rpartition(".")[0]
    return stem if flight_day(stem) is not None and flight_tail(stem) == tail else None


_CONTRACT = "%Y-%m-%dT%H:%M:%SZ"
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d{1,9})?)?(Z|[+-]\d\d(:?\d\d)?)?", re.ASCII)


def to_utc(frame: pl.DataFrame, name: str) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Parse the text column `name` as UTC times, null where unreadable; also the rows whose time has no zone.

    The contract's own format is parsed in bulk; any other ISO 8601 format value by value. A fraction is kept to the
    microsecond, an offset is converted, a time without either counts as UTC.
    """
    if frame.schema[name] != pl.String:
        return frame, frame.clear()
    bulk = pl.col(name).str.to_datetime(_CONTRACT, strict=False, time_unit="us", time_zone="UTC")
    with_times = frame.with_columns(bulk.alias("_time"))
    others = with_times.filter(pl.col("_time").is_null() & pl.col(name).is_not_null())
    naive = frame.clear()
    if others.height:
        texts = others.get_column(name).unique().to_list()
        moments = [_moment(text) for text in texts]
        schema = {name: pl.String(), "_other": pl.Datetime("us", "UTC"), "_naive": pl.Boolean()}
        other = pl.DataFrame([(t, *m) for t, m in zip(texts, moments, strict=True)], schema=schema, orient="row")
        with_times = with_times.join(other, on=name, how="left", maintain_order="left", validate="m:1")
        naive = with_times.filter(pl.col("_naive").fill_null(False)).select(frame.columns)
        with_times = with_times.with_columns(pl.coalesce("_time", "_other").alias("_time"))
    return with_times.select(pl.col("_time").alias(name) if c == name else c for c in frame.columns), naive


def _moment(text: str) -> tuple[datetime | None, bool]:
    """Parse a text as UTC time, None where it is none; and whether it has no zone."""
    text = text.strip()
    if _ISO.fullmatch(text) is None:
        return None, False
    try:
        moment = datetime.fromisoformat(text.replace(",", "."))
        naive = moment.tzinfo is None
        return (moment.replace(tzinfo=UTC) if naive else moment.astimezone(UTC)), naive
    except (ValueError, OverflowError):
        return None, False


def to_day(text: str | None) -> date | None:
    """Parse an ISO 8601 date; None where it is none."""
    text = (text or "").strip()
    try:
        return date.fromisoformat(text) if re.fullmatch(r"\d{4}-\d\d-\d\d", text) else None
    except ValueError:
        return None


def zone_note(naive: pl.DataFrame, name: str) -> list[Fault]:
    """Make one note for the rows whose time has no zone."""
    return [Fault("time_without_zone", column_name=name, detail=f"Rows: {naive.height}.")] if naive.height else []
