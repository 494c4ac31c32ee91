"""Parse text files: decode them, match their headers, split their lines into columns and parse the numbers."""

import csv
import io
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl

from pipelines.intake.columns import Contract, Header, match_header
from pipelines.intake.faults import MAX_ROWS_LISTED, Fault, first_and_rest

TEXT_INDEX = "_text"
"""Column with the index of a row's text; the contract has a column `text` of its own."""
MAX_HEADER_BYTES = 1 << 16
MAX_LINES = 1_000_000
"""A month of reports has thousands of lines; a larger file would take minutes."""
MAX_LINES_QUOTED = 50
"""Lines that one record may have by line breaks within quotes."""
_BOMS = (
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
_SEPARATORS = (b";", b"\t", b"|")
_BLANKS = b" \t\r\x0b\x0c"


@dataclass(slots=True)
class Text:
    """One open text file; without lines where the file as a whole is rejected."""

    header: Header = field(default_factory=Header)
    lines: dict[int, bytes] = field(default_factory=dict)
    """Lines that are not blank, by number; the header is line 1."""
    n_rows: int = 0
    """Delivered lines without blank ones and the header."""
    faults: list[Fault] = field(default_factory=list)

    def line(self, row: int) -> str:
        """Format a line, whatever its bytes, for a quarantine row."""
        return _printable(self.lines.get(row, b""))


def open_text(content: bytes, contract: Contract) -> Text:
    """Decode one file, match its header with the contract and list its lines."""
    text = Text()
    if (fault := _open_lines(_to_utf8(content, text), contract, text)) is not None:
        text.n_rows = fault.n_rows
        text.faults.append(fault)
    return text


def _open_lines(content: bytes, contract: Contract, text: Text) -> Fault | None:
    """Add header and lines to `text`, or return the fault for which the file as a whole is rejected."""
    first, _, body = content.partition(b"\n")
    if (fault := _header_fault(first, body)) is not None:
        return fault
    header = match_header(tuple(first.decode().split(",")), contract)
    if header.fault is not None:
        is_data = header.fault.reason == "no_header"  # then the first line is a row too
        return replace(header.fault, n_rows=_count_rows(body) + is_data)
    text.faults.extend(header.notes)
    if not body or body.isspace():
        return Fault("no_rows")
    if (n_lines := body.count(b"\n")) > MAX_LINES:
        return Fault("too_large", detail=f"It has {n_lines} lines.", n_rows=_count_rows(body))
    lines, n_cut = _complete_lines(body.split(b"\n"), text)
    records = _join_quoted(lines, len(header.names))
    text.header, text.lines = header, {row: line for row, line in records.items() if line and not line.isspace()}
    text.n_rows = len(text.lines) + n_cut
    return None


def _header_fault(first: bytes, body: bytes) -> Fault | None:
    """Return the fault of a first line that is none of names separated by commas."""
    if not first.strip() and not body.strip():
        return Fault("empty_file")
    if not _is_text(first[:MAX_HEADER_BYTES]):
        return Fault("not_text", detail=f"It starts with the bytes {first[:8].hex(' ')}.")
    if len(first) > MAX_HEADER_BYTES:
        return Fault("no_header", detail=f"The first line has {len(first)} bytes.")
    separator = next((s for s in _SEPARATORS if s in first and b"," not in first), None)
    if separator is None:
        return None
    return Fault("wrong_separator", detail=f"Found {separator.decode()!r}.", n_rows=_count_rows(body))


def _count_rows(body: bytes) -> int:
    """Count the lines that are not blank, without a copy of each."""
    visible = np.frombuffer(b"\n" + body.translate(None, _BLANKS), np.uint8) != ord("\n")
    return int(np.count_nonzero(visible[1:] & ~visible[:-1]))


def _to_utf8(content: bytes, text: Text) -> bytes:
    """Convert to UTF-8 with newlines alone and no byte order mark; undecodable bytes stay and are rejected later."""
    if content.startswith(b"\xef\xbb\xbf"):
        content = content[3:]
        text.faults.append(Fault("other_encoding", detail="Byte order mark."))
    for mark, encoding in _BOMS:
        if content.startswith(mark):
            try:
                content = content.decode(encoding).encode()
                text.faults.append(Fault("other_encoding", detail=encoding.upper()))
            except UnicodeError:
                pass
            break
    if b"\r" not in content:
        return content
    return content.replace(b"\r\n", b"\n") if b"\n" in content else content.replace(b"\r", b"\n")


def _is_text(line: bytes) -> bool:
    try:
        return line.decode().replace("\t", "").rstrip("\r").isprintable()
    except UnicodeDecodeError:
        return False


def _complete_lines(lines: list[bytes], text: Text) -> tuple[list[bytes], int]:
    """Remove and report a last line without newline that may have been cut short; the others, and how many it was."""
    *complete, last = lines
    if not last.strip() or _is_complete(complete, last):
        return lines, 0
    row = len(lines) + 1
    content = _printable(last)
    text.faults.append(Fault("cut_short", row, detail="The last line has no end.", n_rows=1, content=content))
    return complete, 1


def _join_quoted(lines: Sequence[bytes], n_names: int) -> dict[int, bytes]:
    """Return the records of a file by the number of their first line, the header being line 1.

    A record has several lines where a quoted field holds line breaks (RFC 4180, 2.6). A quote that is never closed, or
    not within `MAX_LINES_QUOTED`, spoils its own line alone.
    """
    records = dict[int, bytes]()
    first = 0
    while first < len(lines):
        n_lines = 1
        if b'"' in lines[first]:
            ends = range(first + 1, min(first + MAX_LINES_QUOTED, len(lines)) + 1)
            joined = (end - first for end in ends if _has_fields(b"\n".join(lines[first:end]), n_names))
            n_lines = next(joined, 1)
        records[first + 2] = b"\n".join(lines[first : first + n_lines])
        first += n_lines
    return records


def _has_fields(record: bytes, n_names: int) -> bool:
    """Return whether a record is CSV of as many fields as the header has."""
    try:
        (fields,) = csv.reader(io.StringIO(record.decode(), newline=""), strict=True)
    except (csv.Error, ValueError):
        return False
    return len(fields) == n_names


def _is_complete(lines: Sequence[bytes], last: bytes) -> bool:
    """Return whether a last line without newline is surely complete: its last number has the column's decimals.

    A number cut short shows only where the column has a fixed number of decimals; 14.7 may be complete or 14.75 cut.
    """
    fields = last.split(b",")
    others = [line.split(b",") for line in lines if line.strip()]
    if len(others) < 3 or any(len(o) != len(fields) for o in others):
        return False
    decimals = {_decimals(o[-1]) for o in others if o[-1]}
    return len(decimals) == 1 and decimals.pop() == _decimals(fields[-1]) > 0


def _decimals(number: bytes) -> int:
    return len(number.partition(b".")[2]) if re.fullmatch(rb"-?\d+\.\d+", number) else -1


def _printable(line: bytes) -> str:
    return line[:500].decode(errors="backslashreplace").replace("\x00", "\\x00")


def to_columns(texts: Sequence[Text], numbers: Collection[str]) -> pl.DataFrame:
    """Parse the known columns of all texts, with `_text` (index in `texts`) and `row` (line); faults go to the texts.

    Columns in `numbers` come as Float64, with NaN and infinity where the file says so; all others as String, null where
    empty.
    """
    by_header: dict[tuple[str | None, ...], list[int]] = {}
    for i, text in enumerate(texts):
        if text.lines:
            by_header.setdefault(text.header.names, []).append(i)
    frames = [_split_lines(names, members, texts, numbers) for names, members in by_header.items()]
    for k, frame in enumerate(frames):
        for name in (n for n in numbers if frame.schema.get(n) == pl.String):
            frames[k], bad = parse_numbers(frames[k], name)
            for i, fault in bad:
                texts[i].faults.append(fault)
    return pl.concat(frames, how="diagonal") if frames else pl.DataFrame()


def parse_numbers(frame: pl.DataFrame, name: str) -> tuple[pl.DataFrame, list[tuple[int, Fault]]]:
    """Parse a text column as numbers; for each text that is none its file (`_text`, 0 where absent) and fault."""
    text = frame[name].str.strip_chars(" \t")
    number = text.cast(pl.Float64, strict=False)
    if number.null_count() == text.null_count():
        return frame.with_columns(number), []
    file = pl.col(TEXT_INDEX) if TEXT_INDEX in frame.columns else pl.lit(0).alias(TEXT_INDEX)
    bad = frame.filter(number.is_null() & (text.str.len_bytes() > 0)).select(file, "row", name)
    bad, rest = first_and_rest(bad, [TEXT_INDEX], MAX_ROWS_LISTED)
    faults = [(i, Fault("not_a_number", row, name, f"Found {value[:40]!r}.")) for i, row, value in bad.iter_rows()]
    faults += [(i, Fault("not_a_number", None, name, f"And {n} more values.")) for i, n in rest.iter_rows()]
    return frame.with_columns(number), faults


def _split_lines(
    names: tuple[str | None, ...], members: Sequence[int], texts: Sequence[Text], numbers: Collection[str]
) -> pl.DataFrame:
    """Split the lines of texts with one header into columns; a line that does not fit goes to its text's faults."""
    indices = list[int]()
    rows = list[int]()
    csv_lines = list[bytes]()
    for i in members:
        faults = []
        for row, line in texts[i].lines.items():
            result = _as_csv(line, len(names))
            if isinstance(result, bytes):
                indices.append(i)
                rows.append(row)
                csv_lines.append(result)
            else:
                faults.append(replace(result, row=row, n_rows=1, content=_printable(line)))
        texts[i].faults += _limit_rows(faults)
    place = pl.DataFrame({TEXT_INDEX: indices, "row": rows}, schema={TEXT_INDEX: pl.Int32, "row": pl.Int64})
    columns = [name or f"_unknown_{k}" for k, name in enumerate(names)]
    content = b"\n".join(csv_lines)
    try:
        frame = _read_csv(content, {c: pl.Float64() if c in numbers else pl.String() for c in columns})
    except pl.exceptions.PolarsError:  # not every number is one
        frame = _read_csv(content, dict.fromkeys(columns, pl.String()))
    return frame.select(name for name in names if name).hstack(place)


def _read_csv(content: bytes, schema: Mapping[str, pl.DataType]) -> pl.DataFrame:
    return pl.read_csv(io.BytesIO(content), has_header=False, schema=schema, raise_if_empty=False)


def _as_csv(line: bytes, n_names: int) -> bytes | Fault:
    """Check the bytes, quotes and number of fields of a line; return it with quotes only where CSV needs them."""
    if b"\x00" in line or not (line.isascii() or _is_utf8(line)):
        return Fault("bad_bytes")
    n_fields = line.count(b",") + 1
    if b'"' in line:
        try:
            fields = next(csv.reader(io.StringIO(line.decode(), newline=""), strict=True))
        except (csv.Error, StopIteration):
            return Fault("bad_quoting")
        out = io.StringIO()
        csv.writer(out, lineterminator="\n").writerow(fields)
        line = out.getvalue().removesuffix("\n").encode()
        n_fields = len(fields)
    return (
        line if n_fields == n_names else Fault("wrong_field_count", detail=f"It has {n_fields}, the header {n_names}.")
    )


def _is_utf8(line: bytes) -> bool:
    try:
        line.decode()
    except UnicodeDecodeError:
        return False
    return True


def _limit_rows(faults: list[Fault]) -> list[Fault]:
    """Limit faults of rows: the first singly, the others in one count for each reason."""
    more = Counter(f.reason for f in faults[MAX_ROWS_LISTED:])
    counts = [Fault(reason, detail=f"And {n} more rows.", n_rows=n) for reason, n in more.items()]
    return faults[:MAX_ROWS_LISTED] + counts
