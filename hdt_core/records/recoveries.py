"""Judge the maintenance log by what the flights show: which work recovered a loss, when, and at which position.

A log is written by people. It may be days late, dated by the local day before, list one piece of work twice or for the
other position, or list work that was not done. The loss of a part settles most of it, for it falls on the flight after
the work and on no other. An entry that counts before a message after which the loss fell is of work after the message.
One whose date the flights contradict may have a wrong year or month, or day and month exchanged. Work that is dated
long after the aircraft's last flight waits for its next one.
An engineer who closes an alert names its position by that, so such an entry stays there.
Where the loss is too small to show the work either way, the log's word counts.

References
----------
.. [1] MMEL Policy Letter 25, FAA: repair of category C within ten days, extended once.
"""

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from hdt_core.records.keys import AIRCRAFT, PACK
from hdt_core.records.unit_index import NEW_UNIT, date_entries
from hdt_core.robust import Array
from hdt_core.tables.raw import CASE

LEAST_RECOVERY, RECOVERY_SDS = 0.05, 3.0
"""A recovery is a loss lower by this much, and by so many of its standard deviations, than some flights before."""
RECOVERY_FLIGHTS = 10
"""Flights over which a recovery is measured, within which a log counts as on time, and after which work that the
flights do not show counts as not done."""
LATE_DAYS = 30.0
"""Days within which work is logged, or logged again: ten for a deferred repair [1], extended once, and ten more."""
YEAR, MONTH = timedelta(days=365), timedelta(days=30.4)
"""By how much a line is misdated whose year or month is wrong."""
LOGGED, EARLY, LATE, MISDATED, ELSEWHERE = ("logged", "early", "late", "misdated", "elsewhere")
REPEATED, NOT_SEEN, AHEAD = ("repeated", "not_seen", "ahead")
MOVED = (EARLY, LATE, MISDATED, ELSEWHERE)
"""Verdicts on work that counts from where the flights show it."""
IN_FORCE = (LOGGED, *MOVED)
JUDGED: dict[str, Any] = {
    "verdict": pl.String, "in_force": pl.Boolean, "position": pl.Int32, "flown_from": pl.Datetime("us", "UTC"),
    "known_from": pl.Datetime("us", "UTC"), "known_until": pl.Datetime("us", "UTC"), "is_shown": pl.Boolean,
}  # fmt: skip
"""Columns of `judge_work` beside those of the log."""


def is_recovery(before: Array, before_sd: Array, after: Array, after_sd: Array) -> Array:
    """Whether a loss recovered, by losses and standard deviations before and after; False where one is NaN. (n,)"""
    return np.asarray(before - after >= np.maximum(LEAST_RECOVERY, RECOVERY_SDS * np.hypot(before_sd, after_sd)))


def as_recovery(before: str, before_sd: str, after: str, after_sd: str) -> pl.Expr:
    """Whether a loss recovered, as `is_recovery`, of columns by name; False where one is null."""
    least = pl.max_horizontal(
        LEAST_RECOVERY, RECOVERY_SDS * (pl.col(before_sd).pow(2) + pl.col(after_sd).pow(2)).sqrt()
    )
    return (pl.col(before) - pl.col(after) >= least).fill_null(False)


def find_recoveries(loss: Array, loss_sd: Array) -> list[int]:
    """Find the flights from which a unit's loss had recovered: of each recovery that with the largest fall.

    Parameters
    ----------
    loss, loss_sd : array, shape (flights,)
        Of a position's flights in order, NaN where unknown.
    """
    known_rows = np.flatnonzero(np.isfinite(loss) & np.isfinite(loss_sd))
    level = loss[known_rows]
    sd = loss_sd[known_rows]
    before = np.maximum(np.arange(known_rows.size) - RECOVERY_FLIGHTS, 0)
    has_recovered = np.flatnonzero(is_recovery(level[before], sd[before], level, sd))
    is_first = np.diff(has_recovered, prepend=-np.inf) > 2 * RECOVERY_FLIGHTS
    starts = (slice(before[k] + 1, k + 1) for k in has_recovered[is_first])
    falls = np.diff(level, prepend=np.nan)
    return [int(known_rows[s.start + np.nanargmin(falls[s])]) for s in starts]


