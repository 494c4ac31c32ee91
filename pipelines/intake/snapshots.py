"""Read recorder files into validated rows in SI: snapshot reports, history files and continuous logs."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache

import polars as pl

from pipelines.intake.columns import CORE_NAMES, KEYS, SI_NAMES, SIGNAL_COLUMNS, SIGNAL_NAMES, WORDS
from pipelines.intake.faults import QUARANTINE_SCHEMA, Fault, limit_values, quarantine
from pipelines.intake.header import Header, match_header
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.names import flight_day, flight_of_file, flight_tail
from pipelines.intake.parquet import open_parquet
from pipelines.intake.readers import readers
from pipelines.intake.reasons import REASONS
from pipelines.intake.row_validation import ValidatedRows, describe_files, validate_rows
from pipelines.intake.text import Text, open_text
from pipelines.intake.text_columns import TEXT_INDEX, to_columns
from pipelines.intake.times import to_utc, zone_note
from pipelines.storage.panics import first_line, panics_as_errors

ROW_COLUMNS = ("operator", "tail", "flight_id", "pack", "time_utc", "source", *WORDS, *SI_NAMES, "file", "row_in_file")

_OPTIONAL = (*WORDS, *SIGNAL_NAMES)
_NUMBERS = ("pack", *SIGNAL_NAMES)


@dataclass(frozen=True, slots=True)
class Intake:
    """Result of some files: rows in SI, quarantine rows, and the number of rows each file delivered."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    delivered: pl.DataFrame
    """`file, n_delivered`"""

    @property
    def n_delivered(self) -> int:
        """Rows delivered by all files together."""
        return int(self.delivered["n_delivered"].sum())


@dataclass(slots=True)
class _OpenFile:
    """One open file: its columns are in the common frame, its faults here."""

    faults: list[Fault]
    n_rows: int = 0
    text: Text | None = None


def read_snapshots(files: Sequence[LandingFile], now: datetime) -> Intake:
    """Read `acms`, `history` and `cpl` files into rows in SI, and a quarantine row for each fault.

    Many files at once cost far less each than one at a time; the result is the same.

    Parameters
    ----------
    files : sequence of LandingFile
    now : datetime
        Times after it lie in the future. UTC.

    Returns
    -------
    Intake
        For each file `n_delivered` = rows in `rows` + `n_rows` in `quarantine`. Never raises for the content of a file.
    """
    try:
        with panics_as_errors():
            return _read_together(files, now)
    except Exception as error:
        if len(files) == 1:  # it costs no other file
            file = files[0]
            faults = quarantine(file.path, file.received_at, [Fault("cannot_process", detail=first_line(error))])
            return Intake(_no_rows(), faults, _delivered_frame([file.path], [0]))
    half = len(files) // 2
    parts = [read_snapshots(part, now) for part in (files[:half], files[half:])]
    return Intake(*(pl.concat([getattr(p, f) for p in parts]) for f in ("rows", "quarantine", "delivered")))


def _read_together(files: Sequence[LandingFile], now: datetime) -> Intake:
    open_files, raw = _open_all(files)
    rows = _no_rows()
    if raw.height:
        files_table = describe_files(files)
        result = validate_rows(raw, files_table, now)
        rows = _to_si(result.rows, files_table)
        _add_faults(result, open_files)
    frames = [quarantine(f.path, f.received_at, o.faults) for f, o in zip(files, open_files, strict=True) if o.faults]
    return Intake(
        rows,
        pl.concat([pl.DataFrame(schema=QUARANTINE_SCHEMA), *frames]),
        _delivered_frame([f.path for f in files], [o.n_rows for o in open_files]),
    )


def _delivered_frame(paths: list[str], n_rows: list[int]) -> pl.DataFrame:
    return pl.DataFrame({"file": paths, "n_delivered": n_rows}, schema={"file": pl.String, "n_delivered": pl.Int64})


def flights_in(file: LandingFile) -> list[str]:
    """List the flights of a file, sorted: from its name, or else from its flight_id column.

    Only well-formed ids of the file's own tail; none where it cannot be read, which `read_snapshots` reports.
    """
    flight_of_name = flight_of_file(file.name, file.tail)
    if flight_of_name is not None or file.is_recording:
        return [flight_of_name] if flight_of_name else []
    try:
        with panics_as_errors():
            _, raw = _open_all([file], only=("flight_id",))
    except Exception:
        return []
    flights = raw.get_column("flight_id").drop_nulls().unique().to_list() if raw.height else []
    return sorted(f for f in flights if flight_day(f) is not None and flight_tail(f) == file.tail)


