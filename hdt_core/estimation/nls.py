"""Nonlinear least squares: Levenberg and Marquardt's method with bounds, the method of the paper's calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.conclude import conclude_at, conclude_each
from hdt_core.estimation.descent import Point, descend, descend_each
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.problem import Problem


@dataclass(frozen=True, slots=True)
class NonlinearLeastSquares:
    """Minimum of the weighted sum of squares plus the prior's term, from the prior's mean, inside the bounds.

    Parameters
    ----------
    max_steps : int
        Steps tried, taken or not; the paper's 200.
    """

    name: str = "nls"
    max_steps: int = 200

    def estimate(self, problem: Problem) -> Estimate:
        """Minimise the sum of squares; covariance from the information at that point."""
        if problem.kernels is None or problem.kernels.least_squares is None:
            return conclude_at(problem, descend(problem, problem.origin, self.max_steps), method=self.name)
        prior = problem.prior
        start = (problem.origin, *problem.bounds.T, prior.mean, prior.information)
        point = Point(*problem.kernels.least_squares(*start, self.max_steps))
        return conclude_at(problem, point, method=self.name)

    def estimate_each(self, problem: Problem) -> list[Estimate]:
        """Estimate each problem of a batch, all side by side."""
        origin = np.tile(problem.origin, (problem.n_problems, 1))
        return conclude_each(problem, descend_each(problem, origin, self.max_steps), method=self.name)
