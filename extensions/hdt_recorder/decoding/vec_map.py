"""Parameter maps as a ground station exports them: a `.vec` archive's `.par`, and `.fra` (ARINC 717) or `.frd` (767).

Tables of tab-separated lines, UTF-16; the digits before `|` name the kind of line. A parameter is defined by its place
in an ARINC 429 word of 32 bits (bits from 1), and the frame lists which bits of that word are recorded where.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from hdt_recorder.decoding.coding import Coding, Kind, LookupTable, Polynomial, Segments, Step
from hdt_recorder.decoding.layout import (
    WHOLE,
    Counter,
    Frame767,
    Map717,
    Map767,
    MapError,
    Parameter,
    ParameterMap,
    Piece,
    Sample,
    lay_out,
)

T = TypeVar("T")
Line = tuple[int, str, list[str]]
"""Number of the line, its kind, its fields."""


def read_lines(name: str, data: bytes) -> Iterator[Line]:
    """Number, kind and fields of each line that has a kind; comments and the rest of a long text have none."""
    coding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = data.decode(coding)
    except UnicodeError:
        raise MapError(f"{name}: no text of a ground station's export") from None
    for number, line in enumerate(text.splitlines(), 1):
        if match := re.match(r"(\d+)\|(.*)", line):
            yield number, match[1], match[2].split("\t")


def read_row(name: str, row: tuple[int, list[str]], read: Callable[[list[str]], T]) -> T:
    """What `read` makes of a line's number and fields; a `MapError` that names file and line if it can't."""
    try:
        return read(row[1])
    except (ValueError, IndexError) as error:
        raise MapError(f"{name}: line {row[0]}: {error}") from None


KINDS: dict[str, Kind] = {
    "BCD": "bcd", "DISCRETE": "discrete", "PACKED BITS": "discrete", "CHARACTER": "characters", "UTC": "utc",
    "COMPUTED ON BOARD": "float",
}  # fmt: skip
NOT_RECORDED = ("CONSTANT", "COMPUTED ON GROUND")


def read_vec(files: Mapping[str, bytes]) -> ParameterMap:
    """Read a map from the members of a `.vec` archive, by name.

    Raises
    ------
    MapError
        Names the file and line that can't be read.
    """
    tables = {name.rsplit(".", 1)[-1].lower(): (name, data) for name, data in files.items()}
    if "par" not in tables:
        raise MapError(f"no .par among {', '.join(sorted(files)) or 'no files'}")
    meanings = dict(_define(*tables["par"]))
    if "fra" in tables:
        return read_fra(*tables["fra"], meanings)
    if "frd" in tables:
        return read_frd(*tables["frd"], meanings)
    raise MapError(f"neither .fra nor .frd among {', '.join(sorted(files))}")


def _define(name: str, data: bytes) -> Iterator[tuple[str, Parameter]]:
    """Yield the coding of each parameter of a `.par`; its place is in the frame's file."""
    block: list[Line] = []
    for line in [*read_lines(name, data), (0, "1", [])]:
        if line[1] == "1" and block:
            try:
                parameter = _meaning(block)
            except (ValueError, IndexError) as error:
                raise MapError(f"{name}: line {block[0][0]}: {block[0][2][0]}: {error}") from None
            if parameter is not None:
                yield parameter.name, parameter
        block = [line] if line[1] == "1" else [*block, line]


def _meaning(block: list[Line]) -> Parameter | None:
    head = block[0][2]
    if head[2] in NOT_RECORDED:
        return None
    rows = {kind: [f for _, k, f in block if k == kind] for kind in "23456"}
    kind: Kind = "binary" if head[2].startswith("BNR") else KINDS.get(head[2], "binary")
    msb = int(head[7])
    bits = int(head[8])
    digits = tuple((int(f[1]) - int(f[2]), int(f[2])) for f in rows["5"] if len(f) > 2)
    decimals = re.match(r"\d*\.(\d+)$", head[20])
    coding = Coding(
        kind, low=msb - bits, bits=bits, sign=int(head[6]) - 1 if int(head[6] or 0) else None,
        steps=tuple(_steps(head[12], rows)) if kind == "binary" else (), digits=digits or ((msb - bits, bits),),
        decimals=int(decimals[1]) if decimals and kind == "bcd" else 0,
        base=float(head[11] or 0) if kind == "bcd" else 0.0,
        texts={int(f[0]): f[1] for f in rows["6"] if len(f) > 1 and f[1]},
    )  # fmt: skip
    has_rule = head[2] in KINDS or head[2].startswith("BNR")
    return Parameter(
        head[0], coding, (), 0.0, unit=head[21], description=" ".join(head[1].replace("\\r\\n", " ").split()),
        lowest=float(head[15]) if head[15] else None, highest=float(head[16]) if head[16] else None,
        unreadable="" if has_rule else f"the kind {head[2]!r} is not known",
    )  # fmt: skip


