"""Unscented Kalman filter: states and parameters together, the model replaced by its regression over sigma points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.kalman import kernel_estimate, recursive_estimate
from hdt_core.estimation.kalman_step import Affine, Function, LostTrackError
from hdt_core.estimation.problem import Array, Belief, Problem

if TYPE_CHECKING:
    from filterpy.kalman import MerweScaledSigmaPoints


HAIR = 1e-9  # of the mean: the least spread of sigma points


@dataclass(frozen=True, slots=True)
class UnscentedKalman:
    """Filter, then filter again with regressions over the smoothed beliefs: iterated posterior linearisation.

    Parameters
    ----------
    alpha, beta, kappa : float
        Spread of Merwe's scaled points. The defaults give equal weights, none negative, so that the residual
        covariance stays positive.
    smoother_passes : int
        At most: they end when the estimate settles.
    polish : bool
        Where nothing moves, finish with least squares: the fixed point of a regression is near the optimum, not on it.
    """

    name: str = "ukf"
    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0
    smoother_passes: int = 5
    polish: bool = True

    def estimate(self, problem: Problem) -> Estimate:
        """Estimate the parameters after the last sample; path of the first, causal pass."""
        if (self.alpha, self.beta, self.kappa) == (1.0, 0.0, 0.0):
            quick = kernel_estimate(problem, True, self.smoother_passes, method=self.name, polish=self.polish)
            if quick is not None:
                return quick
        from filterpy.kalman import MerweScaledSigmaPoints  # noqa: PLC0415 (a second of imports that only this needs)

        j = problem.start.mean.size + problem.prior.mean.size
        points = MerweScaledSigmaPoints(j, self.alpha, self.beta, self.kappa, sqrt_method=upper_root)
        return recursive_estimate(
            problem, partial(regression, points), self.smoother_passes, method=self.name, polish=self.polish
        )


def regression(
    points: MerweScaledSigmaPoints, function: Function, belief: Belief, lower: Array, upper: Array
) -> Affine:
    """Fit an affine function with the mean, cross-covariance and covariance of `function` over sigma points.

    Raises
    ------
    LostTrackError
        The belief, or the model over it, is not finite.
    """
    if not (np.isfinite(belief.mean).all() and np.isfinite(belief.cov).all()):
        raise LostTrackError
    breadth = np.square(HAIR * belief.mean)  # sigma points must differ from the mean beyond rounding
    cloud = points.sigma_points(belief.mean, belief.cov + np.diag(breadth)).T
    values = function(np.clip(cloud, lower[:, None], upper[:, None]))
    if not np.isfinite(values).all():
        raise LostTrackError
    mean = values @ points.Wm
    deviation, response = cloud - belief.mean[:, None], values - mean[:, None]
    # pairs of opposite points: their difference over their distance is exact however flat the belief
    j = belief.mean.size
    half = 0.5 * (deviation[:, 1 : j + 1] - deviation[:, j + 1 :])
    slope = np.linalg.solve(half.T, 0.5 * (values[:, 1 : j + 1] - values[:, j + 1 :]).T).T
    residual = response - slope @ deviation
    return Affine(slope, mean - slope @ belief.mean, (residual * points.Wc) @ residual.T)


def upper_root(cov: Array) -> Array:
    """Compute an upper triangular root of a covariance that may be singular, by rounding or by design.

    A covariance without a Cholesky factor gets the least multiple of its own diagonal that gives it one. Directions
    without variance get a tiny one, enough to take a derivative along them.
    """
    size = np.sqrt(np.maximum(np.diag(cov), 0.0))
    size = np.where(size > 0.0, size, 1e-6 * max(float(size.max(initial=0.0)), 1e-6))
    scaled = cov / np.outer(size, size)
    np.fill_diagonal(scaled, 1.0)
    for lift in (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2):
        try:
            lower = np.linalg.cholesky(scaled + lift * np.eye(len(cov)))
        except np.linalg.LinAlgError:
            continue
        return np.asarray((lower * size[:, None]).T)
    return np.diag(size)
