"""Text files become columns: the bulk through Polars, and line by line only where something is off.

Sound files of one header are parsed as one text. Polars refuses a row with too many fields, so a row with too few can't
hide behind it.
"""

import csv
import io
from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np
import polars as pl

from pipelines.intake.ledger import MAX_ROWS_LISTED, Fault, first_and_rest
from pipelines.intake.text import Text, count_rows, shown

PLACE = "_text"
"""Column that says which text a row is of; the contract has a column `text` of its own."""


def to_columns(texts: Sequence[Text], numbers: Collection[str]) -> tuple[pl.DataFrame, list[list[Fault]]]:
    """Rows of all files with the known columns, `_text` (position in `texts`), `row` (line), and each file's faults.

    Columns in `numbers` come as Float64, with NaN and infinity where the file says so; all others as String.
    """
    faults: list[list[Fault]] = [[] for _ in texts]
    batches: dict[tuple[str | None, ...], list[int]] = {}
    frames = []
    for i, text in enumerate(texts):
        if text.refused or not text.body:
            continue
        if text.is_sound:
            batches.setdefault(text.header.names, []).append(i)
        else:
            frames.append(_line_by_line(i, text, faults[i]))
    for names, members in batches.items():
        frames.extend(_bulk(names, members, texts, set(numbers), faults))
    typed = [_to_numbers(frame, numbers, faults) for frame in frames]
    return pl.concat(typed, how="diagonal") if typed else pl.DataFrame(), faults


def _to_numbers(frame: pl.DataFrame, numbers: Collection[str], faults: list[list[Fault]]) -> pl.DataFrame:
    for name in numbers:
        if frame.schema.get(name) == pl.String:
            frame, bad = number_faults(frame, name)
            for i, fault in bad:
                faults[i].append(fault)
    return frame


def number_faults(frame: pl.DataFrame, name: str) -> tuple[pl.DataFrame, list[tuple[int, Fault]]]:
    """A text column as numbers, and for each text that is none its file (`_text`, 0 where absent) and fault."""
    found = pl.col(name).str.strip_chars(" \t")
    number = found.cast(pl.Float64, strict=False)
    file = pl.col(PLACE) if PLACE in frame.columns else pl.lit(0).alias(PLACE)
    bad = frame.filter(number.is_null() & (found.str.len_bytes() > 0)).select(file, "row", name)
    bad, rest = first_and_rest(bad, [PLACE], MAX_ROWS_LISTED)
    faults = [(i, Fault("not_a_number", row, name, f"Found {value[:40]!r}.")) for i, row, value in bad.iter_rows()]
    faults += [(i, Fault("not_a_number", None, name, f"And {n} more values.")) for i, n in rest.iter_rows()]
    return frame.with_columns(number.alias(name)), faults


def _bulk(
    names: tuple[str | None, ...],
    members: list[int],
    texts: Sequence[Text],
    numbers: set[str],
    faults: list[list[Fault]],
) -> list[pl.DataFrame]:
    """Parse sound files of one header together; typed if all numbers are numbers, else as text, else one by one."""
    columns = [n or f"_stranger_{i}" for i, n in enumerate(names)]
    body = texts[members[0]].body if len(members) == 1 else b"".join(texts[i].body for i in members)
    for typed in (numbers, set[str]()):
        schema = {c: pl.Float64 if c in typed else pl.String for c in columns}
        try:
            frame = pl.read_csv(io.BytesIO(body), has_header=False, schema=schema)
        except pl.exceptions.PolarsError:
            continue
        counts = [texts[i].n_lines for i in members]
        if frame.height == sum(counts):
            return [_placed(frame.select(n for n in names if n), members, counts)]
    if len(members) == 1:
        return [_line_by_line(members[0], texts[members[0]], faults[members[0]])]
    half = len(members) // 2
    return [f for part in (members[:half], members[half:]) for f in _bulk(names, part, texts, numbers, faults)]


def _placed(frame: pl.DataFrame, members: Sequence[int], counts: Sequence[int]) -> pl.DataFrame:
    """`frame` with the file and line each row came from."""
    text = np.repeat(np.asarray(members, dtype=np.int32), counts)
    starts = np.repeat(np.cumsum([0, *counts[:-1]]), counts)
    row = np.arange(frame.height, dtype=np.int64) - starts + 2
    return frame.with_columns(pl.Series(PLACE, text), pl.Series("row", row))


def _line_by_line(i: int, text: Text, faults: list[Fault]) -> pl.DataFrame:
    """Take each line by itself: the careful way, for files where something is off."""
    names = text.header.names
    kept: list[list[str]] = []
    rows: list[int] = []
    more: Counter[str] = Counter()
    n_cut = text.n_rows - (text.n_lines if text.is_sound else count_rows(text.body))
    text.n_rows = count_rows(text.body) + n_cut  # sums may hide a blank line behind a row too long
    for row, line in enumerate(text.body.split(b"\n"), start=2):
        if not line.strip():
            continue
        fields = _fields(line, len(names))
        if isinstance(fields, list):
            kept.append(fields)
            rows.append(row)
        elif len(faults) < MAX_ROWS_LISTED:
            faults.append(Fault(fields[0], row, detail=fields[1], n_rows=1, content=shown(line)))
        else:
            more[fields[0]] += 1
    faults.extend(Fault(reason, detail=f"And {n} more rows.", n_rows=n) for reason, n in more.items())
    columns = {n: pl.Series([f[k] for f in kept], dtype=pl.String) for k, n in enumerate(names) if n}
    place = {PLACE: pl.Series([i] * len(rows), dtype=pl.Int32), "row": pl.Series(rows, dtype=pl.Int64)}
    return pl.DataFrame({**columns, **place})


def _fields(line: bytes, n_names: int) -> list[str] | tuple[str, str]:
    """Fields of a line, or the reason code why it has none and a detail."""
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
