"""Filter and smoother in segments of flights, so that a night goes on from a checkpoint.

Flights of many packs are a panel: side by side, the k-th of each together. A checkpoint holds the hypotheses with which
a segment begins. Smoothing reaches to the end of the next segment and no further: a smoothed value is final once that
has been flown, and a night need not go over all of the past.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.special import erfcx

from hdt_core.calibration.arrays import Array
from hdt_core.records.keys import split_packs
from hdt_core.records.unit_index import RENEWALS, log_flags, log_kept
from hdt_core.tracking.multiple_model_filter import Branching, Hypotheses, join, start, step
from hdt_core.tracking.wear_model import WEAR, Observation, Settings

SEGMENT_FLIGHTS = 50
"""Flights in a segment. Smoothing over the 50 to 100 flights ahead is as good as over all 200 (rms error 0.0322 both,
filtered 0.0343, on the sample fleet)."""
SIDE_BY_SIDE = 64
"""Packs that advance together: two segments of their hypotheses are kept, some 15 kB a flight."""

Checkpoints = Mapping[tuple[int, int], Hypotheses]
"""By pack's number and segment, the hypotheses with which it begins."""
LEAST_SD, LEAST_WEIGHT = 1e-4, 1e-300


class FlightPanel(NamedTuple):
    """Flights of all packs side by side, (flights, packs); `row` is the row in the frame, -1 where a pack has no
    more."""

    row: Array
    observations: Observation

    @property
    def n_rows(self) -> int:
        """Rows of the frame."""
        return int((self.row >= 0).sum())

    @property
    def flights(self) -> Array:
        """Number of flights of each pack. (packs,)"""
        return np.asarray((self.row >= 0).sum(axis=0))


def lay_out(
    flights: pl.DataFrame,
    observations: tuple[Array, Array, Array],
    maintenance: pl.DataFrame,
    component: str,
    actions: Sequence[str] = RENEWALS,
    unchecked: Array | None = None,
) -> FlightPanel:
    """Lay out ratio, variance and exposure of each row of `flights` (in order), and the log of a component.

    Without `unchecked` no sensor is redundant.
    """
    packs = split_packs(flights)
    index = np.full((max(map(len, packs)), len(packs) if flights.height else 0), -1)
    for pack, rows in enumerate(packs):
        index[: len(rows), pack : pack + 1] = rows[:, None]
    log = (*log_flags(flights, maintenance, component, actions), log_kept(flights, maintenance))
    share = np.ones(flights.height) if unchecked is None else unchecked
    columns = zip((*observations, *log, share), (np.nan, 1.0, 1.0, 0, 0, 0, 1.0), strict=True)
    return FlightPanel(
        index, Observation(*(np.where(index >= 0, values[np.maximum(index, 0)], empty) for values, empty in columns))
    )


def smooth(
    filtered: Sequence[Hypotheses], branchings: Sequence[Branching], *, truncated: bool = True
) -> list[tuple[Array, Array]]:
    r"""Smooth: mean and sd of ln loss at each flight, from all flights, (packs,) each, of packs that still fly.

    Parameters
    ----------
    filtered, branchings : sequence
        Hypotheses after each flight, and how the flight branched them: of `multiple_model_filter.step`. Packs drop out
        from the last.
    truncated : bool
        Of `Settings`.

    Notes
    -----
    Each branch goes back to its parent (Rauch, Tung and Striebel 1965), with its event D, weighted by the smoothed
    probability of the row it went into; branches of one parent merge by their moments (Kim 1994):

    .. math:: x_{k|N} = x_{k|k} + P_{k|k} (D F)^T P_{k+1|k}^{-1} (x_{k+1|N} - x_{k+1|k})
    """
    smoothed = filtered[-1]
    summaries = [wear_summary(smoothed, smoothed.n_packs, truncated=truncated)]
    for earlier, branching in zip(filtered[-2::-1], branchings[:0:-1], strict=True):
        continuing = earlier.of_first(smoothed.n_packs)
        ends_here = earlier.at(np.arange(len(continuing.pack), len(earlier.pack)))
        smoothed = join([_smooth_back(continuing, branching, smoothed), ends_here])
        summaries.append(wear_summary(smoothed, smoothed.n_packs, truncated=truncated))
    return summaries[::-1]


def _smooth_back(earlier: Hypotheses, branching: Branching, later: Hypotheses) -> Hypotheses:
    """Smooth `earlier` by `later`, one flight after it."""
    parent = branching.parent
    child = branching.child
    gain = branching.gain
    weight = np.exp(later.log_weight)[child] * branching.weight / np.bincount(child, branching.weight)[child]
    mean = earlier.mean[parent] + (gain @ (later.mean[child] - branching.mean)[:, :, None])[:, :, 0]
    cov = earlier.cov[parent] + gain @ (later.cov[child] - branching.cov) @ gain.mT
    return _merge_branches(earlier, parent, weight, mean, cov)


