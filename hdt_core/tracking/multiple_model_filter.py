"""Multiple-model filter: hypotheses of what has happened to a pack, each a Kalman filter, weighted side by side.

A step in the conductance can be a clog, a new core, a wash, or a fault of door or sensor that will pass; only later
flights decide. So a surprising flight branches the hypothesis, the log and later flights weight the branches, and
causes that they cannot separate leave a wide posterior. The wear of a unit when its records begin is treated likewise.
Hypotheses are flat arrays sorted by pack, so that one pack or a fleet advance by the same code.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
   chapter 11.6.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from hdt_core.calibration.arrays import Array
from hdt_core.estimation.problem import Belief
from hdt_core.records.unit_index import NOTHING, REPLACEMENT, WASH
from hdt_core.tracking.wear_model import (
    MAP_SD,
    OTHER,
    RATE,
    SENSORS,
    UNIT,
    WEAR,
    Observation,
    Settings,
    at_reference,
    innovation,
    predict,
    transition,
    update,
)

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
"""Chance of a new core on a flight without an entry in the log yet, units living some 400 flights
(`margin.first_passage`), and on one it names."""
LATE_FLIGHTS, LOG_LATE, NEVER_LOGGED = 8, 1 / 60, 0.03
"""Flights that an entry may be late; chance of work on the very flight it names, beside that of a step shown before it;
that an entry never comes where a log is kept."""
NOT_DONE = 0.02
"""Chance that work on the log was not done, beside that of work on the very flight it names."""
NOT_NEW_FLIGHTS = 10**6
"""Flights since the renewal of a core that was not new at entry."""
SURPRISE = 2.0
"""Standard deviations at which a flight branches the hypotheses."""


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
        """Copy the hypotheses at `rows`."""
        return Hypotheses(*(values[rows] for values in self))

    def of(self, pack: int) -> "Hypotheses":
        """Copy the hypotheses of one pack."""
        first, last = np.searchsorted(self.pack, [pack, pack + 1])
        return self.at(np.arange(first, last))

    def of_first(self, n: int) -> "Hypotheses":
        """Return the hypotheses of the first n packs, not copied."""
        rows = int(np.searchsorted(self.pack, n))
        return self if rows == len(self.pack) else Hypotheses(*(values[:rows] for values in self))

    @property
    def belief(self) -> Belief:
        """States of all hypotheses."""
        return Belief(self.mean, self.cov)

    @property
    def n_packs(self) -> int:
        """Number of packs, which are numbered without gaps."""
        return int(self.pack[-1]) + 1


class Branching(NamedTuple):
    """Branches of one flight that were kept, for the smoother.

    mean (m, 5), cov (m, 5, 5) each branch before the flight's update, parent (m,) the row it comes from, child (m,) the
    row it was merged into, weight (m,) its probability, gain (m, 5, 5) of the smoother.
    """

    mean: Array
    cov: Array
    parent: Array
    child: Array
    weight: Array
    gain: Array


def start(settings: Settings) -> Hypotheses:
    """Build hypotheses about a pack before any flight: every pace with every wear at entry."""
    pairs = list(product(enumerate(settings.paces), settings.entries))
    n = len(pairs)
    mean = np.zeros((n, 5))
    cov = np.zeros((n, 5, 5))
    weight = np.zeros(n)
    since = np.zeros(n, dtype=np.int64)
    for row, ((_, pace), entry) in enumerate(pairs):
        weight[row] = np.log(pace.share * entry.share)
        mean[row, WEAR], cov[row, WEAR, WEAR] = entry.wear, entry.wear_sd**2
        mean[row, RATE], cov[row, RATE, RATE] = pace.rate, pace.rate_sd**2
        since[row] = 0 if entry.is_new else NOT_NEW_FLIGHTS
    for i, sd in ((SENSORS, settings.sensors_sd), (UNIT, settings.unit_sd), (OTHER, MAP_SD)):
        cov[:, i, i] = sd**2
    return Hypotheses(
        pack=np.zeros(n, dtype=np.int64), log_weight=weight, mean=mean, cov=cov, since=since,
        pace=np.array([i for (i, _), _ in pairs]), unlogged=np.zeros(n, dtype=bool), faulty=np.zeros(n, dtype=bool),
        parent=np.arange(n), retention=np.ones((n, 5)),
    )  # fmt: skip


def join(parts: list[Hypotheses]) -> Hypotheses:
    """Concatenate hypotheses, not sorted."""
    return Hypotheses(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def prune(b: Hypotheses, offset_bin: float = np.inf) -> tuple[Hypotheses, Array]:
    """Drop light hypotheses, merge like ones by their moments, keep the heaviest; return also each row's new row."""
    bins = np.round(b.mean[:, WEAR] / WEAR_BIN)
    heavy = np.flatnonzero(b.log_weight > np.log(LEAST_WEIGHT))
    offset = np.round(b.mean[:, SENSORS] / offset_bin)
    keys = np.stack([b.pack, b.pace, b.faulty, b.unlogged, bins, offset])[:, heavy]
    order = np.lexsort((-b.log_weight[heavy], *keys[::-1]))
    heads = np.flatnonzero(np.r_[True, (np.diff(keys[:, order]) != 0).any(axis=0)])
    few = _merge(b.at(heavy[order]), heads)
    by_weight = np.lexsort((-few.log_weight, few.pack))
    place = np.arange(len(by_weight)) - np.searchsorted(few.pack[by_weight], few.pack[by_weight])
    heaviest = by_weight[place < MOST]
    row_of_run = np.full(len(heads), -1)
    new_row = np.full(len(b.pack), -1)
    row_of_run[heaviest] = np.arange(len(heaviest))
    new_row[heavy[order]] = row_of_run[_runs(heads, len(order))]
    return normalise(few.at(heaviest)), new_row


