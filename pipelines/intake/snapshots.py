"""Read recorder files into validated rows in SI: snapshot reports, history files and continuous logs."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import polars as pl

from hdt_core.tables.raw import RawSnapshots
from pipelines.intake.columns import PACK_FILES, SIGNAL_COLUMNS, WORDS
from pipelines.intake.faults import NO_FAULTS, Fault
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.names import flight_day, flight_tail
from pipelines.intake.opening import add_faults, open_files
from pipelines.intake.row_validation import validate_rows
from pipelines.storage.panics import first_line, panics_as_errors

NO_ROWS = pl.DataFrame(schema=RawSnapshots.types() | {"row_in_file": pl.Int64})
ROW_COLUMNS = NO_ROWS.columns


@dataclass(frozen=True, slots=True)
class Intake:
    """Result of some files: rows in SI, quarantine rows, and the number of rows each file delivered."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    delivered: pl.DataFrame
    """`file, n_delivered`"""


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
            faults = file.quarantine([Fault("cannot_process", detail=first_line(error))])
            return Intake(NO_ROWS, faults, _delivered_frame([file.path], [0]))
    half = len(files) // 2
    parts = [read_snapshots(part, now) for part in (files[:half], files[half:])]
    return Intake(*(pl.concat([getattr(p, f) for p in parts]) for f in ("rows", "quarantine", "delivered")))


def _read_together(files: Sequence[LandingFile], now: datetime) -> Intake:
    opened_files, raw = open_files(files, PACK_FILES)
    rows = NO_ROWS
    if raw.height:
        types = dict.fromkeys(PACK_FILES.words, pl.String) | dict.fromkeys(PACK_FILES.numbers, pl.Float64)
        raw = raw.with_columns(pl.lit(None, t).alias(c) for c, t in types.items() if c not in raw.columns)
        result = validate_rows(raw, files, now)
        rows = _to_si(result.rows, files)
        add_faults(opened_files, result.faults)
    frames = [f.quarantine(o.faults) for f, o in zip(files, opened_files, strict=True) if o.faults]
    return Intake(
        rows,
        pl.concat([NO_FAULTS, *frames]),
        _delivered_frame([f.path for f in files], [o.n_rows for o in opened_files]),
    )


def _delivered_frame(paths: list[str], n_rows: list[int]) -> pl.DataFrame:
    return pl.DataFrame({"file": paths, "n_delivered": n_rows}, schema={"file": pl.String, "n_delivered": pl.Int64})


def flights_in(file: LandingFile) -> list[str]:
    """List the flights of a file, sorted: from its name, or else from its flight_id column.

    Only well-formed ids of the file's own tail; none where it cannot be read, which `read_snapshots` reports.
    """
    if file.flight is not None or file.is_recording:
        return [file.flight] if file.flight else []
    try:
        with panics_as_errors():
            _, raw = open_files([file], PACK_FILES, only=("flight_id",))
    except Exception:
        return []
    flights = raw.get_column("flight_id").drop_nulls().unique().to_list() if raw.height else []
    return sorted(f for f in flights if flight_day(f) is not None and flight_tail(f) == file.tail)


def _to_si(rows: pl.DataFrame, files: Sequence[LandingFile]) -> pl.DataFrame:
    """Convert validated rows to SI, in the order of `ROW_COLUMNS`."""
    si = [(pl.col(c.name) * c.scale + c.offset).alias(c.si_name) for c in SIGNAL_COLUMNS]
    names = dict.fromkeys(("operator", "tail", "source", "file"), pl.String)
    of_files = pl.DataFrame([(f.operator, f.tail, f.source, f.path) for f in files], schema=names, orient="row")
    pack = pl.col("pack").cast(pl.Int32)
    values = rows.select("flight_id", pack, *WORDS, *si, time_utc="report_time", row_in_file="row")
    return values.hstack(of_files[rows["file_index"]]).select(ROW_COLUMNS)
