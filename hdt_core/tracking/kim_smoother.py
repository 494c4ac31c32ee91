"""Kim's smoother: the track smoothed along all hypotheses that are left. For reports, never for deciding."""

from collections.abc import Sequence

import numpy as np

from hdt_core.calibration.arrays import Array
from hdt_core.tracking.hypotheses import Branching, Hypotheses, join
from hdt_core.tracking.multiple_model_filter import wear_summary
from hdt_core.tracking.wear_model import WEAR, transition

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
