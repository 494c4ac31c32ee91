"""Find which airframe flew under an operator and tail, and from when, by the lines of the fleet list.

An airframe is its msn, of a type; where that is empty, its operator and tail. What is stored is keyed by the operator
and tail of its earliest line, so that a new registration changes no key. Where that line's tail belonged to another
airframe before, the key's tail ends in `.2` and so on, which no registration does. Lines that contradict each other
count as lines without msn: none is guessed.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from itertools import pairwise

import polars as pl

from hdt_core.tables.raw import RawFleet
from pipelines.intake.faults import Fault
from pipelines.intake.landing_file import Aircraft, FileIntake, LandingFile, Tenure
from pipelines.intake.logs import FleetLine

MIN_OVERLAP_FLIGHTS = 3
OVERLAP_SHARE = 0.05
"""Fewer flights, or a smaller share, on the wrong side of the day that parts two records are misdated flights."""


@dataclass(frozen=True, slots=True)
class Airframes:
    """Keys of the airframes of a fleet list."""

    lines: list[FleetLine]
    """Lines of the list; without msn where they contradict another."""
    keys: list[Aircraft]
    """Key of the airframe of each line."""
    prefixes: list[str]
    """What the ids of flights under each line begin with, beside the delivered one; see `Tenure.prefix`."""
    contradictions: list[str]
    """Lines that contradict each other, in words."""

    def tenures(self, folder: Aircraft) -> list[Tenure]:
        """List the airframes that had an operator and tail one after the other; none where it is one of that name."""
        places = (i for i, line in enumerate(self.lines) if line.folder == folder)
        own = sorted(places, key=lambda i: _begin(self.lines[i]))
        tenures = [Tenure(date.min, self.keys[i], self.prefixes[i]) for i in own[:1]]
        for before, after in pairwise(own):
            if self.keys[before] != self.keys[after]:
                since = _takeover(self.lines[before], self.lines[after]) or date.min
                tenures.append(Tenure(since, self.keys[after], self.prefixes[after]))
        return [] if [(t.airframe, t.prefix) for t in tenures] == [(folder, "")] else tenures


def find_airframes(lines: Sequence[FleetLine], apart: Iterable[Aircraft] = ()) -> Airframes:
    """Find the airframe of each line.

    Parameters
    ----------
    lines : sequence of FleetLine
    apart : iterable of (str, str)
        Operators and tails whose flights show that they are airframes of their own; see `overlapping_folders`.
    """
    contradictions = {**_of_one_tail(lines), **_of_one_msn(lines, set(apart))}
    places = {place for pair in contradictions for place in pair}
    sound = [replace(line, msn=None) if i in places else line for i, line in enumerate(lines)]
    keys = [("", "")] * len(sound)
    prefixes = [""] * len(sound)
    numbers: dict[Aircraft, int] = {}
    for own in _by_airframe(sound):
        folder = sound[own[0]].folder
        numbers[folder] = numbers.get(folder, 0) + 1
        key = folder if numbers[folder] == 1 else (folder[0], f"{folder[1]}.{numbers[folder]}")
        for i in own:
            line, keys[i] = sound[i], key
            earlier = {sound[j].folder for j in own[: own.index(i)]} - {line.folder}
            had_tail = line.folder != folder and line.tail in {tail for _, tail in earlier}
            prefixes[i] = f"{line.operator}." if had_tail else ""
    return Airframes(sound, keys, prefixes, list(contradictions.values()))


def add_airframes(file: LandingFile, intake: FileIntake) -> FileIntake:
    """Add their airframes to the lines of a fleet list, as in `raw_fleet`, and a note for each contradiction."""
    rows = intake.rows.with_columns(pl.col("type").fill_null(""))
    airframes = find_airframes([FleetLine(*row) for row in rows.iter_rows()], file.apart)
    texts: dict[str, list[str | None]] = {
        "msn": [line.msn for line in airframes.lines],
        "airframe_operator": [operator for operator, _ in airframes.keys],
        "airframe_tail": [tail for _, tail in airframes.keys],
        "flight_prefix": [*airframes.prefixes],
    }
    columns = [pl.Series(name, values, pl.String) for name, values in texts.items()]
    lines = rows.with_columns(columns).with_columns(pl.col("type").replace("", None))
    notes = [Fault("lines_contradict", detail=f"{words}.") for words in airframes.contradictions]
    quarantine = pl.concat([intake.quarantine, file.quarantine(notes)])
    return replace(intake, rows=RawFleet.conform(lines), quarantine=quarantine)


_TIMES = ("message_time", "done_on", "reported_at", "time_utc")


def with_airframe(rows: pl.DataFrame, file: LandingFile) -> pl.DataFrame:
    """Replace operator, tail and flight_id of a file's dated rows, as delivered, by those of the airframe."""
    day = next(pl.col(name).cast(pl.Date) for name in _TIMES if name in rows.columns)
    for tenure in file.tenures:
        operator, tail = tenure.airframe
        values = {"operator": pl.lit(operator), "tail": pl.lit(tail)}
        if tenure.prefix and "flight_id" in rows.columns:
            delivered = pl.col("flight_id").str.strip_prefix(tenure.prefix)
            values["flight_id"] = pl.lit(tenure.prefix) + delivered
        holds = day >= tenure.since
        rows = rows.with_columns(pl.when(holds).then(v).otherwise(name).alias(name) for name, v in values.items())
    return rows


