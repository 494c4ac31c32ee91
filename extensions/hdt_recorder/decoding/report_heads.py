"""What the head of a printed report says of bleed and packs, whatever the report is about."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from hdt_recorder.decoding.printed import ReportLine, Reports, Value

PACK_NUMBERS = (1, 2)
_CLOSED = "0"


@dataclass(frozen=True, slots=True)
class ReportHead:
    """Head of one report.

    Attributes
    ----------
    number : str
        Of its layout.
    line : int
        Of the file, from 1.
    aircraft : str
        Registration, without the dots that fill it.
    printed_at : datetime
        UTC.
    altitude_ft, mach : float, optional
    pack_flow_kg_s : tuple of float or None
        Of pack 1 and 2.
    bleed_open : tuple of bool or None
        Whether any bleed valve of engine 1 and 2 is open.
    crossfeed_open : bool, optional
    """

    number: str
    line: int
    aircraft: str
    printed_at: datetime
    altitude_ft: float | None
    mach: float | None
    pack_flow_kg_s: tuple[float | None, ...]
    bleed_open: tuple[bool | None, ...]
    crossfeed_open: bool | None


def report_heads(reports: Reports) -> Iterator[ReportHead | ReportLine]:
    """A head a report; of one without a time of its own the first line that could be read.

    Fields go by the names they have in `report_layouts.A330`: `acid`, `date`, `utc`, `alt`, `mn`, and, with the number
    of pack or engine, `pack_flow_1`, `bleed_1`, `crossfeed`. What a layout of another aircraft does not name is None.
    """
    told: dict[int, list[ReportLine]] = {}
    for line in reports.lines:
        told.setdefault(line.report, []).append(line)
    for lines in told.values():
        yield _head(lines) or lines[0]


def _head(lines: list[ReportLine]) -> ReportHead | None:
    said: dict[str, Value] = {}
    for line in lines:
        said = dict(line.values) | said  # a name that comes again, as time and altitude do, is no longer the head's
    moment = _moment(said)
    if moment is None:
        return None
    flows = tuple(_number(said, f"pack_flow_{n}") for n in PACK_NUMBERS)
    bleeds = tuple(_open(said, f"bleed_{n}") for n in PACK_NUMBERS)
    aircraft = str(said.get("acid") or "").strip(".")
    return ReportHead(lines[0].number, lines[0].line, aircraft, moment, _number(said, "alt"), _number(said, "mn"),
                      flows, bleeds, _open(said, "crossfeed"))  # fmt: skip


def _moment(said: Mapping[str, Value]) -> datetime | None:
    try:
        return datetime.strptime(f"{said['date']} {said['utc']}", "%d%b%y %H.%M.%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return None


def _number(said: Mapping[str, Value], name: str) -> float | None:
    found = said.get(name)
    return found if isinstance(found, float) else None


def _open(said: Mapping[str, Value], name: str) -> bool | None:
    """Whether any digit says open; None for what is no digits at all."""
    found = said.get(name)
    word = f"{found:.0f}" if isinstance(found, float) else found or ""
    return word.strip(_CLOSED) != "" if word.isdigit() else None