def normalise(b: Hypotheses) -> Hypotheses:
    """Scale weights to a sum of 1 in each pack; rows sorted by pack."""
    first = np.flatnonzero(np.r_[True, np.diff(b.pack) != 0])
    count = np.diff(np.r_[first, len(b.pack)])
    top = np.repeat(np.maximum.reduceat(b.log_weight, first), count)
    total = np.repeat(np.add.reduceat(np.exp(b.log_weight - top), first), count)
    return b._replace(log_weight=b.log_weight - top - np.log(total))


def _runs(heads: Array, n: int) -> Array:
    """Number the run of each of n rows, runs starting at `heads`. (n,)"""
    return np.repeat(np.arange(len(heads)), np.diff(np.r_[heads, n]))


def _merge(b: Hypotheses, heads: Array) -> Hypotheses:
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
    """Apply an entry of the log to each hypothesis: the core it names is new or washed, unless it already was.

    The work may not have been done: then the core stays as it was, and the flights soon settle which.
    """
    due = flight.log_due > 0
    recent = b.since <= LATE_FLIGHTS
    acts = due & ~recent
    missing = b.unlogged & (b.since == LATE_FLIGHTS + 1) & (flight.log_kept > 0)
    weight = b.log_weight + np.where(acts, np.log(LOG_LATE), 0.0) + np.where(missing, np.log(NEVER_LOGGED), 0.0)
    b = b._replace(log_weight=weight, unlogged=b.unlogged & ~due & ~missing)
    if not acts.any():
        return b
    washes = _wash(b.at(acts & (flight.log_due == WASH)), WASH_LEAVES, WASH_LEAVES_SD, settings)
    not_done = _chance(b.at(acts), NOT_DONE)
    return join([b.at(~acts), not_done, washes, *_renew(b.at(acts & (flight.log_due == REPLACEMENT)), settings)])


def branch_on_surprise(
    b: Hypotheses, residual: Array, is_surprising: Array, log_entry: Array, unchecked: Array, settings: Settings
) -> list[Hypotheses]:
    """Branch for a surprising flight, or for one on whose day the log names a wash or a new core.

    A fault is the less likely the more of the ratio's sensors others vouch for: a step that they do not share is the
    core's.
    """
    is_below = is_surprising & (residual < 0.0)
    is_above = is_surprising & (residual > 0.0)
    may_fault = is_surprising & ~b.faulty
    is_without_entry = is_above & (log_entry == NOTHING)
    fault = _add(b.at(may_fault), OTHER, 0.0, FAULT_SD)
    wash = _wash(b.at(log_entry == WASH), WASH_LEAVES, WASH_LEAVES_SD, settings)
    worked_on = b.at(is_without_entry)
    wash_share = settings.wash_share
    unlogged = [_chance(unit, 1.0 - wash_share) for unit in _renew(worked_on, settings)]
    if wash_share:
        unlogged.append(_chance(_wash(worked_on, WASH_LEAVES, WASH_LEAVES_SD, settings), wash_share))
    return [
        *(_chance(unit, RENEWAL_LOGGED * LOG_LATE) for unit in _renew(b.at(log_entry == REPLACEMENT), settings)),
        _chance(wash, RENEWAL_LOGGED * LOG_LATE),
        *(_chance(u._replace(unlogged=u.pack >= 0), RENEWAL_UNLOGGED) for u in unlogged),
        _chance(_wash(worked_on, RECOVERY_LEAVES, RECOVERY_LEAVES_SD, settings), CHANCE["recovery"]),
        _chance(_add(b.at(is_below), WEAR, DEPOSIT, DEPOSIT_SD), CHANCE["deposit"]),
        _chance(_add(b.at(is_below), WEAR, *settings.clog), CHANCE["clog"]),
        _chance(fault._replace(faulty=np.ones_like(fault.faulty)), settings.fault_chance * unchecked[may_fault]),
        _chance(_end_fault(b.at(is_surprising & b.faulty)), CHANCE["fault_over"]),
    ]


def _chance(b: Hypotheses, chance: Array | float) -> Hypotheses:
    return b._replace(log_weight=b.log_weight + np.log(chance))