def _merge_branches(earlier: Hypotheses, parent: Array, weight: Array, mean: Array, cov: Array) -> Hypotheses:
    """Merge branches of each parent; a parent without any gets no weight."""
    total = np.zeros(len(earlier.pack))
    np.add.at(total, parent, weight)
    share = weight / np.maximum(total, LEAST_WEIGHT)[parent]
    middle = np.zeros_like(earlier.mean)
    covs = np.zeros_like(earlier.cov)
    np.add.at(middle, parent, share[:, None] * mean)
    deviation = mean - middle[parent]
    np.add.at(covs, parent, share[:, None, None] * (cov + deviation[:, :, None] * deviation[:, None, :]))
    covs[:, WEAR, WEAR] = np.maximum(covs[:, WEAR, WEAR], LEAST_SD**2)
    return earlier._replace(log_weight=np.log(np.maximum(total, LEAST_WEIGHT)), mean=middle, cov=covs)


class SegmentResult(NamedTuple):
    """Filtered and smoothed mean and sd of ln loss, (4, rows), NaN before the restart; checkpoints of the segments."""

    tracks: Array
    checkpoints: dict[tuple[int, int], Hypotheses]


def filter_segments(panel: FlightPanel, settings: Settings, begin: Array, checkpoints: Checkpoints) -> SegmentResult:
    """Filter and smooth each pack from segment `begin` (packs,) on; from its checkpoint where that is not the first."""
    result = SegmentResult(np.full((4, panel.n_rows), np.nan), {})
    remaining = panel.flights - begin * SEGMENT_FLIGHTS
    packs = np.argsort(-remaining, kind="stable")
    for i in range(0, len(packs), SIDE_BY_SIDE):
        _filter_packs(panel, settings, packs[i : i + SIDE_BY_SIDE], begin, checkpoints, result)
    return result


def _filter_packs(
    panel: FlightPanel, settings: Settings, packs: Array, begin: Array, checkpoints: Checkpoints, result: SegmentResult
) -> None:
    """Filter and smooth some packs side by side, those with most flights left first; a pack without any drops out."""
    first = begin[packs] * SEGMENT_FLIGHTS
    remaining = panel.flights[packs] - begin[packs] * SEGMENT_FLIGHTS
    parts = [checkpoints[int(p), int(begin[p])] if begin[p] else start(settings) for p in packs]
    hypotheses = join([part._replace(pack=np.full(len(part.pack), i)) for i, part in enumerate(parts)])
    steps: list[tuple[Hypotheses, Branching]] = []
    for k in range(int(remaining[0]) if len(remaining) else 0):
        n_packs = int((remaining > k).sum())
        hypotheses = hypotheses.of_first(n_packs)
        if k % SEGMENT_FLIGHTS == 0:
            segment = begin[packs] + k // SEGMENT_FLIGHTS
            result.checkpoints.update({(int(packs[i]), int(segment[i])): hypotheses.of(i) for i in range(n_packs)})
        cell = (first[:n_packs] + k, packs[:n_packs])
        hypotheses, branching = step(hypotheses, panel.observations.of(cell), settings)
        steps.append((hypotheses, branching))
        result.tracks[:2, panel.row[cell]] = wear_summary(hypotheses, n_packs, truncated=settings.truncated)
        is_followed = k < SEGMENT_FLIGHTS and remaining[-1] > SEGMENT_FLIGHTS  # then the next segment's window is final
        if k + 1 == remaining[0] or ((k + 1) % SEGMENT_FLIGHTS == 0 and not is_followed):
            window = steps[-(SEGMENT_FLIGHTS + k % SEGMENT_FLIGHTS + 1) :]
            smoothed = smooth(*zip(*window, strict=True), truncated=settings.truncated)
            for flight, (level, sd) in enumerate(smoothed, k + 1 - len(window)):
                result.tracks[2:, panel.row[first[: len(level)] + flight, packs[: len(level)]]] = level, sd
            steps = window


def wear_summary(hypotheses: Hypotheses, n: int, *, truncated: bool = True) -> tuple[Array, Array]:
    """Compute mean and sd of ln loss over the hypotheses of n packs; `truncated` below 0 or not. (n,) each"""
    weight = np.exp(hypotheses.log_weight)
    mean = hypotheses.mean[:, WEAR]
    variance = hypotheses.cov[:, WEAR, WEAR]
    if truncated:
        mean, variance = _above_zero(mean, np.sqrt(variance))
    middle = np.bincount(hypotheses.pack, weight * mean, n)
    variance_of_all = np.bincount(hypotheses.pack, weight * (variance + (mean - middle[hypotheses.pack]) ** 2), n)
    return middle, np.sqrt(variance_of_all)


def _above_zero(mean: Array, sd: Array) -> tuple[Array, Array]:
    """Compute mean and variance of a normal variable truncated below 0."""
    a = np.clip(mean / sd, -30.0, 30.0)
    ratio = np.sqrt(2.0 / np.pi) / erfcx(-a / np.sqrt(2.0))  # inverse Mills ratio
    return np.maximum(mean, -30.0 * sd) + sd * ratio, sd**2 * np.maximum(1.0 - a * ratio - ratio**2, 1e-3)