@dataclass(slots=True)
class _Position:
    """Flights of one component at one position, and its recoveries that no work explains yet."""

    pack: int
    departed_at: list[datetime]
    loss: Array
    loss_sd: Array
    unexplained: list[int] = field(default_factory=list)
    messages: list[datetime] = field(default_factory=list)

    def row_at(self, moment: datetime) -> int:
        """Return the first flight at or after a moment."""
        return bisect_left(self.departed_at, moment)

    def settled_at(self, recovery: int) -> datetime | None:
        """Return the flight by which a recovery is sure to be known; None where it has not been flown."""
        row = recovery + RECOVERY_FLIGHTS
        return self.departed_at[row] if row < len(self.departed_at) else None

    def known_before(self, row: int) -> tuple[float, float]:
        """Return the last known loss before a flight and its standard deviation."""
        known_rows = np.flatnonzero(np.isfinite(self.loss[:row]))
        if not known_rows.size:
            return np.nan, np.nan
        last = known_rows[-1]
        return float(self.loss[last]), float(self.loss_sd[last])

    def is_beyond(self, moment: datetime) -> bool:
        """Whether a moment lies longer after the last flight than work is logged late."""
        return moment - self.departed_at[-1] > timedelta(LATE_DAYS)

    def contradicts(self, entry_row: int, moment: datetime) -> bool:
        """Whether work can't be of a moment: no flight is near, or those after it show none."""
        is_outside = entry_row == 0 or self.is_beyond(moment)
        return is_outside or self.unshown_from(entry_row) is not None

    def is_reported_between(self, begin: datetime, end: datetime) -> bool:
        """Whether a message came from one moment to another."""
        return any(begin <= moment < end for moment in self.messages)

    def is_worn(self, row: int) -> bool:
        """Whether a renewal before a flight would show: the loss before it is as large as a recovery."""
        loss, sd = self.known_before(row)
        return loss >= max(LEAST_RECOVERY, RECOVERY_SDS * sd)

    def unshown_from(self, row: int) -> int | None:
        """Return the flight after which work before `row` counts as not done: the loss never fell to a half of it."""
        known_rows = row + np.flatnonzero(np.isfinite(self.loss[row:]))[:RECOVERY_FLIGHTS]
        if known_rows.size < RECOVERY_FLIGHTS or not self.is_worn(row):
            return None
        return int(known_rows[-1]) if self.loss[known_rows].min() > 0.5 * self.known_before(row)[0] else None


@dataclass(slots=True)
class _Entry:
    """An entry of the log and the judgement on it."""

    index: int
    position: _Position
    action: str
    counts_from: datetime
    is_of_case: bool = False
    verdict: str = LOGGED
    moved_to: _Position | None = None
    recovery: int | None = None
    known_until: datetime | None = None

    @property
    def row(self) -> int:
        """First flight that counts as flown after it, by the log."""
        return self.position.row_at(self.counts_from)

    def judged(self) -> dict[str, object]:
        """Return the columns of `JUDGED`."""
        place = self.moved_to or self.position
        flown_from = self.counts_from
        known_from: datetime | None = self.counts_from
        if self.recovery is not None and self.verdict in MOVED:
            flown_from = place.departed_at[self.recovery]
            known_from = place.settled_at(self.recovery)
            if known_from is not None and self.verdict != MISDATED:
                known_from = max(known_from, self.counts_from)
        return {
            "index": self.index,
            "verdict": self.verdict,
            "in_force": self.verdict in IN_FORCE,
            "position": place.pack,
            "flown_from": flown_from,
            "known_from": known_from,
            "known_until": self.known_until,
            "is_shown": self.recovery is not None,
        }


def judge_work(
    losses: pl.DataFrame, maintenance: pl.DataFrame, messages: pl.DataFrame, component: str, actions: Sequence[str]
) -> pl.DataFrame:
    """Judge each entry of a component's log by the flights.

    Parameters
    ----------
    losses : DataFrame
        `PACK`, `departed_at`, `loss`, `loss_sd`: every flight of the positions, null where unknown.
    maintenance : DataFrame
        The log.
    messages : DataFrame
        The component's messages: `PACK`, `message_time`.
    actions : sequence of str
        Work that lowers the component's loss.

    Returns
    -------
    DataFrame
        The log's rows of this component and these actions, with `JUDGED`: `verdict`; `in_force`, whether the work
        counts; the `position` at which it was done; `flown_from`, the moment from which flights count as flown after
        it; `known_from` and `known_until`, between which the record of that time let it count (null: not yet, and not
        ended); `is_shown`, whether a loss recovered.
    """
    is_own = (pl.col("component") == component) & pl.col("action").is_in(actions) & pl.col("pack").is_not_null()
    entries = date_entries(maintenance).filter(is_own & pl.col("counts_from").is_not_null()).with_row_index("index")
    is_of_case = pl.col("source") == CASE if "source" in entries.columns else pl.lit(False)
    marked_entries = entries.with_columns(is_of_case=is_of_case.fill_null(False))
    flights = losses.join(entries.select(AIRCRAFT).unique(), on=AIRCRAFT, how="semi").sort(*PACK, "departed_at")
    judgements: list[dict[str, object]] = []
    own_entries = marked_entries.partition_by(AIRCRAFT, as_dict=True)
    for aircraft, own_flights in flights.partition_by(AIRCRAFT, as_dict=True).items():
        positions = {p.pack: p for p in _positions(own_flights)}
        for _, _, pack, moment in (
            messages.filter(operator=aircraft[0], tail=aircraft[1]).select(*PACK, "message_time").rows()
        ):
            if pack in positions:
                positions[pack].messages.append(moment)
        judgements += (entry.judged() for entry in _judge_aircraft(own_entries[aircraft], positions))
    judged = pl.DataFrame(judgements, schema={"index": entries.schema["index"], **JUDGED}, orient="row")
    unflown = [pl.col("verdict").fill_null(LOGGED), pl.col("in_force").fill_null(True)]
    unflown += [pl.col("position").fill_null(pl.col("pack")), pl.col("is_shown").fill_null(False)]
    unflown += [pl.col(name).fill_null(pl.col("counts_from")) for name in ("flown_from", "known_from")]
    return entries.join(judged, on="index", how="left", validate="1:1").with_columns(unflown).drop("index")


