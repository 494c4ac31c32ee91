"""Recorder files become judged rows in SI: snapshot reports, history files and continuous logs."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache

import polars as pl

from pipelines.intake.columns import CORE_NAMES, KEYS, SI_NAMES, SIGNAL_COLUMNS, SIGNAL_NAMES, WORDS
from pipelines.intake.header import Header, judge_header
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.ledger import QUARANTINE_SCHEMA, Fault, quarantine, shortened
from pipelines.intake.names import flight_day, flight_of_file, flight_tail
from pipelines.intake.parquet import open_parquet
from pipelines.intake.readers import readers
from pipelines.intake.reasons import REASONS
from pipelines.intake.row_validation import ValidatedRows, about_files, judge
from pipelines.intake.text import Text, open_text
from pipelines.intake.text_columns import PLACE, to_columns
from pipelines.intake.times import to_utc, zone_note
from pipelines.storage.panics import first_line, panics_as_errors

ROW_COLUMNS = ("operator", "tail", "flight_id", "pack", "time_utc", "source", *WORDS, *SI_NAMES, "file", "row_in_file")

_KNOWN = (*WORDS, *SIGNAL_NAMES)
_NUMBERS = ("pack", *SIGNAL_NAMES)


@dataclass(frozen=True, slots=True)
class Intake:
    """What came of some files: rows in SI, what is wrong with them, and how many rows each file delivered."""

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
    """One file after opening: its columns are in the common frame, its faults here."""

    faults: list[Fault]
    n_rows: int = 0
    text: Text | None = None


def read_snapshots(files: LandingFile | Sequence[LandingFile], now: datetime) -> Intake:
    """Rows of `acms`, `history` and `cpl` files in SI, and a quarantine row for all that is wrong with them.

    Many files at once cost far less each than one at a time; the answer is the same.

    Parameters
    ----------
    files : LandingFile or sequence of them
    now : datetime
        Times after it lie in the future. UTC.

    Returns
    -------
    Intake
        For each file `n_delivered` = rows in `rows` + `n_rows` in `quarantine`. Never raises for what a file holds.
    """
    files = [files] if isinstance(files, LandingFile) else list(files)
    try:
        with panics_as_errors():
            return _read_together(files, now)
    except Exception as error:
        if len(files) == 1:
            return _failed(files[0], error)
    half = len(files) // 2
    parts = [read_snapshots(part, now) for part in (files[:half], files[half:])]
    return Intake(*(pl.concat([getattr(p, f) for p in parts]) for f in ("rows", "quarantine", "delivered")))


def _failed(file: LandingFile, error: Exception) -> Intake:
    """A file that nobody foresaw costs itself and no other."""
    told = quarantine(file.path, file.received_at, [Fault("cannot_process", detail=first_line(error))])
    return Intake(_no_rows(), told, _delivered([file.path], [0]))


def _read_together(files: Sequence[LandingFile], now: datetime) -> Intake:
    opened, raw = _open_all(files)
    rows = _no_rows()
    if raw.height:
        about = about_files(files)
        judged = judge(raw, about, now)
        rows = _in_si(judged.rows, about)
        _record(judged, opened)
    frames = [quarantine(f.path, f.received_at, o.faults) for f, o in zip(files, opened, strict=True) if o.faults]
    return Intake(
        rows,
        pl.concat([pl.DataFrame(schema=QUARANTINE_SCHEMA), *frames]),
        _delivered([f.path for f in files], [o.n_rows for o in opened]),
    )


def _delivered(paths: list[str], n_rows: list[int]) -> pl.DataFrame:
    return pl.DataFrame({"file": paths, "n_delivered": n_rows}, schema={"file": pl.String, "n_delivered": pl.Int64})


def flights_in(file: LandingFile) -> list[str]:
    """Flights a file says it holds, sorted: from its name, or else from its flight_id column.

    Only well-formed ids of the file's own tail; none where it cannot be read, which `read_snapshots` then explains.
    """
    named = flight_of_file(file.name, file.tail)
    if named is not None or file.is_recording:
        return [named] if named else []
    try:
        with panics_as_errors():
            _, raw = _open_all([file], only=("flight_id",))
    except Exception:
        return []
    found = raw.get_column("flight_id").drop_nulls().unique().to_list() if raw.height else []
    return sorted(f for f in found if flight_day(f) is not None and flight_tail(f) == file.tail)


def _open_all(
    files: Sequence[LandingFile], only: Collection[str] | None = None
) -> tuple[list[_OpenFile], pl.DataFrame]:
    """Columns of all files in one frame in recorded units, with `file_index` and `row`; times are UTC.

    Columns no file has are there too, and null. With `only`, no other columns of Parquet files are read.
    """
    opened = [_OpenFile([]) for _ in files]
    frames = []
    for i, file in enumerate(files):
        if file.is_recording:
            frame, n_rows, faults = readers()[file.folder].rows(file, "pack")
            opened[i] = _OpenFile(faults, n_rows)
            frames.append(frame.with_columns(pl.lit(i, pl.Int32).alias("file_index")))
            continue
        content, faults = file.read()
        if content is None:
            opened[i].faults.extend(faults)
        elif file.is_text:
            text = open_text(content, _header)
            opened[i] = _OpenFile(text.faults, text=text)
        else:
            frame, n_rows, faults = open_parquet(content, only)
            opened[i] = _OpenFile(faults, n_rows)
            frames.append(frame.with_columns(pl.lit(i, pl.Int32).alias("file_index")))
    frames.append(_texts(opened))
    timed = [_timed(frame, opened) for frame in frames if frame.height]
    if not timed:
        return opened, pl.DataFrame()
    raw = pl.concat(timed, how="diagonal")
    absent = [pl.lit(None, pl.String if c in WORDS else pl.Float64).alias(c) for c in _KNOWN if c not in raw.columns]
    return opened, raw.with_columns(absent)


def _texts(opened: Sequence[_OpenFile]) -> pl.DataFrame:
    texts = {i: o.text for i, o in enumerate(opened) if o.text is not None}
    frame, faults = to_columns(list(texts.values()), _NUMBERS)
    for (i, text), found in zip(texts.items(), faults, strict=True):
        opened[i].faults.extend(found)
        opened[i].n_rows = text.n_rows
    if frame.is_empty():
        return frame
    index = pl.Series("file_index", list(texts), dtype=pl.Int32).gather(frame[PLACE])
    return frame.with_columns(index).drop(PLACE)


def _timed(frame: pl.DataFrame, opened: Sequence[_OpenFile]) -> pl.DataFrame:
    if "report_time" not in frame.columns:
        return frame
    frame, naive = to_utc(frame, "report_time")
    for (i,), rows in naive.group_by("file_index"):
        opened[i].faults.extend(zone_note(rows, "report_time"))
    return frame


@lru_cache(maxsize=256)  # thousands of files share a few headers
def _header(found: tuple[str, ...]) -> Header:
    return judge_header(found, KEYS, _KNOWN, CORE_NAMES)


def _record(judged: ValidatedRows, opened: Sequence[_OpenFile]) -> None:
    """Add what the rows were found guilty of to their files; a rejected row's broken values are part of that row."""
    rejected: dict[int, set[int]] = {}
    found: dict[int, list[Fault]] = {}
    for i, fault in judged.faults:
        found.setdefault(i, []).append(fault)
        if fault.n_rows and fault.row is not None:
            rejected.setdefault(i, set()).add(fault.row)
    for i, o in enumerate(opened):
        gone = rejected.get(i, ())
        kept = [f for f in o.faults if f.reason != "not_a_number" or f.row not in gone]
        values = [f for f in (*kept, *found.get(i, ())) if REASONS[f.reason].scope == "value"]
        others = [f for f in (*kept, *found.get(i, ())) if REASONS[f.reason].scope != "value"]
        o.faults = [_with_content(f, o) for f in others] + shortened(values)


