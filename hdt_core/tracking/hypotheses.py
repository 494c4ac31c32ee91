"""Weighted hypotheses about packs, flat and sorted by pack: joined, pruned, merged; and branched, by what may happen to
a pack between two flights and by what the log says of it, each with its chance.
"""

from typing import NamedTuple

import numpy as np

from hdt_core.calibration.arrays import Array
from hdt_core.records.renewals import NOTHING, REPLACED, WASHED
from hdt_core.tracking.wear_model import MAP_SD, OTHER, RATE, SENSORS, UNIT, WEAR, Observation, Settings

LEAST_WEIGHT, MOST, WEAR_BIN = 1e-6, 40, 0.01
"""Weight below which a hypothesis is dropped, how many a pack may keep, the bin of ln loss in which like ones merge."""
RENEWED_WEAR, RENEWED_SD = 0.003, 0.006
WASH_LEAVES, WASH_LEAVES_SD = 0.3, 0.2
RECOVERY_LEAVES, RECOVERY_LEAVES_SD = 0.35, 0.3
DEPOSIT, DEPOSIT_SD = 0.02, 0.02
FAULT_SD = 0.2
CHANCE = {"deposit": 1 / 200, "clog": 1 / 2000, "fault_over": 1 / 30, "recovery": 1 / 2000}
"""Of each event on a flight, as such things go; a fault lasts some thirty flights."""
RENEWAL_UNLOGGED, RENEWAL_LOGGED = 1 / 400, 0.5
"""Chance of a new core on a flight of which the log says nothing yet, units living some 400 flights
(`margin.first_passage`), and on one it names."""
LATE_FLIGHTS, LOG_LATE, NEVER_LOGGED = 8, 1 / 60, 0.03
"""Flights that an entry may be late; chance of work on the very flight it names, beside that of a step shown before it;
that an entry never comes where a log is kept."""


class Hypotheses(NamedTuple):
    """Hypotheses about packs, each the state of a Kalman filter: sorted by `pack`, weights adding up to 1 within each.

    log_weight (m,), mean (m, 5), cov (m, 5, 5); pace (m,) an index of the settings' paces, since (m,) flights since the
    core was renewed or washed, unlogged (m,) whether no entry has spoken of that yet, faulty (m,) whether something
    else than the core is wrong. Of the last flight: parent (m,) the row before it, retention (m, 5) the share of each
    state that its event left.
    """

    pack: Array
    log_weight: Array
    mean: Array
    cov: Array
    pace: Array
    since: Array
    unlogged: Array
    faulty: Array
    parent: Array
    retention: Array

    def at(self, rows: Array) -> "Hypotheses":
        """Hypotheses at `rows`, copied."""
        return Hypotheses(*(values[rows] for values in self))

    def of(self, pack: int) -> "Hypotheses":
        """Hypotheses of one pack."""
        first, last = np.searchsorted(self.pack, [pack, pack + 1])
        return self.at(np.arange(first, last))

    def of_first(self, n: int) -> "Hypotheses":
        """Hypotheses of the first n packs, not copied."""
        rows = int(np.searchsorted(self.pack, n))
        return self if rows == len(self.pack) else Hypotheses(*(values[:rows] for values in self))

    @property
    def n_packs(self) -> int:
        """How many packs there are, numbered without gaps."""
        return int(self.pack[-1]) + 1


class Branching(NamedTuple):
    """How one flight branched hypotheses and how they were merged, for the smoother.

    Each row is a branch: parent (m,) its row before, into (m,) the row it went into, -1 where it was dropped, weight
    (m,) its probability, prior (m, ...) its state before the flight's news.
    """

    prior: Hypotheses
    into: Array
    weight: Array