def _renew(b: Hypotheses, settings: Settings) -> list[Hypotheses]:
    """Install another unit, at each pace; the pack's sensors stay."""
    branches = []
    for j, pace in enumerate(settings.paces):
        renewed = _reset(
            b, {WEAR: (RENEWED_WEAR, RENEWED_SD), RATE: (pace.rate, pace.rate_sd), UNIT: (0.0, settings.unit_sd)}
        )
        labels = {"pace": np.full_like(b.pace, j), "since": np.zeros_like(b.since)}
        branches.append(_chance(renewed._replace(**labels), pace.share))
    return branches


def _reset(b: Hypotheses, states: dict[int, tuple[float, float]]) -> Hypotheses:
    """Replace some states by a mean and sd that do not depend on what was."""
    mean = b.mean.copy()
    cov = b.cov.copy()
    retention = b.retention.copy()
    for i, (value, sd) in states.items():
        cov[:, i, :] = cov[:, :, i] = retention[:, i] = 0.0
        mean[:, i], cov[:, i, i] = value, sd**2
    return b._replace(mean=mean, cov=cov, retention=retention)


def _wash(b: Hypotheses, share: float, share_sd: float, settings: Settings) -> Hypotheses:
    """Keep part of the wear on the same unit, which may then wear at another rate."""
    retention = np.array([share, 1.0, 1.0, 1.0, 1.0])
    mean = b.mean * retention
    cov = b.cov * retention[:, None] * retention
    cov[:, WEAR, WEAR] += share_sd**2 * (b.mean[:, WEAR] ** 2 + b.cov[:, WEAR, WEAR])
    cov[:, RATE, RATE] += np.array([pace.rate_sd for pace in settings.paces])[b.pace] ** 2
    return b._replace(mean=mean, cov=cov, since=np.zeros_like(b.since), retention=b.retention * retention)


def _add(b: Hypotheses, state: int, step: float, step_sd: float) -> Hypotheses:
    """Add a sudden step: a deposit or clog to the wear, a fault of door or sensor to what is not the core's."""
    mean = b.mean.copy()
    cov = b.cov.copy()
    mean[:, state] += step
    cov[:, state, state] += step_sd**2
    return b._replace(mean=mean, cov=cov)


def _end_fault(b: Hypotheses) -> Hypotheses:
    return _reset(b, {OTHER: (0.0, MAP_SD)})._replace(faulty=np.zeros_like(b.faulty))


def step(hypotheses: Hypotheses, flight: Observation, settings: Settings) -> tuple[Hypotheses, Branching]:
    """Advance all packs by one flight; `flight` holds one entry a pack."""
    wear = np.bincount(hypotheses.pack, np.exp(hypotheses.log_weight) * hypotheses.mean[:, WEAR], len(flight.ratio))
    flight = at_reference(flight, wear)
    since = hypotheses.since + 1
    belief = predict(hypotheses.belief, hypotheses.pace, since, hypotheses.faulty, settings)
    log_weight = hypotheses.log_weight + np.where(hypotheses.faulty, np.log1p(-CHANCE["fault_over"]), 0.0)
    identity = {"parent": np.arange(len(since)), "retention": np.ones_like(belief.mean)}
    prior = hypotheses._replace(mean=belief.mean, cov=belief.cov, since=since, log_weight=log_weight, **identity)
    prior = apply_log(prior, flight.of(hypotheses.pack), settings)
    observations = flight.of(prior.pack)
    residual, variance = innovation(prior.belief, observations, settings.level)
    has_ratio = np.isfinite(observations.ratio)
    is_surprising = has_ratio & (np.abs(residual) > SURPRISE * np.sqrt(variance))
    has_entry = has_ratio & (observations.log_open > 0) & (prior.since > LATE_FLIGHTS)
    branches = prior
    if is_surprising.any() or has_entry.any():
        log_entry = np.where(has_entry, observations.log_open, NOTHING)
        stays = prior._replace(log_weight=prior.log_weight + np.where(has_entry, np.log1p(-RENEWAL_LOGGED), 0.0))
        branches = join(
            [stays, *branch_on_surprise(prior, residual, is_surprising, log_entry, observations.unchecked, settings)]
        )
    branches = branches.at(np.argsort(branches.pack, kind="stable"))
    belief, evidence = update(branches.belief, flight.of(branches.pack), settings.level)
    log_weight = branches.log_weight + evidence
    posterior = normalise(branches._replace(mean=belief.mean, cov=belief.cov, log_weight=log_weight))
    survivors, new_row = prune(posterior, settings.offset_bin)
    return survivors, _branching(hypotheses, branches, np.exp(posterior.log_weight), new_row)


def _branching(parents: Hypotheses, branches: Hypotheses, weight: Array, new_row: Array) -> Branching:
    """Collect what the smoother needs of the branches that were not dropped."""
    live = np.flatnonzero(new_row >= 0)
    branch = branches.at(live)
    move = branch.retention[:, :, None] * transition(parents.faulty[branch.parent])
    gain = np.linalg.solve(branch.cov, move @ parents.cov[branch.parent]).mT
    return Branching(branch.mean, branch.cov, branch.parent, new_row[live], weight[live], gain)
