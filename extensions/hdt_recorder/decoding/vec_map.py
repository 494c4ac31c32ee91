"""Parameter maps as a ground station exports them: a `.vec` archive's `.par`, and `.fra` (ARINC 717) or `.frd` (767).

Tables of tab-separated lines, UTF-16; the digits before `|` name the kind of line. A parameter is defined by its place
in an ARINC 429 word of 32 bits (bits from 1), and the frame lists which bits of that word are recorded where.
"""

import re
from collections.abc import Iterator, Mapping

from hdt_recorder.decoding.coding import Coding, Kind, LookupTable, Polynomial, Segments, Step
from hdt_recorder.decoding.layout import MapError, Parameter, ParameterMap
from hdt_recorder.decoding.vec_frames import read_fra, read_frd
from hdt_recorder.decoding.vec_lines import Line, read_lines

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
    msb, bits = int(head[7]), int(head[8])
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
