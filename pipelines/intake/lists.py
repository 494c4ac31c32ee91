"""Parse a short list in CSV, each line validated by itself, each stored once; and the fleet list, `fleet.csv`."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import date, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import polars as pl

from pipelines.intake.columns import Contract
from pipelines.intake.faults import Fault
from pipelines.intake.fields import MAX_PACKS, is_operator, is_tail, to_day, to_utc, zone_note
from pipelines.intake.text import Text, open_text, to_columns

Row = tuple[object, ...]
Words = dict[str, str]
"""Fields of a line by column, stripped; empty where the file has no such column."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Good lines, each once; faults of the others; the numbers of delivered and duplicate lines."""

    rows: list[Row]
    faults: list[Fault]
    n_delivered: int
    n_duplicate: int


def parse_list(
    content: bytes,
    contract: Contract,
    validate: Callable[[Words, datetime | None], Row | Fault],
    time: str = "",
    n_key: int = 0,
) -> Lines:
    """Open a list, validate its lines and drop duplicates.

    `time` is the column of times, which are parsed in bulk. The first `n_key` fields are a key: of several lines with
    one key the first counts; 0: whole lines are compared.
    """
    text = open_text(content, contract)
    lines = to_columns([text], ())
    harmless = () if n_key else ("no_rows",)  # an aircraft without messages has a header alone
    faults = [f for f in text.faults if f.reason not in harmless]
    good: dict[Row, int] = {}
    for row, words, moment in _words(lines, contract, time, faults):
        result = validate(words, moment)
        if isinstance(result, Fault):
            faults.append(_row_fault(result, row, text))
        else:
            good.setdefault(result, row)
    n_duplicate = text.n_rows - len(good) - sum(f.n_rows for f in faults)
    rows = _first_of_key(good, n_key, text, faults) if n_key else sorted(good, key=_sort_key)
    return Lines(rows, faults, text.n_rows, n_duplicate)


def _words(
    lines: pl.DataFrame, contract: Contract, time: str, faults: list[Fault]
) -> Iterator[tuple[int, Words, datetime | None]]:
    """Yield number, fields and time of each line; a note on times without zone goes to the faults."""
    moments: list[datetime | None] = [None] * lines.height
    if time and lines.height:
        times, naive = to_utc(lines.select(time, "row"), time)
        moments = times[time].to_list()
        faults.extend(zone_note(naive, time))
    names = (*contract.keys, *contract.words, *contract.extra)
    for line, moment in zip(lines.iter_rows(named=True), moments, strict=True):
        yield line["row"], {name: printable(line.get(name)) for name in names}, moment


def printable(field: str | None) -> str:
    """Strip a field of non-printable characters and cut it at 500."""
    return "".join(c for c in (field or "").strip() if c.isprintable())[:500]


def _row_fault(fault: Fault, row: int, text: Text) -> Fault:
    return replace(fault, row=row, n_rows=1, content=text.line(row))


def _sort_key(row: Row) -> tuple[tuple[bool, str], ...]:
    return tuple((field is None, str(field)) for field in row)


def _first_of_key(good: dict[Row, int], n_key: int, text: Text, faults: list[Fault]) -> list[Row]:
    """Keep the first of rows with the same leading fields; the others go to the faults."""
    first: dict[Row, Row] = {}
    for row, line in sorted(good.items(), key=lambda item: item[1]):
        if row[:n_key] in first:
            detail = f"Listed twice with other values; line {good[first[row[:n_key]]]} counts."
            faults.append(_row_fault(Fault("bad_key", detail=detail), line, text))
        else:
            first[row[:n_key]] = row
    return list(first.values())


PACKS = 2
"""Packs of an aircraft that is not in the fleet list."""
CONTRACT = Contract(("operator", "tail"), ("msn", "delivered_on", "packs", "type"))


@dataclass(frozen=True, slots=True)
class FleetLine:
    """The list's entry of one aircraft; `type` is empty where its files are the default record."""

    delivered_on: date | None = None
    packs: int = PACKS
    type: str = ""


FleetLines = dict[tuple[str, str], FleetLine]
"""By operator and tail."""


def parse_fleet(content: bytes) -> Lines:
    """Parse an aircraft's first good line in the order of `raw_fleet`, and the faults of the others."""
    return parse_list(content, CONTRACT, _validate_aircraft, n_key=2)


def _validate_aircraft(words: Words, _: datetime | None) -> Row | Fault:
    if not is_operator(words["operator"]) or not is_tail(words["tail"]):
        return Fault("bad_key", column_name="operator, tail")
    day = to_day(words["delivered_on"])
    if words["delivered_on"] and day is None:
        return Fault("unreadable_time", column_name="delivered_on")
    packs = words["packs"] or str(PACKS)
    if packs not in {str(n) for n in range(1, MAX_PACKS + 1)}:
        return Fault("bad_pack", column_name="packs")
    return (words["operator"], words["tail"], words["msn"] or None, day, int(packs), words["type"] or None)


def fleet_lines(landing: Path) -> FleetLines:
    """Read each aircraft's line by operator and tail; none where the list can't be read, which its intake reports."""
    path = landing / "fleet.csv"
    return _lines(path, path.stat().st_ctime_ns) if path.is_file() else {}


@lru_cache(maxsize=8)
def _lines(path: Path, _changed_ns: int) -> FleetLines:
    try:
        rows: list[Any] = parse_fleet(path.read_bytes()).rows
    except OSError:
        return {}
    return {(operator, tail): FleetLine(day, packs, kind or "") for operator, tail, _, day, packs, kind in rows}
