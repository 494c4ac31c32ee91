"""Looking back: the track smoothed along all histories that are left. For reports, never for deciding."""

from collections.abc import Sequence

import numpy as np

from hdt_core.twin.belief import Belief, Passage, joined
from hdt_core.twin.crossing import Array
from hdt_core.twin.histories import wear_summary
from hdt_core.twin.wear import WEAR, transition

LEAST_SD, LEAST_WEIGHT = 1e-4, 1e-300


def looking_back(beliefs: Sequence[Belief], passages: Sequence[Passage]) -> list[tuple[Array, Array]]:
    r"""Mean and standard deviation of ln loss at each flight, from all flights: (packs,) each, packs that still fly.

    Parameters
    ----------
    beliefs, passages : sequence
        After each flight, and how it was come by: of `histories.step`. Packs drop out from the last.

    Notes
    -----
    Each branch back to its parent (Rauch, Tung and Striebel 1965), with its event D, weighed by what is now known of
    where it led; branches of one parent merged by their moments (Kim 1994):

    .. math:: x_{k|N} = x_{k|k} + P_{k|k} (D F)^T P_{k+1|k}^{-1} (x_{k+1|N} - x_{k+1|k})
    """
    smoothed = beliefs[-1]
    told = [wear_summary(smoothed, smoothed.n_packs)]
    for before, passage in zip(beliefs[-2::-1], passages[:0:-1], strict=True):
        led_on = before.of_first(smoothed.n_packs)
        ended = before.at(np.arange(len(led_on.pack), len(before.pack)))
        smoothed = joined([_one_back(led_on, passage, smoothed), ended])
        told.append(wear_summary(smoothed, smoothed.n_packs))
    return told[::-1]


def _one_back(before: Belief, passage: Passage, after: Belief) -> Belief:
    """`before` with what is known of `after`."""
    live = np.flatnonzero(passage.into >= 0)
    branch, child, own = passage.met.at(live), passage.into[live], passage.weight[live]
    weight = np.exp(after.log_weight)[child] * own / np.bincount(child, own)[child]
    here = before.at(branch.parent)
    move = branch.keeps[:, :, None] * transition(here.faulty)
    gain = np.swapaxes(np.linalg.solve(branch.cov, move @ here.cov), 1, 2)
    mean = here.mean + (gain @ (after.mean[child] - branch.mean)[:, :, None])[:, :, 0]
    cov = here.cov + gain @ (after.cov[child] - branch.cov) @ np.swapaxes(gain, 1, 2)
    return _collapsed(before, branch.parent, weight, mean, cov)


def _collapsed(before: Belief, parent: Array, weight: Array, mean: Array, cov: Array) -> Belief:
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