def _positions(flights: pl.DataFrame) -> Iterator[_Position]:
    for (*_, pack), rows in flights.group_by(PACK, maintain_order=True):
        loss, sd = (rows[c].cast(pl.Float64).fill_null(np.nan).to_numpy() for c in ("loss", "loss_sd"))
        yield _Position(int(str(pack)), rows["departed_at"].to_list(), loss, sd, find_recoveries(loss, sd))


def _judge_aircraft(rows: pl.DataFrame, positions: dict[int, _Position]) -> list[_Entry]:
    """Judge the entries of an aircraft's positions: those on time first, then late ones, then those elsewhere."""
    fields = rows.select("index", "pack", "action", "counts_from", "is_of_case").sort("counts_from", "index").rows()
    entries = [_Entry(i, positions[p], *more) for i, p, *more in fields if p in positions]
    for entry in entries:
        _explain(entry, entry.position, [r for r in entry.position.unexplained if _is_on_time(r, entry.row)], LOGGED)
        if _is_early(entry):
            entry.verdict = EARLY
    for entry in (e for e in entries if e.recovery is None):
        late = [r for r in entry.position.unexplained if _is_late(entry, entry.position, r)]
        _explain(entry, entry.position, late[-1:], LATE)
    for entry in (e for e in entries if e.recovery is None and not e.is_of_case):
        _explain(entry, entry.position, [r for r in entry.position.unexplained if _is_misdated(entry, r)], MISDATED)
    for entry in (e for e in entries if e.recovery is None and not e.is_of_case):
        others = ((p, r) for p in positions.values() if p is not entry.position for r in p.unexplained)
        for place, recovery in [(p, r) for p, r in others if _is_late(entry, p, r)][-1:]:
            _explain(entry, place, [recovery], ELSEWHERE)
    for entry in (e for e in entries if e.recovery is None):
        unshown = entry.position.unshown_from(entry.row)
        if _is_repeated(entry, entries):
            entry.verdict = REPEATED
            entry.known_until = entry.counts_from
        elif unshown is not None:
            entry.verdict = NOT_SEEN
            entry.known_until = entry.position.departed_at[unshown]
        elif entry.position.is_beyond(entry.counts_from) and not entry.is_of_case:
            entry.verdict = AHEAD
    return entries


def _explain(entry: _Entry, place: _Position, recoveries: Sequence[int], verdict: str) -> None:
    """Let an entry explain the first of some recoveries."""
    for recovery in recoveries[:1]:
        entry.recovery = recovery
        entry.verdict = verdict
        entry.moved_to = place if verdict == ELSEWHERE else None
        place.unexplained.remove(recovery)


def _is_on_time(recovery: int, row: int) -> bool:
    return abs(recovery - row) <= RECOVERY_FLIGHTS


def _is_early(entry: _Entry) -> bool:
    """Whether a message came after the entry's moment and before the recovery that it explains."""
    if entry.recovery is None:
        return False
    recovered_at = entry.position.departed_at[entry.recovery]
    return entry.position.is_reported_between(entry.counts_from, recovered_at)


def _is_misdated(entry: _Entry, recovery: int) -> bool:
    """Whether a usual slip of the entry's date leads to a recovery.

    And either a message asked for that work, or the flights contradict the entry's own date.
    """
    place = entry.position
    recovered_at = place.departed_at[recovery]
    is_answer = place.is_reported_between(recovered_at - timedelta(LATE_DAYS), recovered_at)
    if not is_answer and not place.contradicts(entry.row, entry.counts_from):
        return False
    return any(_is_on_time(recovery, place.row_at(moment)) for moment in _slips(entry.counts_from))


def _slips(moment: datetime) -> Iterator[datetime]:
    """Yield the moments that may have been meant: a year or month off, or day and month exchanged."""
    for offset in (YEAR, -YEAR, MONTH, -MONTH):
        yield moment + offset
    second = timedelta(seconds=1)
    on_day = moment - second  # an entry without a time counts from the next midnight
    if on_day.day <= 12:
        yield on_day.replace(month=on_day.day, day=on_day.month) + second