def overlapping_folders(lines: Sequence[FleetLine], days: Mapping[Aircraft, list[date]]) -> set[Aircraft]:
    """List operators and tails of one msn, on lines without dates, whose flights do not follow each other.

    `days` are the days of the flights of each operator and tail of `undated_folders`.
    """
    pairs = [(lines[i].folder, lines[j].folder) for i, j in _undated(lines)]
    return {folder for pair in pairs if _overlap(days[pair[0]], days[pair[1]]) for folder in pair}


def undated_folders(lines: Sequence[FleetLine]) -> set[Aircraft]:
    """List operators and tails that share an msn, on lines without dates."""
    return {lines[i].folder for pair in _undated(lines) for i in pair}


def _undated(lines: Sequence[FleetLine]) -> Iterator[tuple[int, int]]:
    for i, j in _successions(lines):
        if not lines[i].valid_to and not lines[j].valid_from:
            yield i, j


def _successions(lines: Sequence[FleetLine]) -> Iterator[tuple[int, int]]:
    """Yield lines that follow each other on one msn, under another operator or tail."""
    for own in _by_airframe(lines):
        for i, j in pairwise(own):
            if lines[i].folder != lines[j].folder:
                yield i, j


def _by_airframe(lines: Sequence[FleetLine]) -> list[list[int]]:
    """Group the numbers of the lines by airframe, each group and the groups from the earliest line on."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for i in sorted(range(len(lines)), key=lambda i: _begin(lines[i])):
        line = lines[i]
        groups.setdefault((line.type, line.msn) if line.msn else ("", *line.folder), []).append(i)
    return list(groups.values())


def _begin(line: FleetLine) -> date:
    return line.valid_from or line.delivered_on or date.min


def _takeover(before: FleetLine, after: FleetLine) -> date | None:
    """Return the day from which a line holds in place of another; None where nothing says."""
    if after.valid_from:
        return after.valid_from
    if before.valid_to:
        return before.valid_to + timedelta(days=1)
    return after.delivered_on


def _of_one_tail(lines: Sequence[FleetLine]) -> dict[tuple[int, int], str]:
    """Find lines of one operator and tail that give it to two airframes on one day."""
    contradictions = {}
    ordered = sorted(range(len(lines)), key=lambda i: (lines[i].folder, _begin(lines[i])))
    for i, j in pairwise(ordered):
        before = lines[i]
        after = lines[j]
        if before.folder != after.folder or (before.msn, before.type) == (after.msn, after.type):
            continue
        since = _takeover(before, after)
        if since is None or since <= _begin(before) or (before.valid_to and before.valid_to >= since):
            name = "/".join(before.folder)
            contradictions[i, j] = f"{name} is msn {before.msn or '(none)'} and {after.msn or '(none)'} on the same day"
    return contradictions


def _of_one_msn(lines: Sequence[FleetLine], apart: set[Aircraft]) -> dict[tuple[int, int], str]:
    """Find lines that give one airframe two names on one day."""
    contradictions = {}
    for i, j in _successions(lines):
        before = lines[i]
        after = lines[j]
        if before.valid_to and after.valid_from:
            contradictory = before.valid_to >= after.valid_from
        else:
            contradictory = {before.folder, after.folder} <= apart
        if contradictory:
            names = " and ".join("/".join(line.folder) for line in (before, after))
            contradictions[i, j] = f"msn {before.msn} is {names} on the same day"
    return contradictions


def _overlap(some: Sequence[date], others: Sequence[date]) -> bool:
    """Whether flights of two records lie among each other, more than a few misdated ones."""
    misplaced = min(_misplaced(some, others), _misplaced(others, some))
    fewer = min(len(some), len(others))
    return misplaced >= MIN_OVERLAP_FLIGHTS and misplaced > OVERLAP_SHARE * fewer


def _misplaced(earlier: Sequence[date], later: Sequence[date]) -> int:
    """Count flights on the wrong side of the day that parts an earlier record best from a later one."""
    least = count = len(earlier)
    for _, is_later in sorted([*((day, False) for day in earlier), *((day, True) for day in later)]):
        count += 1 if is_later else -1
        least = min(least, count)
    return least
