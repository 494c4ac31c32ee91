"""Parse text files into columns: regular files together with Polars, the others line by line.

Regular files of one header are parsed as one text. Polars rejects a row with too many fields, so a row with too few
can't go unnoticed.
"""

import csv
import io
from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np
import polars as pl

from pipelines.intake.faults import MAX_ROWS_LISTED, Fault, first_and_rest
from pipelines.intake.text import Text, count_rows, printable_line

TEXT_INDEX = "_text"
"""Column with the index of a row's text; the contract has a column `text` of its own."""


def to_columns(texts: Sequence[Text], numbers: Collection[str]) -> tuple[pl.DataFrame, list[list[Fault]]]:
    """Parse the known columns of all files, with `_text` (index in `texts`) and `row` (line); and each file's faults.

    Columns in `numbers` come as Float64, with NaN and infinity where the file says so; all others as String.
    """
    faults: list[list[Fault]] = [[] for _ in texts]
    batches: dict[tuple[str | None, ...], list[int]] = {}
    frames = []
    for i, text in enumerate(texts):
        if text.is_rejected or not text.body:
            continue
        if text.is_regular:
            batches.setdefault(text.header.names, []).append(i)
        else:
            frames.append(_parse_lines(i, text, faults[i]))
    for names, members in batches.items():
        frames.extend(_parse_together(names, members, texts, set(numbers), faults))
    with_numbers = [_to_numbers(frame, numbers, faults) for frame in frames]
    return pl.concat(with_numbers, how="diagonal") if with_numbers else pl.DataFrame(), faults


def _to_numbers(frame: pl.DataFrame, numbers: Collection[str], faults: list[list[Fault]]) -> pl.DataFrame:
    for name in numbers:
        if frame.schema.get(name) == pl.String:
            frame, bad = parse_numbers(frame, name)
            for i, fault in bad:
                faults[i].append(fault)
    return frame


def parse_numbers(frame: pl.DataFrame, name: str) -> tuple[pl.DataFrame, list[tuple[int, Fault]]]:
    """Parse a text column as numbers; for each text that is none its file (`_text`, 0 where absent) and fault."""
    text = pl.col(name).str.strip_chars(" \t")
    number = text.cast(pl.Float64, strict=False)
    file = pl.col(TEXT_INDEX) if TEXT_INDEX in frame.columns else pl.lit(0).alias(TEXT_INDEX)
    bad = frame.filter(number.is_null() & (text.str.len_bytes() > 0)).select(file, "row", name)
    bad, rest = first_and_rest(bad, [TEXT_INDEX], MAX_ROWS_LISTED)
    faults = [(i, Fault("not_a_number", row, name, f"Found {value[:40]!r}.")) for i, row, value in bad.iter_rows()]
    faults += [(i, Fault("not_a_number", None, name, f"And {n} more values.")) for i, n in rest.iter_rows()]
    return frame.with_columns(number.alias(name)), faults


def _parse_together(
    names: tuple[str | None, ...],
    members: list[int],
    texts: Sequence[Text],
    numbers: set[str],
    faults: list[list[Fault]],
) -> list[pl.DataFrame]:
    """Parse regular files of one header together: typed if all numbers are numbers, else as text, else singly."""
    columns = [n or f"_unknown_{i}" for i, n in enumerate(names)]
    body = texts[members[0]].body if len(members) == 1 else b"".join(texts[i].body for i in members)
    for number_columns in (numbers, set[str]()):
        schema = {c: pl.Float64 if c in number_columns else pl.String for c in columns}
        try:
            frame = pl.read_csv(io.BytesIO(body), has_header=False, schema=schema)
        except pl.exceptions.PolarsError:
            continue
        n_lines = [texts[i].n_lines for i in members]
        if frame.height == sum(n_lines):
            return [_with_lines(frame.select(n for n in names if n), members, n_lines)]
    if len(members) == 1:
        return [_parse_lines(members[0], texts[members[0]], faults[members[0]])]
    half = len(members) // 2
    return [
        f for part in (members[:half], members[half:]) for f in _parse_together(names, part, texts, numbers, faults)
    ]


def _with_lines(frame: pl.DataFrame, members: Sequence[int], n_lines: Sequence[int]) -> pl.DataFrame:
    """Add the file and line of each row."""
    text = np.repeat(np.asarray(members, dtype=np.int32), n_lines)
    starts = np.repeat(np.cumsum([0, *n_lines[:-1]]), n_lines)
    row = np.arange(frame.height, dtype=np.int64) - starts + 2
    return frame.with_columns(pl.Series(TEXT_INDEX, text), pl.Series("row", row))


def _parse_lines(i: int, text: Text, faults: list[Fault]) -> pl.DataFrame:
    """Parse each line by itself, for files that are not regular."""
    names = text.header.names
    fields_of_rows: list[list[str]] = []
    rows: list[int] = []
    more: Counter[str] = Counter()
    n_cut = text.n_rows - (text.n_lines if text.is_regular else count_rows(text.body))
    text.n_rows = count_rows(text.body) + n_cut  # sums may hide a blank line behind a row too long
    for row, line in enumerate(text.body.split(b"\n"), start=2):
        if not line.strip():
            continue
        fields = _fields(line, len(names))
        if isinstance(fields, list):
            fields_of_rows.append(fields)
            rows.append(row)
        elif len(faults) < MAX_ROWS_LISTED:
            faults.append(Fault(fields[0], row, detail=fields[1], n_rows=1, content=printable_line(line)))
        else:
            more[fields[0]] += 1
    faults.extend(Fault(reason, detail=f"And {n} more rows.", n_rows=n) for reason, n in more.items())
    columns = {n: pl.Series([f[k] for f in fields_of_rows], dtype=pl.String) for k, n in enumerate(names) if n}
    place = {TEXT_INDEX: pl.Series([i] * len(rows), dtype=pl.Int32), "row": pl.Series(rows, dtype=pl.Int64)}
    return pl.DataFrame({**columns, **place})


def _fields(line: bytes, n_names: int) -> list[str] | tuple[str, str]:
    """Split a line into fields; the reason code and a detail where that fails."""
    try:
        text = line.decode()
    except UnicodeDecodeError:
        return "bad_bytes", ""
    if "\x00" in text:
        return "bad_bytes", ""
    fields = text.rstrip("\r").split(",")
    if '"' in text:
        try:
            fields = next(csv.reader([text], strict=True))
        except (csv.Error, StopIteration):
            return "bad_quoting", ""
    if len(fields) != n_names:
        return "wrong_field_count", f"It has {len(fields)}, the header {n_names}."
    return fields
