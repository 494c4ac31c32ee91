"""Bleed and pack state from the head of a printed report, whatever the report is about."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from hdt_recorder.decoding.printed import ReportLine, Reports, Value

PACK_NUMBERS = (1, 2)
_CLOSED_DIGIT = "0"


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
    """Yield a head per report; of a report without a time, its first readable line.

    Fields go by the names they have in `report_layouts.A330`: `acid`, `date`, `utc`, `alt`, `mn`, and, with the number
    of pack or engine, `pack_flow_1`, `bleed_1`, `crossfeed`. What a layout of another aircraft does not name is None.
    """
    by_report: dict[int, list[ReportLine]] = {}
    for line in reports.lines:
        by_report.setdefault(line.report, []).append(line)
    for lines in by_report.values():
        yield _head(lines) or lines[0]


def _head(lines: list[ReportLine]) -> ReportHead | None:
    values: dict[str, Value] = {}
    for line in lines:
        values = dict(line.values) | values  # a name that comes again, as time and altitude do, is no longer the head's
    moment = _moment(values)
    if moment is None:
        return None
    flows = tuple(_number(values, f"pack_flow_{n}") for n in PACK_NUMBERS)
    bleeds = tuple(_is_open(values, f"bleed_{n}") for n in PACK_NUMBERS)
    aircraft = str(values.get("acid") or "").strip(".")
    return ReportHead(lines[0].number, lines[0].line, aircraft, moment, _number(values, "alt"), _number(values, "mn"),
                      flows, bleeds, _is_open(values, "crossfeed"))  # fmt: skip


def _moment(values: Mapping[str, Value]) -> datetime | None:
    try:
        return datetime.strptime(f"{values['date']} {values['utc']}", "%d%b%y %H.%M.%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return None


def _number(values: Mapping[str, Value], name: str) -> float | None:
    value = values.get(name)
    return value if isinstance(value, float) else None


def _is_open(values: Mapping[str, Value], name: str) -> bool | None:
    """Return whether any digit means open; None for text without digits only."""
    value = values.get(name)
    word = f"{value:.0f}" if isinstance(value, float) else value or ""
    return word.strip(_CLOSED_DIGIT) != "" if word.isdigit() else None
