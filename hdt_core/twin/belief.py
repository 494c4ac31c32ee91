"""Beliefs about packs as weighted histories, flat and sorted by pack: joined, thinned, merged."""

from typing import NamedTuple

import numpy as np

from hdt_core.twin.crossing import Array
from hdt_core.twin.wear import WEAR

LEAST_WEIGHT, MOST, WEAR_BIN = 1e-6, 40, 0.01
"""Weight below which a history is dropped, how many a pack may keep, the bin of ln loss in which like ones merge."""


class Belief(NamedTuple):
    """Histories of packs: sorted by `pack`, weights adding up to 1 within each.

    log_weight (m,), mean (m, 5), cov (m, 5, 5); pace (m,) an index of `PACES`, since (m,) flights since the core was
    renewed or washed, unlogged (m,) whether no entry has spoken of that yet, faulty (m,) whether something else than
    the core is wrong. Of the last flight: parent (m,) the row before it, keeps (m, 5) the share of each state that its
    event left.
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
    keeps: Array

    def at(self, rows: Array) -> "Belief":
        """Histories at `rows`, copied."""
        return Belief(*(values[rows] for values in self))

    def of(self, pack: int) -> "Belief":
        """Histories of one pack."""
        first, last = np.searchsorted(self.pack, [pack, pack + 1])
        return self.at(np.arange(first, last))

    def of_first(self, n: int) -> "Belief":
        """Histories of the first n packs, not copied."""
        rows = int(np.searchsorted(self.pack, n))
        return self if rows == len(self.pack) else Belief(*(values[:rows] for values in self))

    @property
    def n_packs(self) -> int:
        """How many packs there are, numbered without gaps."""
        return int(self.pack[-1]) + 1


class Passage(NamedTuple):
    """How one flight led from histories to histories, for looking back.

    Each row is a branch: parent (m,) its row before, into (m,) the row it went into, -1 where it was dropped, weight
    (m,) its probability, met (m, ...) its state before the flight's news.
    """

    met: Belief
    into: Array
    weight: Array


def joined(parts: list[Belief]) -> Belief:
    """One belief of several; not sorted."""
    return Belief(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def thinned(b: Belief) -> tuple[Belief, Array]:
    """Light histories dropped, like ones merged by their moments, the heaviest kept; and where each row went."""
    bins = np.round(b.mean[:, WEAR] / WEAR_BIN)
    heavy = np.flatnonzero(b.log_weight > np.log(LEAST_WEIGHT))
    keys = np.stack([b.pack, b.pace, b.faulty, b.unlogged, bins])[:, heavy]
    order = np.lexsort((-b.log_weight[heavy], *keys[::-1]))
    heads = np.flatnonzero(np.r_[True, (np.diff(keys[:, order]) != 0).any(axis=0)])
    merged = _merged(b.at(heavy[order]), heads)
    ranked = np.lexsort((-merged.log_weight, merged.pack))
    place = np.arange(len(ranked)) - np.searchsorted(merged.pack[ranked], merged.pack[ranked])
    kept = ranked[place < MOST]
    new_row, into = np.full(len(heads), -1), np.full(len(b.pack), -1)
    new_row[kept] = np.arange(len(kept))
    into[heavy[order]] = new_row[_runs(heads, len(order))]
    return normalised(merged.at(kept)), into


def normalised(b: Belief) -> Belief:
    """Weights that add up to 1 in each pack; rows sorted by pack."""
    first = np.flatnonzero(np.r_[True, np.diff(b.pack) != 0])
    count = np.diff(np.r_[first, len(b.pack)])
    top = np.repeat(np.maximum.reduceat(b.log_weight, first), count)
    total = np.repeat(np.add.reduceat(np.exp(b.log_weight - top), first), count)
    return b._replace(log_weight=b.log_weight - top - np.log(total))


def _runs(heads: Array, n: int) -> Array:
    """Which run each of n rows belongs to, runs starting at `heads`."""
    return np.repeat(np.arange(len(heads)), np.diff(np.r_[heads, n]))


def _merged(b: Belief, heads: Array) -> Belief:
    """One history for each run that starts at `heads`; labels are those of the heaviest, which stands first."""
    run = _runs(heads, len(b.pack))
    top = b.log_weight[heads]
    # against the heaviest: a history that stands alone stays what it was to the last digit, whoever else is there
    weight = np.exp(b.log_weight - top[run])
    total = np.add.reduceat(weight, heads)
    share = weight / total[run]
    mean = np.add.reduceat(share[:, None] * b.mean, heads)
    off = b.mean - mean[run]
    spread = b.cov + off[:, :, None] * off[:, None, :]
    cov = np.add.reduceat(share[:, None, None] * spread, heads)
    return b.at(heads)._replace(log_weight=top + np.log(total), mean=mean, cov=cov)