def _steps(computation: str, rows: dict[str, list[list[str]]]) -> Iterator[Step]:
    """Yield steps from `Resol=A`; or segments (line 2), points (3) or a polynomial (4)."""
    if computation.startswith("Resol="):
        yield Polynomial((0.0, float(computation[6:])))
    numbers = {kind: sorted(tuple(float(x) for x in f if x) for f in rows[kind]) for kind in "234"}
    if numbers["2"]:
        starts, scales, offsets = zip(*(f[-3:] for f in numbers["2"]), strict=True)
        yield Segments(starts, scales, offsets)
    if numbers["3"]:
        x, y = zip(*(f[-2:] for f in numbers["3"]), strict=True)
        yield LookupTable(x, y)
    if numbers["4"]:
        powers = {int(power): a for a, power in numbers["4"]}
        yield Polynomial(tuple(powers.get(i, 0.0) for i in range(max(powers) + 1)))


SUPERFRAME = ".superframe"
"""Ends the name of what a parameter, listed for every frame, holds in a superframe too."""


def read_fra(name: str, data: bytes, meanings: Mapping[str, Parameter]) -> Map717:
    """Read a `.fra`: kind 1 is the frame, 2 a parameter of every frame, 3 a superframe's word, 4 a parameter in it."""
    rows: dict[str, list[tuple[int, list[str]]]] = {kind: [] for kind in "1234"}
    for number, kind, fields in read_lines(name, data):
        if kind in rows:
            rows[kind].append((number, fields))
    if not rows["1"]:
        raise MapError(f"{name}: no line of kind 1, the frame's length and sync words")
    frame = read_row(name, rows["1"][0], _Frame)
    supers = {fields[0]: fields for _, fields in rows["3"]}
    lines: dict[str, list[_ParameterLine]] = {}
    for row in rows["2"]:
        lines.setdefault(row[1][0], []).append(read_row(name, row, frame.regular))
    for row in rows["4"]:
        lines.setdefault(row[1][0], []).append(read_row(name, row, lambda f: frame.superframe(f, supers)))
    parameters: dict[str, Parameter] = {}
    for each in lines.keys() & meanings.keys():
        for parameter in _place(meanings[each], lines[each], 4.0):
            parameters[parameter.name] = parameter
    return Map717(frame.words, dict(sorted(parameters.items())), frame.counter, frame.sync_words)


@dataclass(frozen=True, slots=True)
class _ParameterLine:
    """One line of a parameter: part of the word (a part 1 begins a sample), where, and frames of its cycle."""

    part: int
    pieces: tuple[Piece, ...]
    cycle: int


class _Frame:
    """The frame's head: `S words/s length syncs(4) subframe word bit bits first` of the counter."""

    def __init__(self, head: list[str]) -> None:
        self.words = int(head[1])
        self.sync_words = tuple(int(h, 16) for h in head[3:7])
        self.counter = None
        if head[7]:
            subframe, word, top, bits = (int(h) for h in head[7:11])
            self.counter = Counter(self._piece(subframe, word, top, bits), int(head[11] or 0))

    def _piece(self, subframe: int, word: int, top: int, bits: int, into: int = 0, frame: int = 0) -> Piece:
        if not (1 <= word <= self.words and bits <= top <= 12):
            raise ValueError(f"word {word}, bits {top} to {top - bits + 1} are outside the frame")
        return Piece(((max(subframe, 1) - 1) * self.words + word - 1), top - bits, bits, into, frame)

    def regular(self, fields: list[str]) -> _ParameterLine:
        """Return a part in every frame: as many places as its rate says, from its first on."""
        rate, subframe, word, top, bits, into = (int(f) for f in fields[2:8])
        first = self._piece(subframe, word, top, bits, into - bits)
        all_words = 4 * self.words
        if rate < 1 or all_words % rate:
            raise ValueError(f"rate {rate} does not divide the frame")
        step = all_words // rate
        places = tuple(replace(first, word=(first.word + i * step) % all_words) for i in range(rate))
        return _ParameterLine(int(fields[1]), places, 1)

    def superframe(self, fields: list[str], places: dict[str, list[str]]) -> _ParameterLine:
        """Return a part in a superframe's word."""
        if fields[3] not in places:
            raise ValueError(f"no superframe {fields[3]}")
        place, (frame, top, bits, into) = places[fields[3]], (int(f) for f in fields[4:8])
        if int(fields[2]) < 1:
            raise ValueError(f"a superframe of {fields[2]} frames")
        piece = self._piece(int(place[1]), int(place[2]), top, bits, into - bits, frame - 1)
        return _ParameterLine(int(fields[1]), (piece,), int(fields[2]))