def _open_all(
    files: Sequence[LandingFile], only: Collection[str] | None = None
) -> tuple[list[_OpenFile], pl.DataFrame]:
    """Open all files into one frame in recorded units, with `file_index` and `row`; times are UTC.

    Columns that no file has are null. With `only`, no other columns of Parquet files are read.
    """
    open_files, frames = [], []
    for i, file in enumerate(files):
        open_file, frame = _open(file, only)
        open_files.append(open_file)
        frames.append(frame.with_columns(pl.lit(i, pl.Int32).alias("file_index")))
    frames.append(_columns_of_texts(open_files))
    with_times = [_times_to_utc(frame, open_files) for frame in frames if frame.height]
    if not with_times:
        return open_files, pl.DataFrame()
    raw = pl.concat(with_times, how="diagonal")
    absent = [pl.lit(None, pl.String if c in WORDS else pl.Float64).alias(c) for c in _OPTIONAL if c not in raw.columns]
    return open_files, raw.with_columns(absent)


def _open(file: LandingFile, only: Collection[str] | None) -> tuple[_OpenFile, pl.DataFrame]:
    """Open one file; its columns, but those of a text, which is parsed with the others."""
    if file.is_recording:
        frame, n_rows, faults = readers()[file.folder].rows(file, "pack")
        return _OpenFile(faults, n_rows), frame
    content, faults = file.read_content()
    if content is None:
        return _OpenFile(faults), pl.DataFrame()
    if file.is_text:
        text = open_text(content, _match_names)
        return _OpenFile(text.faults, text=text), pl.DataFrame()
    frame, n_rows, faults = open_parquet(content, only)
    return _OpenFile(faults, n_rows), frame


def _columns_of_texts(open_files: Sequence[_OpenFile]) -> pl.DataFrame:
    texts = {i: o.text for i, o in enumerate(open_files) if o.text is not None}
    frame, faults = to_columns(list(texts.values()), _NUMBERS)
    for (i, text), faults_of_text in zip(texts.items(), faults, strict=True):
        open_files[i].faults.extend(faults_of_text)
        open_files[i].n_rows = text.n_rows
    if frame.is_empty():
        return frame
    index = pl.Series("file_index", list(texts), dtype=pl.Int32).gather(frame[TEXT_INDEX])
    return frame.with_columns(index).drop(TEXT_INDEX)


def _times_to_utc(frame: pl.DataFrame, open_files: Sequence[_OpenFile]) -> pl.DataFrame:
    if "report_time" not in frame.columns:
        return frame
    frame, naive = to_utc(frame, "report_time")
    for (i,), rows in naive.group_by("file_index"):
        open_files[i].faults.extend(zone_note(rows, "report_time"))
    return frame


@lru_cache(maxsize=256)  # thousands of files share a few headers
def _match_names(names_in_file: tuple[str, ...]) -> Header:
    return match_header(names_in_file, KEYS, _OPTIONAL, CORE_NAMES)


def _add_faults(result: ValidatedRows, open_files: Sequence[_OpenFile]) -> None:
    """Add the rows' faults to their files; a rejected row's invalid values are part of that row."""
    rows_by_file: dict[int, set[int]] = {}
    faults_of_rows: dict[int, list[Fault]] = {}
    for i, fault in result.faults:
        faults_of_rows.setdefault(i, []).append(fault)
        if fault.n_rows and fault.row is not None:
            rows_by_file.setdefault(i, set()).add(fault.row)
    for i, o in enumerate(open_files):
        faults = [f for f in o.faults if f.reason != "not_a_number" or f.row not in rows_by_file.get(i, ())]
        faults += faults_of_rows.get(i, ())
        values = [f for f in faults if REASONS[f.reason].scope == "value"]
        others = [f for f in faults if REASONS[f.reason].scope != "value"]
        o.faults = [_with_content(f, o) for f in others] + limit_values(values)


def _with_content(fault: Fault, open_file: _OpenFile) -> Fault:
    """Add the delivered line to the fault of a rejected row of a text file."""
    if open_file.text is None or not fault.n_rows or fault.row is None or fault.content is not None:
        return fault
    return replace(fault, content=open_file.text.line(fault.row))


def _to_si(rows: pl.DataFrame, files_table: pl.DataFrame) -> pl.DataFrame:
    """Convert validated rows to SI, in the order of `ROW_COLUMNS`."""
    si = [(pl.col(c.name) * c.scale + c.offset).alias(c.si_name) for c in SIGNAL_COLUMNS]
    place = ["operator", "tail", "source", "file"]
    of_file = files_table.select(pl.col(place).gather(rows["file_index"]))
    pack = pl.col("pack").cast(pl.Int32)
    values = rows.select("flight_id", pack, *WORDS, *si, time_utc="report_time", row_in_file="row")
    return values.hstack(of_file).select(ROW_COLUMNS)


def _no_rows() -> pl.DataFrame:
    types: dict[str, pl.DataType | type[pl.DataType]] = {
        "pack": pl.Int32,
        "time_utc": pl.Datetime("us", "UTC"),
        "row_in_file": pl.Int64,
        **dict.fromkeys(SI_NAMES, pl.Float64),
    }
    return pl.DataFrame(schema={c: types.get(c, pl.String) for c in ROW_COLUMNS})