def _with_content(fault: Fault, opened: _OpenFile) -> Fault:
    """A rejected row of a text file with the row as it came."""
    if opened.text is None or not fault.n_rows or fault.row is None or fault.content is not None:
        return fault
    return replace(fault, content=opened.text.line(fault.row))


def _in_si(rows: pl.DataFrame, about: pl.DataFrame) -> pl.DataFrame:
    """Judged rows under their SI names, in the order of `ROW_COLUMNS`."""
    si = [(pl.col(c.name) * c.scale + c.offset).alias(c.si_name) for c in SIGNAL_COLUMNS]
    place = ["operator", "tail", "source", "file"]
    of_file = about.select(pl.col(place).gather(rows["file_index"]))
    return pl.concat(
        [
            rows.select(
                "flight_id", pl.col("pack").cast(pl.Int32), pl.col("report_time").alias("time_utc"), *WORDS, *si,
                pl.col("row").alias("row_in_file"),
            ),
            of_file,
        ],
        how="horizontal",
    ).select(ROW_COLUMNS)  # fmt: skip


def _no_rows() -> pl.DataFrame:
    types: dict[str, pl.DataType | type[pl.DataType]] = {
        "pack": pl.Int32,
        "time_utc": pl.Datetime("us", "UTC"),
        "row_in_file": pl.Int64,
        **dict.fromkeys(SI_NAMES, pl.Float64),
    }
    return pl.DataFrame(schema={c: types.get(c, pl.String) for c in ROW_COLUMNS})