def _place(meaning: Parameter, lines: list[_ParameterLine], frame_s: float) -> Iterator[Parameter]:
    """Yield the parameter as listed; whole too, where the lines leave a part of its word to the reader."""
    regular = [line for line in lines if line.cycle == lines[0].cycle]
    if other := [line for line in lines if line.cycle != lines[0].cycle]:
        yield from _place(replace(meaning, name=meaning.name + SUPERFRAME), other, frame_s)
    if len({len(line.pieces) for line in regular}) > 1:
        yield replace(meaning, unreadable="its parts are recorded at different rates")
        return
    groups: list[list[_ParameterLine]] = []
    for line in regular:
        if line.part == 1 or not groups:
            groups.append([])
        groups[-1].append(line)
    whole = _as_written(meaning.coding)
    complete = _complete(meaning.coding, groups)
    if groups != complete or meaning.coding != whole:
        yield _with_samples(replace(meaning, name=meaning.name + WHOLE, coding=whole), complete, frame_s)
        meaning = replace(meaning, description=f"{meaning.description} (as listed; see {meaning.name}{WHOLE})")
    yield _with_samples(meaning, groups, frame_s)


def _as_written(coding: Coding) -> Coding:
    """Return a BCD coding with its decimal point and offset: 1330, two decimals, offset 100 is 113.30 MHz."""
    if coding.kind != "bcd" or not (coding.decimals or coding.base):
        return coding
    return replace(coding, steps=(Polynomial((coding.base, 10.0**-coding.decimals)),))


def _complete(coding: Coding, groups: list[list[_ParameterLine]]) -> list[list[_ParameterLine]]:
    """Join samples that hold other bits of one word; copy the sign to the bits above the highest recorded.

    A number in two's complement that is recorded without its highest bits is small enough to do without them, and they
    are equal to the sign.
    """
    bit_ranges = [{(line.pieces[0].into, line.pieces[0].bits) for line in group} for group in groups]
    if any(h != bit_ranges[0] for h in bit_ranges):
        groups = [list({line.pieces[0].into: line for group in reversed(groups) for line in reversed(group)}.values())]
    return groups if coding.sign is None else [_extend(coding, group) for group in groups]


def _extend(coding: Coding, group: list[_ParameterLine]) -> list[_ParameterLine]:
    pieces = [line.pieces[0] for line in group]
    sign = [i for i, p in enumerate(pieces) if p.into <= (coding.sign or 0) < p.into + p.bits]
    if not sign:
        return group
    top = max((p.into + p.bits for i, p in enumerate(pieces) if i != sign[0]), default=coding.low + coding.bits)
    line = group[sign[0]]
    up = (coding.sign or 0) - pieces[sign[0]].into
    bit = [replace(p, low=p.low + up, bits=1) for p in line.pieces]
    missing = range(top, coding.low + coding.bits) if pieces[sign[0]].bits == 1 else range(0)
    return group + [replace(line, pieces=tuple(replace(p, into=place) for p in bit)) for place in missing]


def _with_samples(meaning: Parameter, groups: list[list[_ParameterLine]], frame_s: float) -> Parameter:
    rate = len(groups[0][0].pieces)
    cycle = groups[0][0].cycle
    gap_s = frame_s / (rate * len(groups)) if cycle == 1 else 0.0
    samples = tuple(
        Sample(gap_s * (i * len(groups) + g), tuple(line.pieces[i] for line in group))
        for i in range(rate)
        for g, group in enumerate(groups)
    )
    return replace(meaning, samples=samples, cycle=cycle, rate_hz=len(samples) / (frame_s * cycle))


def read_frd(name: str, data: bytes, meanings: Mapping[str, Parameter]) -> Map767:
    """Read a `.frd`: kind 1 is the file's revision, 2 a frame, 3 a parameter's order in it, 4 its short name."""
    revision = ""
    short = {}
    frames: dict[int, tuple[str, float]] = {}
    order: dict[int, dict[int, str]] = {}
    for number, kind, fields in read_lines(name, data):
        try:
            if kind == "1":
                revision = fields[1]
            elif kind == "2":
                frames[int(fields[0])] = fields[1], int(fields[2]) / int(fields[3] or 1)
            elif kind == "3":
                order.setdefault(int(fields[0]), {})[int(fields[1])] = fields[2]
            elif kind == "4":
                short[fields[0]] = fields[1]
        except (ValueError, IndexError) as error:
            raise MapError(f"{name}: line {number}: {error}") from None
    kinds = {}
    parameters = {}
    for frame_id, (title, rate_hz) in frames.items():
        by_position = order.get(frame_id, {})
        names = [short.get(by_position[i], by_position[i]) for i in sorted(by_position)]
        if undefined_names := [n for n in names if n not in meanings]:
            raise MapError(f"{name}: frame {frame_id}: the .par does not define {undefined_names[0]}")
        of_frame, size = lay_out([meanings[n] for n in names], frame_id, rate_hz)
        parameters.update({p.name: p for p in of_frame})
        kinds[frame_id] = Frame767(frame_id, title, size, rate_hz)
    return Map767(kinds, dict(sorted(parameters.items())), revision)
