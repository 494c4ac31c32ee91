"""Parse delivered times as UTC: ISO 8601 with Z, an offset or neither, to the microsecond."""

import re
from datetime import UTC, date, datetime

import polars as pl

from pipelines.intake.faults import Fault

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