def _is_late(entry: _Entry, place: _Position, recovery: int) -> bool:
    """Whether a recovery lies up to `LATE_DAYS` before the entry, or no later than a log that is on time."""
    delay = entry.counts_from - place.departed_at[recovery]
    return delay <= timedelta(LATE_DAYS) and recovery <= place.row_at(entry.counts_from) + RECOVERY_FLIGHTS


def _is_repeated(entry: _Entry, entries: Iterable[_Entry]) -> bool:
    """Whether an earlier entry lists the same work, after which there was no message and nothing to recover."""
    others = (e for e in entries if e is not entry and e.action == entry.action and e.verdict in IN_FORCE)
    earlier = [
        e
        for e in others
        if (e.moved_to or e.position) is entry.position
        and (e.counts_from, e.index) < (entry.counts_from, entry.index)
        and entry.counts_from - e.counts_from <= timedelta(LATE_DAYS)
        and not entry.position.is_reported_between(e.counts_from, entry.counts_from)
    ]
    loss, _ = entry.position.known_before(entry.row)
    is_clean = np.isfinite(loss) and not entry.position.is_worn(entry.row)
    explained = (e for e in earlier if e.recovery is not None)
    is_same = any(e.recovery >= entry.row or entry.row - e.row <= RECOVERY_FLIGHTS for e in explained)  # type: ignore[operator]
    return is_same or (is_clean and bool(earlier))


def settle(judged: pl.DataFrame) -> pl.DataFrame:
    """Return the work that counts, as the log would have it had it been right: `pack` and `counts_from` settled."""
    settled = judged.filter("in_force").with_columns(pack="position", counts_from="flown_from")
    return settled.drop(JUDGED)


def as_known(judged: pl.DataFrame) -> pl.DataFrame:
    """Return between which moments work counted by the record of that time.

    Returns
    -------
    DataFrame
        The log's columns with `pack` where it counted, `flown_from`, and `counts_from` and `until`, the moments.
    """
    standing_work = judged.filter(pl.col("verdict") != REPEATED).with_columns(until="known_until")
    moved_work = standing_work.filter(pl.col("verdict").is_in([EARLY, ELSEWHERE]))
    # until it was known to be later or of another position, it counted when and where it is logged
    as_logged = moved_work.with_columns(until="known_from", flown_from="counts_from")
    as_logged = as_logged.filter(pl.col("until").is_null() | (pl.col("until") > pl.col("counts_from")))
    settled = standing_work.with_columns(pack="position", counts_from="known_from").drop_nulls("counts_from")
    columns = [c for c in judged.columns if c not in JUDGED]
    return pl.concat([as_logged, settled]).select(*columns, "flown_from", "until")


def units_as_known(flights: pl.DataFrame, judged: pl.DataFrame) -> pl.DataFrame:
    """Return which unit the record of the time held to fly.

    Parameters
    ----------
    flights : DataFrame
        `PACK`, `departed_at`, `row` (the pack's flights from 0).
    judgements : DataFrame
        Of `judge_work`.

    Returns
    -------
    DataFrame
        `PACK`, `known_row` (from that flight on it was held so), `first_row` (first flight of the unit).
    """
    work = as_known(judged.filter(pl.col("action").is_in(NEW_UNIT))).sort("counts_from")
    own_work = work.partition_by(PACK, as_dict=True)
    rows: list[tuple[object, ...]] = []
    for pack, own in flights.sort("row").partition_by(PACK, as_dict=True).items():
        departed_at = own["departed_at"].to_list()
        moments = own_work[pack].select("flown_from", "counts_from", "until").rows() if pack in own_work else []
        rows += ((*pack, *unit) for unit in [(0, 0), *_units_of(departed_at, moments)])
    types: dict[str, Any] = {**flights.select(PACK).schema, "known_row": pl.Int64, "first_row": pl.Int64}
    units = pl.DataFrame(rows, schema=types, orient="row")
    return units.unique([*PACK, "known_row"], keep="last", maintain_order=True).sort(*PACK, "known_row")


def _units_of(
    departed_at: list[datetime], work: Iterable[tuple[datetime, datetime, datetime | None]]
) -> Iterator[tuple[int, int]]:
    """Yield known row and first row of each unit after the first, and of one that turned out to have stayed."""
    stayed = 0
    for flown_from, known_from, until in work:
        first, known_row = (bisect_left(departed_at, moment) for moment in (flown_from, known_from))
        if known_row == len(departed_at):
            continue
        yield known_row, first
        if until is None:
            stayed = first
        elif until <= departed_at[-1]:
            yield bisect_left(departed_at, until), stayed
