"""Filter and smoother in segments of flights, so that a night goes on from a checkpoint.

A checkpoint holds the hypotheses with which a segment begins. Smoothing reaches to the end of the next segment and no
further: a smoothed value is final once that has been flown, and a night need not go over all of the past.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hdt_core.calibration.arrays import Array
from hdt_core.tracking import multiple_model_filter as mmf
from hdt_core.tracking.flight_panel import FlightPanel
from hdt_core.tracking.hypotheses import Branching, Hypotheses, join
from hdt_core.tracking.multiple_model_filter import wear_summary
from hdt_core.tracking.wear_model import WEAR, Settings, transition

SEGMENT_FLIGHTS = 50
"""Flights in a segment. Smoothing over the 50 to 100 flights ahead is as good as over all 200 (rms error 0.0322 both,
filtered 0.0343, on the sample fleet)."""
SIDE_BY_SIDE = 64
"""Packs that advance together: two segments of their hypotheses are kept, some 15 kB a flight."""

Checkpoints = Mapping[tuple[int, int], Hypotheses]
"""By pack's number and segment, the hypotheses with which it begins."""
LEAST_SD, LEAST_WEIGHT = 1e-4, 1e-300


def smooth(filtered: Sequence[Hypotheses], branchings: Sequence[Branching]) -> list[tuple[Array, Array]]:
    r"""Mean and standard deviation of ln loss at each flight, from all flights: (packs,) each, packs that still fly.

    Parameters
    ----------
    filtered, branchings : sequence
        Hypotheses after each flight, and how the flight branched them: of `multiple_model_filter.step`. Packs drop out
        from the last.

    Notes
    -----
    Each branch back to its parent (Rauch, Tung and Striebel 1965), with its event D, weighed by what is now known of
    where it led; branches of one parent merged by their moments (Kim 1994):

    .. math:: x_{k|N} = x_{k|k} + P_{k|k} (D F)^T P_{k+1|k}^{-1} (x_{k+1|N} - x_{k+1|k})
    """
    smoothed = filtered[-1]
    told = [wear_summary(smoothed, smoothed.n_packs)]
    for before, branching in zip(filtered[-2::-1], branchings[:0:-1], strict=True):
        led_on = before.of_first(smoothed.n_packs)
        ended = before.at(np.arange(len(led_on.pack), len(before.pack)))
        smoothed = join([_one_back(led_on, branching, smoothed), ended])
        told.append(wear_summary(smoothed, smoothed.n_packs))
    return told[::-1]


def _one_back(before: Hypotheses, branching: Branching, after: Hypotheses) -> Hypotheses:
    """`before` with what is known of `after`."""
    live = np.flatnonzero(branching.into >= 0)
    branch, child, own = branching.met.at(live), branching.into[live], branching.weight[live]
    weight = np.exp(after.log_weight)[child] * own / np.bincount(child, own)[child]
    here = before.at(branch.parent)
    move = branch.keeps[:, :, None] * transition(here.faulty)
    gain = np.swapaxes(np.linalg.solve(branch.cov, move @ here.cov), 1, 2)
    mean = here.mean + (gain @ (after.mean[child] - branch.mean)[:, :, None])[:, :, 0]
    cov = here.cov + gain @ (after.cov[child] - branch.cov) @ np.swapaxes(gain, 1, 2)
    return _collapsed(before, branch.parent, weight, mean, cov)


def _collapsed(before: Hypotheses, parent: Array, weight: Array, mean: Array, cov: Array) -> Hypotheses:
    """Branches of each parent in one; a parent without any keeps no weight."""
    total = np.zeros(len(before.pack))
    np.add.at(total, parent, weight)
    share = weight / np.maximum(total, LEAST_WEIGHT)[parent]
    middle, spread = np.zeros_like(before.mean), np.zeros_like(before.cov)
    np.add.at(middle, parent, share[:, None] * mean)
    off = mean - middle[parent]
    np.add.at(spread, parent, share[:, None, None] * (cov + off[:, :, None] * off[:, None, :]))
    spread[:, WEAR, WEAR] = np.maximum(spread[:, WEAR, WEAR], LEAST_SD**2)
    return before._replace(log_weight=np.log(np.maximum(total, LEAST_WEIGHT)), mean=middle, cov=spread)


class SegmentResult(NamedTuple):
    """Filtered and smoothed mean and sd of ln loss, (4, rows), NaN before the restart; checkpoints of the segments."""

    found: Array
    checkpoints: dict[tuple[int, int], Hypotheses]


def filter_segments(
    panel: FlightPanel, settings: Settings, begin: Array, checkpoints: Checkpoints, *, smoothed: bool = True
) -> SegmentResult:
    """Filter and smooth each pack from segment `begin` (packs,) on, where it is not the first from its checkpoint."""
    result = SegmentResult(np.full((4, panel.n_rows), np.nan), {})
    left = panel.flights - begin * SEGMENT_FLIGHTS
    packs = np.argsort(-left, kind="stable")
    for first in range(0, len(packs), SIDE_BY_SIDE):
        _together(panel, settings, packs[first : first + SIDE_BY_SIDE], begin, checkpoints, result, smoothed=smoothed)
    return result


def _together(
    panel: FlightPanel,
    settings: Settings,
    packs: Array,
    begin: Array,
    checkpoints: Checkpoints,
    result: SegmentResult,
    *,
    smoothed: bool,
) -> None:
    """Some packs side by side, those with most flights left first: who has none left drops out at the end."""
    first, left = begin[packs] * SEGMENT_FLIGHTS, panel.flights[packs] - begin[packs] * SEGMENT_FLIGHTS
    hypotheses = _opened(packs, begin, checkpoints, settings)
    steps: list[tuple[Hypotheses, Branching]] = []
    for k in range(int(left[0]) if len(left) else 0):
        flying = int((left > k).sum())
        hypotheses = hypotheses.of_first(flying)
        if k % SEGMENT_FLIGHTS == 0:
            segment = begin[packs] + k // SEGMENT_FLIGHTS
            result.checkpoints.update({(int(packs[i]), int(segment[i])): hypotheses.of(i) for i in range(flying)})
        hypotheses, branching = mmf.step(hypotheses, panel.flight(first[:flying] + k, packs[:flying]), settings)
        steps += [(hypotheses, branching)] if smoothed else []
        row = panel.row[first[:flying] + k, packs[:flying]]
        result.found[:2, row] = mmf.wear_summary(hypotheses, flying)
        if smoothed and ((k + 1) % SEGMENT_FLIGHTS == 0 or k + 1 == left[0]):
            window = steps[-(SEGMENT_FLIGHTS + k % SEGMENT_FLIGHTS + 1) :]
            for back, (level, sd) in enumerate(smooth(*zip(*window, strict=True))):
                at = first[: len(level)] + k + 1 - len(window) + back
                result.found[2:, panel.row[at, packs[: len(level)]]] = level, sd
            steps = window


def _opened(packs: Array, begin: Array, checkpoints: Checkpoints, settings: Settings) -> Hypotheses:
    """Hypotheses with which packs begin, numbered as they stand side by side."""
    parts = [checkpoints[int(p), int(begin[p])] if begin[p] else mmf.start(1, settings) for p in packs]
    return join([part._replace(pack=np.full(len(part.pack), i)) for i, part in enumerate(parts)])
