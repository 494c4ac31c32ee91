"""Read recorder files into validated rows in SI: snapshot reports, history files and continuous logs."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import polars as pl

from hdt_core.tables.raw import RawSnapshots
from pipelines.intake.columns import PACK_FILES, SIGNAL_COLUMNS, WORDS, Contract
from pipelines.intake.faults import NO_FAULTS, REASONS, Fault, first_line, limit_values, panics_as_errors
from pipelines.intake.landing_file import UNREAD, LandingFile, flight_day, flight_tail, to_utc, zone_note
from pipelines.intake.parquet import open_parquet
from pipelines.intake.readers import readers
from pipelines.intake.row_validation import validate_rows
from pipelines.intake.text import TEXT_INDEX, Text, open_text, to_columns

NO_ROWS = pl.DataFrame(schema=RawSnapshots.types() | {"row_in_file": pl.Int64})
ROW_COLUMNS = NO_ROWS.columns


@dataclass(frozen=True, slots=True)
class Intake:
    """Result of some files: rows in SI, quarantine rows, and the number of rows each file delivered."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    delivered: pl.DataFrame
    """`file, n_delivered`"""


def read_snapshots(files: Sequence[LandingFile]) -> Intake:
    """Read `acms`, `history` and `cpl` files into rows in SI, and a quarantine row for each fault.

    Many files at once cost far less each than one at a time; the result is the same.

    Parameters
    ----------
    files : sequence of LandingFile

    Returns
    -------
    Intake
        For each file `n_delivered` = rows in `rows` + `n_rows` in `quarantine`. Never raises for the content of a file.
    """
    try:
        with panics_as_errors():
            return _read_together(files)
    except Exception as error:
        if len(files) == 1:  # it costs no other file
            file = files[0]
            faults = file.quarantine([Fault("cannot_process", detail=first_line(error)), *file.find_change()])
            return Intake(NO_ROWS, faults, _delivered_frame([file.path], [0]))
    half = len(files) // 2
    parts = [read_snapshots(part) for part in (files[:half], files[half:])]
    return Intake(*(pl.concat([getattr(p, f) for p in parts]) for f in ("rows", "quarantine", "delivered")))


def _read_together(files: Sequence[LandingFile]) -> Intake:
    opened_files, raw = open_files(files, PACK_FILES)
    rows = NO_ROWS
    if raw.height:
        types = dict.fromkeys(PACK_FILES.words, pl.String) | dict.fromkeys(PACK_FILES.numbers, pl.Float64)
        raw = raw.with_columns(pl.lit(None, t).alias(c) for c, t in types.items() if c not in raw.columns)
        result = validate_rows(raw, files)
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


def flights_in(file: LandingFile) -> list[str] | None:
    """List the flights of a file, sorted: from its name, or else from its flight_id column.

    Only well-formed ids of the file's own tail; none where its content cannot be read, which `read_snapshots` reports.
    None where it can't be opened or its content is no longer what its hash says.
    """
    if file.flight is not None or file.is_recording:
        return [file.flight] if file.flight else []
    try:
        with panics_as_errors():
            (open_file,), raw = open_files([file], PACK_FILES, only=("flight_id",))
    except Exception:
        return []
    if any(fault.reason in UNREAD for fault in open_file.faults):
        return None
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


@dataclass(slots=True)
class OpenFile:
    """Faults and number of delivered rows of a file whose columns are in the common frame."""

    faults: list[Fault]
    n_rows: int = 0
    text: Text | None = None


def open_files(
    files: Sequence[LandingFile], contract: Contract, table: str = "pack", only: Collection[str] | None = None
) -> tuple[list[OpenFile], pl.DataFrame]:
    """Open all files into one frame in recorded units, with `file_index` and `row`; times are UTC.

    `table` is what is read of a recording: `pack`, or a component's code. With `only`, no other columns of Parquet
    files are read.
    """
    open_files = []
    frames = []
    for i, file in enumerate(files):
        open_file, frame = _open(file, contract, table, only)
        open_files.append(open_file)
        frames.append(frame.with_columns(pl.lit(i, pl.Int32).alias("file_index")))
    frames.append(_columns_of_texts(open_files, contract))
    with_times = [_times_to_utc(frame, open_files) for frame in frames if frame.height]
    return open_files, pl.concat(with_times, how="diagonal") if with_times else pl.DataFrame()


def _open(
    file: LandingFile, contract: Contract, table: str, only: Collection[str] | None
) -> tuple[OpenFile, pl.DataFrame]:
    """Open one file; its columns, but those of a text, which is parsed with the others."""
    if file.is_recording:
        frame, n_rows, faults = readers()[file.folder].rows(file, table)
        return OpenFile([*faults, *file.find_change()], n_rows), frame
    content, faults = file.read_content()
    if content is None:
        return OpenFile(faults), pl.DataFrame()
    if file.is_text:
        text = open_text(content, contract)
        text.faults[:0] = faults  # the list itself, to which the parsing of its lines adds
        return OpenFile(text.faults, text.n_rows, text), pl.DataFrame()
    frame, n_rows, parquet_faults = open_parquet(content, contract, only)
    return OpenFile([*faults, *parquet_faults], n_rows), frame


def _columns_of_texts(open_files: Sequence[OpenFile], contract: Contract) -> pl.DataFrame:
    texts = {i: o.text for i, o in enumerate(open_files) if o.text is not None}
    frame = to_columns(list(texts.values()), contract.numbers)
    if frame.is_empty():
        return frame
    index = pl.Series("file_index", list(texts), dtype=pl.Int32).gather(frame[TEXT_INDEX])
    return frame.with_columns(index).drop(TEXT_INDEX)


def _times_to_utc(frame: pl.DataFrame, open_files: Sequence[OpenFile]) -> pl.DataFrame:
    if "report_time" not in frame.columns:
        return frame
    frame, naive = to_utc(frame, "report_time")
    for (i,), rows in naive.group_by("file_index"):
        open_files[i].faults.extend(zone_note(rows, "report_time"))
    return frame


def add_faults(open_files: Sequence[OpenFile], faults: Iterable[tuple[int, Fault]]) -> None:
    """Add faults of rows and values to their files; a rejected row's invalid values are part of that row."""
    faults_of_rows: dict[int, list[Fault]] = {}
    for i, fault in faults:
        faults_of_rows.setdefault(i, []).append(fault)
    for i, o in enumerate(open_files):
        own = faults_of_rows.get(i, [])
        rejected_rows = {f.row for f in own if f.n_rows} - {None}
        own = [f for f in o.faults if f.reason != "not_a_number" or f.row not in rejected_rows] + own
        values = [f for f in own if REASONS[f.reason].scope == "value"]
        others = [f for f in own if REASONS[f.reason].scope != "value"]
        o.faults = [_with_content(f, o.text) for f in others] + limit_values(values)


def _with_content(fault: Fault, text: Text | None) -> Fault:
    """Add the delivered line to the fault of a rejected row of a text file."""
    if text is None or not fault.n_rows or fault.row is None or fault.content is not None:
        return fault
    return replace(fault, content=text.line(fault.row))
