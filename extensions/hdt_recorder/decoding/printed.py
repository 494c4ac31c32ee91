"""Printed reports of an aircraft condition monitoring system (ACMS): from a recorder's message file to values.

A layout declares a report in a few lines of text, which look as its lines do: what is in braces is a value, the rest
stands there. A line that does not look as declared is set aside with its number and the reason; the others are read.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

Value = float | str | None
_TITLE = re.compile(r"\s*(?P<title>\S.*?) REPORT <(?P<number>\d\d)>\s+PAGE (?P<page>\d\d) OF \d\d\s*$")
_OTHER_TITLE = re.compile(r"\s*(?P<title>\S.*? REPORT\b.*?)\s*$")
_FIELD = re.compile(r"\{(?P<name>\w+)(?::(?P<width>\d*)(?P<kind>[st]?))?\}")
_MISSING = re.compile(r"[-X.:]+")
_LINE_ID = re.compile(r"[0-9A-Z]{2}\s")


class LayoutError(ValueError):
    """A declaration of a report that can't be read; names its line."""


@dataclass(frozen=True, slots=True)
class LineLayout:
    """How a kind of line looks: what it begins with, its words, and its fields with those that are numbers."""

    begins: re.Pattern[str]
    whole: re.Pattern[str]
    words: tuple[str, ...]
    fields: tuple[str, ...]
    numbers: frozenset[str]


@dataclass(frozen=True, slots=True)
class Layout:
    """A kind of report."""

    number: str
    title: str
    lines: tuple[LineLayout, ...]


@dataclass(frozen=True, slots=True)
class ReportLine:
    """Values of a report's line; `report` counts the file's reports from 1, `line` its lines."""

    report: int
    number: str
    line: int
    row: str
    values: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class RejectedLine:
    """A line that can't be read, and why."""

    line: int
    text: str
    reason: str


@dataclass(frozen=True, slots=True)
class Reports:
    """Lines of a file that could be read, those that could not, and titles of reports that no layout declares."""

    lines: tuple[ReportLine, ...]
    rejected: tuple[RejectedLine, ...]
    undeclared: tuple[str, ...]


def read_layouts(text: str) -> dict[str, Layout]:
    """Read layouts, by number of the report.

    `<nn> TITLE` begins one, `<**>` what all reports have after their own. A line such as `N1|N2 {egt:4} {oil}` declares
    lines that begin with `N1` or `N2`; a dot stands for any character. A field is a number, `{name}` or four characters
    wide `{name:4}`; `{name:4s}` is text, `{name:t}` the rest of the line. What is indented is indented in the report.

    Raises
    ------
    LayoutError
        Names the line.
    """
    parts: dict[str, tuple[str, list[LineLayout]]] = {"**": ("", [])}
    number = ""
    for place, line in enumerate(text.splitlines(), 1):
        if head := re.match(r"<(\d\d|\*\*)>\s*(.*)", line):
            number = head[1]
            parts.setdefault(number, (head[2], []))
        elif line.strip():
            if number not in parts:
                raise LayoutError(f"line {place}: a report begins with <nn> and its title")
            parts[number][1].append(_declare(line, place))
    _, common = parts.pop("**")
    return {n: Layout(n, title, (*own, *common)) for n, (title, own) in parts.items()}


def _declare(line: str, place: int) -> LineLayout:
    fields = [m["name"] for m in _FIELD.finditer(line)]
    if not fields or len(set(fields)) < len(fields) or "{" in _FIELD.sub("", line):
        raise LayoutError(f"line {place}: fields are {{name}}, each once in a line, and one at least: {line.strip()}")
    first, *rest = line.split()
    indent = r"\s+" if line[0].isspace() else ""
    literal = _FIELD.split(first)[0]
    row = "|".join(re.escape(part).replace(r"\.", ".") for part in literal.split("|"))
    tail = first[len(literal) :]
    words = [f"(?P<_row>{row}){_pattern(tail)}", *map(_pattern, rest)]
    numbers = frozenset(m["name"] for m in _FIELD.finditer(line) if not m["kind"])
    begins = re.compile(f"{indent}(?:{row})" + ("" if tail else r"(?:\s|$)"))
    whole = re.compile(indent + r"\s+".join(words) + r"\s*")
    return LineLayout(begins, whole, tuple(words), tuple(fields), numbers)


def _pattern(word: str) -> str:
    """Return the regular expression of a declaration's word."""
    expression = ""
    last = 0
    for m in _FIELD.finditer(word):
        expression += re.escape(word[last : m.start()])
        width = f"{{{m['width']}}}" if m["width"] else "+"
        expression += f"(?P<{m['name']}>" + (".*?" if m["kind"] == "t" else rf"\S{width}") + ")"
        last = m.end()
    return expression + re.escape(word[last:])


