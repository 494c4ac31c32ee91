"""Extended Kalman filter: states and parameters together, the model replaced by its tangent."""

from __future__ import annotations

from dataclasses import dataclass

from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.kalman import kernel_estimate, recursive_estimate
from hdt_core.estimation.kalman_step import tangent
from hdt_core.estimation.problem import Problem


@dataclass(frozen=True, slots=True)
class ExtendedKalman:
    """Filter, then filter again about the smoothed trajectory: the iterated extended Kalman smoother.

    Without a smoother pass the result keeps the errors of early tangents, taken where the guess was wrong.
    Where nothing drifts, one pass is one step of Gauss and Newton, shortened where it would raise the objective.

    Parameters
    ----------
    smoother_passes : int
        At most: they end when the estimate settles. With none the causal filter's own answer is reported.

    References
    ----------
    .. [1] S. Särkkä and L. Svensson, Levenberg-Marquardt and line-search extended Kalman smoothers, ICASSP 2020.
    """

    name: str = "ekf"
    smoother_passes: int = 20

    def estimate(self, problem: Problem) -> Estimate:
        """Estimate the parameters after the last sample; path of the first, causal pass."""
        quick = kernel_estimate(problem, False, self.smoother_passes, method=self.name)
        if quick is not None:
            return quick
        return recursive_estimate(problem, tangent, self.smoother_passes, method=self.name)
