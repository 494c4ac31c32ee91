"""Extended Kalman filter: states and parameters together, the model replaced by its tangent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.kalman import compiled_estimate, recursive_estimate
from hdt_core.estimation.kalman_step import Affine, Function
from hdt_core.estimation.problem import Array, Belief, Problem


@dataclass(frozen=True, slots=True)
class ExtendedKalman:
    """Filter, then filter again about the smoothed trajectory: the iterated extended Kalman smoother.

    Without a smoother pass the result keeps the errors of early tangents, taken where the guess was wrong.
    Where nothing drifts, one pass is one step of Gauss and Newton.

    Parameters
    ----------
    smoother_passes : int
    """

    name: str = "ekf"
    smoother_passes: int = 1

    def estimate(self, problem: Problem) -> Estimate:
        """Belief about the parameters after the last sample; path of the first, causal pass."""
        quick = compiled_estimate(problem, False, self.smoother_passes)
        return recursive_estimate(problem, tangent, self.smoother_passes) if quick is None else quick


def tangent(function: Function, belief: Belief, lower: Array, upper: Array) -> Affine:
    """Tangent at the mean moved inside the bounds, by central differences, one-sided on a bound."""
    point = np.clip(belief.mean, lower, upper)
    step = np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(point), np.minimum(belief.sd, 1e3) + 1e-6)
    above, below = np.minimum(point + step, upper), np.maximum(point - step, lower)
    ends = np.column_stack([point[:, None] + np.diag(above - point), point[:, None] + np.diag(below - point), point])
    values = function(ends)
    j = point.size
    width = np.where(above > below, above - below, np.inf)
    slope = (values[:, :j] - values[:, j : 2 * j]) / width
    return Affine(slope, values[:, -1] - slope @ point, np.zeros((len(values), len(values))))