def read_reports(data: bytes, layouts: Mapping[str, Layout]) -> Reports:
    """Read reports of a message file, or of plain text. Raises nothing: what can't be read is set aside."""
    lines: list[ReportLine] = []
    rejected: list[RejectedLine] = []
    undeclared: list[str] = []
    layout = None
    report = 0
    for place, line in _numbered_lines(unblock(data), rejected):
        if title := _TITLE.fullmatch(line):
            layout = layouts.get(title["number"])
            report += title["page"] == "01"
            undeclared += [] if layout else [f"{title['title']} <{title['number']}>"]
        elif other := _OTHER_TITLE.fullmatch(line):
            layout = None
            undeclared.append(other["title"])
        elif layout is not None and line.strip():
            result = _read_line(line, layout)
            if isinstance(result, str):
                rejected.append(RejectedLine(place, line.strip(), result))
            elif result:
                row, values = result
                lines.append(ReportLine(report, layout.number, place, row, values))
    return Reports(tuple(lines), tuple(sorted(rejected, key=lambda r: r.line)), tuple(undeclared))


def _read_line(line: str, layout: Layout) -> tuple[str, dict[str, Value]] | str | None:
    """Return row and values; the reason for a rejected line; or None for a heading."""
    likely = [x for x in layout.lines if x.begins.match(line)]
    for each in likely:
        if match := each.whole.fullmatch(line):
            values = {f: _value(match[f], f in each.numbers) for f in each.fields}
            wrong = [f for f in each.numbers if isinstance(values[f], str)]
            return f"{min(wrong)} is {values[min(wrong)]!r}, no number" if wrong else (match["_row"], values)
    if likely:
        return _difference(line.split(), likely[0])
    return f"no line of <{layout.number}> begins with {line[:2]}" if _LINE_ID.match(line) else None


def _difference(words: list[str], layout: LineLayout) -> str:
    if len(words) != len(layout.words):
        return f"{len(words)} words, by its layout {len(layout.words)}: {' '.join(layout.fields)}"
    for word, pattern in zip(words, layout.words, strict=True):
        if not re.fullmatch(pattern, word):
            name = re.search(r"\(\?P<([^_]\w*)>", pattern)
            return f"{name[1] if name else 'it'} is {word!r}, not as wide as its layout has it"
    return "not as its layout has it"


def _value(text: str, is_number: bool) -> Value:
    if _MISSING.fullmatch(text):
        return None
    try:
        return float(text) if is_number and re.fullmatch(r"-?[\d.]+", text) else text
    except ValueError:
        return text


_BLOCK = 20
"""Bytes before a block's text: time, place, kind, length and zero, 4 each, the least significant byte first."""
_BEGIN, _ENDS = "\x02\x02", re.compile("\x17\x17|\x03\x03")
_END = re.compile(r"(?P<size>\d{5})(?P<number>\d{4})\d{7}")
_END_SIZE = 16


def unblock(data: bytes) -> str:
    """Return the text of a message file's blocks; the data as they are if it has none.

    A block's text has one byte more at either end, which mark whether the file begins, goes on or ends there.
    """
    texts = []
    at = 0
    while at + _BLOCK < len(data):
        size = int.from_bytes(data[at + 12 : at + 16], "little")
        if not 2 < size < 1 << 16 or data[at + 16 : at + 20] != bytes(4):
            break
        texts.append(data[at + _BLOCK + 1 : at + _BLOCK + size - 1])
        at += _BLOCK + size
    return (b"".join(texts) if texts else data).decode("latin-1")


def _numbered_lines(text: str, rejected: list[RejectedLine]) -> Iterator[tuple[int, str]]:
    """Yield numbered lines; messages that differ in length from their end mark are added to `rejected`."""
    place = 1
    for part in text.split(_BEGIN):
        body, *end = _ENDS.split(part, maxsplit=1)
        lines = body.split("\n")
        end_mark = _END.fullmatch(lines[-1]) if end else None
        size = len(body) - _END_SIZE
        if end_mark and int(end_mark["size"]) != size:
            reason = f"message {int(end_mark['number'])} has {size:,} characters, by its end {int(end_mark['size']):,}"
            rejected.append(RejectedLine(place, lines[0].strip(), reason))
        elif end and not end_mark:
            rejected.append(RejectedLine(place + len(lines) - 1, lines[-1].strip(), "no end of a message"))
        yield from enumerate(map(str.rstrip, lines[:-1] if end_mark else lines), place)
        place += part.count("\n")
