"""Read the fleet list, `fleet.csv`. Of an aircraft's good lines the first counts."""

from dataclasses import dataclass
from datetime import date, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipelines.intake.columns import Contract
from pipelines.intake.faults import Fault
from pipelines.intake.log_lines import Lines, Row, Words, parse_list
from pipelines.intake.names import MAX_PACKS, is_operator, is_tail
from pipelines.intake.times import to_day

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
    """Parse the lines of the list in the order of `raw_fleet`, and the faults of the others."""
    return parse_list(content, CONTRACT, _validate, n_key=2)


def _validate(words: Words, _: datetime | None) -> Row | Fault:
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
