"""Open recorder files into one frame of columns in recorded units, and complete their faults."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import polars as pl

from pipelines.intake.columns import Contract
from pipelines.intake.faults import REASONS, Fault, limit_values
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.parquet import open_parquet
from pipelines.intake.readers import readers
from pipelines.intake.text import TEXT_INDEX, Text, open_text, to_columns
from pipelines.intake.times import to_utc, zone_note


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
    open_files, frames = [], []
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
        return OpenFile(faults, n_rows), frame
    content, faults = file.read_content()
    if content is None:
        return OpenFile(faults), pl.DataFrame()
    if file.is_text:
        text = open_text(content, contract)
        return OpenFile(text.faults, text.n_rows, text), pl.DataFrame()
    frame, n_rows, faults = open_parquet(content, contract, only)
    return OpenFile(faults, n_rows), frame


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