def join(parts: list[Hypotheses]) -> Hypotheses:
    """Concatenate hypotheses, not sorted."""
    return Hypotheses(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def prune(b: Hypotheses, offset_bin: float = np.inf) -> tuple[Hypotheses, Array]:
    """Drop light hypotheses, merge like ones by their moments, keep the heaviest; and where each row went."""
    bins = np.round(b.mean[:, WEAR] / WEAR_BIN)
    heavy = np.flatnonzero(b.log_weight > np.log(LEAST_WEIGHT))
    offset = np.round(b.mean[:, SENSORS] / offset_bin)
    keys = np.stack([b.pack, b.pace, b.faulty, b.unlogged, bins, offset])[:, heavy]
    order = np.lexsort((-b.log_weight[heavy], *keys[::-1]))
    heads = np.flatnonzero(np.r_[True, (np.diff(keys[:, order]) != 0).any(axis=0)])
    merged = _merged(b.at(heavy[order]), heads)
    order_by_weight = np.lexsort((-merged.log_weight, merged.pack))
    place = np.arange(len(order_by_weight)) - np.searchsorted(
        merged.pack[order_by_weight], merged.pack[order_by_weight]
    )
    heaviest = order_by_weight[place < MOST]
    new_row, into = np.full(len(heads), -1), np.full(len(b.pack), -1)
    new_row[heaviest] = np.arange(len(heaviest))
    into[heavy[order]] = new_row[_runs(heads, len(order))]
    return normalise(merged.at(heaviest)), into


def normalise(b: Hypotheses) -> Hypotheses:
    """Let weights add up to 1 in each pack; rows sorted by pack."""
    first = np.flatnonzero(np.r_[True, np.diff(b.pack) != 0])
    count = np.diff(np.r_[first, len(b.pack)])
    top = np.repeat(np.maximum.reduceat(b.log_weight, first), count)
    total = np.repeat(np.add.reduceat(np.exp(b.log_weight - top), first), count)
    return b._replace(log_weight=b.log_weight - top - np.log(total))


def _runs(heads: Array, n: int) -> Array:
    """Which run each of n rows belongs to, runs starting at `heads`."""
    return np.repeat(np.arange(len(heads)), np.diff(np.r_[heads, n]))


def _merged(b: Hypotheses, heads: Array) -> Hypotheses:
    """Merge each run that starts at `heads` into one hypothesis, with the labels of the heaviest, its first."""
    run = _runs(heads, len(b.pack))
    top = b.log_weight[heads]
    # relative to the heaviest, so that a single hypothesis is unchanged to the last digit
    weight = np.exp(b.log_weight - top[run])
    total = np.add.reduceat(weight, heads)
    share = weight / total[run]
    mean = np.add.reduceat(share[:, None] * b.mean, heads)
    deviation = b.mean - mean[run]
    second_moment = b.cov + deviation[:, :, None] * deviation[:, None, :]
    cov = np.add.reduceat(share[:, None, None] * second_moment, heads)
    return b.at(heads)._replace(log_weight=top + np.log(total), mean=mean, cov=cov)


def apply_log(b: Hypotheses, flight: Observation, settings: Settings) -> Hypotheses:
    """Apply an entry of the log to each hypothesis: the core it names is new or washed, unless it already was."""
    due, recent = flight.log_due > 0, b.since <= LATE_FLIGHTS
    acts, missing = due & ~recent, b.unlogged & (b.since == LATE_FLIGHTS + 1) & (flight.log_kept > 0)
    weight = b.log_weight + np.where(acts, np.log(LOG_LATE), 0.0) + np.where(missing, np.log(NEVER_LOGGED), 0.0)
    b = b._replace(log_weight=weight, unlogged=b.unlogged & ~due & ~missing)
    if not acts.any():
        return b
    washed = _washed(b.at(acts & (flight.log_due == WASHED)), WASH_LEAVES, WASH_LEAVES_SD, settings)
    return join([b.at(~acts), washed, *_renewed(b.at(acts & (flight.log_due == REPLACED)), settings)])


def branch_on_surprise(
    b: Hypotheses, residual: Array, surprised: Array, logged: Array, settings: Settings
) -> list[Hypotheses]:
    """Branch for a surprising flight, or for one on whose day the log names a wash or a new core."""
    is_below, is_above = surprised & (residual < 0.0), surprised & (residual > 0.0)
    is_renewal, is_wash = logged == REPLACED, logged == WASHED
    is_unlogged = is_above & (logged == NOTHING)
    return [
        *(_chance(child, RENEWAL_LOGGED * LOG_LATE) for child in _renewed(b.at(is_renewal), settings)),
        _chance(_washed(b.at(is_wash), WASH_LEAVES, WASH_LEAVES_SD, settings), RENEWAL_LOGGED * LOG_LATE),
        *(
            _chance(child._replace(unlogged=child.pack >= 0), RENEWAL_UNLOGGED)
            for child in _renewed(b.at(is_unlogged), settings)
        ),
        _chance(_washed(b.at(is_unlogged), RECOVERY_LEAVES, RECOVERY_LEAVES_SD, settings), CHANCE["recovery"]),
        _chance(_worn(b.at(is_below), DEPOSIT, DEPOSIT_SD), CHANCE["deposit"]),
        _chance(_worn(b.at(is_below), *settings.clog), CHANCE["clog"]),
        _chance(_faulty(b.at(surprised & ~b.faulty)), settings.fault_chance),
        _chance(_sound(b.at(surprised & b.faulty)), CHANCE["fault_over"]),
    ]


def _chance(b: Hypotheses, chance: float) -> Hypotheses:
    return b._replace(log_weight=b.log_weight + np.log(chance))


def _renewed(b: Hypotheses, settings: Settings) -> list[Hypotheses]:
    """Another unit, at each pace; the pack's sensors stay."""
    children = []
    for j, pace in enumerate(settings.paces):
        mean, cov = b.mean.copy(), b.cov.copy()
        for i in (WEAR, RATE, UNIT):
            cov[:, i, :] = cov[:, :, i] = 0.0
        mean[:, WEAR], cov[:, WEAR, WEAR] = RENEWED_WEAR, RENEWED_SD**2
        mean[:, RATE], cov[:, RATE, RATE] = pace.rate, pace.rate_sd**2
        mean[:, UNIT], cov[:, UNIT, UNIT] = 0.0, settings.unit_sd**2
        child = b._replace(mean=mean, cov=cov, pace=np.full_like(b.pace, j), since=np.zeros_like(b.since))
        child = child._replace(retention=b.retention * [0.0, 0.0, 1.0, 0.0, 1.0])
        children.append(_chance(child, pace.share))
    return children


def _washed(b: Hypotheses, share: float, share_sd: float, settings: Settings) -> Hypotheses:
    """Keep part of the wear on the same unit, which may then wear at another rate."""
    retention = np.array([share, 1.0, 1.0, 1.0, 1.0])
    mean, cov = b.mean * retention, b.cov * retention[:, None] * retention
    cov[:, WEAR, WEAR] += share_sd**2 * (b.mean[:, WEAR] ** 2 + b.cov[:, WEAR, WEAR])
    cov[:, RATE, RATE] += np.array([pace.rate_sd for pace in settings.paces])[b.pace] ** 2
    return b._replace(mean=mean, cov=cov, since=np.zeros_like(b.since), retention=b.retention * retention)


def _worn(b: Hypotheses, step: float, step_sd: float) -> Hypotheses:
    """Add a sudden deposit or clog."""
    mean, cov = b.mean.copy(), b.cov.copy()
    mean[:, WEAR] += step
    cov[:, WEAR, WEAR] += step_sd**2
    return b._replace(mean=mean, cov=cov)


def _faulty(b: Hypotheses) -> Hypotheses:
    """Door or sensor adds something that is not the core's, while it lasts."""
    cov = b.cov.copy()
    cov[:, OTHER, OTHER] += FAULT_SD**2
    return b._replace(cov=cov, faulty=np.ones_like(b.faulty))


def _sound(b: Hypotheses) -> Hypotheses:
    """End the fault."""
    mean, cov = b.mean.copy(), b.cov.copy()
    mean[:, OTHER] = 0.0
    cov[:, OTHER, :] = cov[:, :, OTHER] = 0.0
    cov[:, OTHER, OTHER] = MAP_SD**2
    return b._replace(
        mean=mean, cov=cov, faulty=np.zeros_like(b.faulty), retention=b.retention * [1.0, 1.0, 1.0, 1.0, 0.0]
    )
