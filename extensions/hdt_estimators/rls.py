"""Recursive least squares with a forgetting factor."""

from __future__ import annotations

from dataclasses import dataclass

from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.problem import Problem
from hdt_estimators.fading import Factor, fading_estimate


@dataclass(frozen=True, slots=True)
class RecursiveLeastSquares:
    r"""Least squares over the record with weights that fade into the past by `forgetting` per sample.

    For a model linear in its parameters this is the textbook recursion,

    .. math:: P_i = \tfrac{1}{\lambda}(P_{i-1} - K_i h_i^T P_{i-1});

    elsewhere the model is replaced by its tangent about the running estimate. Forgetting buys the ability to follow
    a parameter that moves, at the price of an error that no longer shrinks: about 1 / (1 - forgetting) samples count.

    With forgetting it minimises this faded sum, not the problem's objective, and `converged` is said of the faded
    sum's optimum.

    Parameters
    ----------
    forgetting : float
        1, the default, forgets nothing: least squares, sample by sample.
    passes : int
        At most, after the first, about the trajectory of the pass before.

    References
    ----------
    .. [1] L. Ljung, System Identification: Theory for the User, 2nd ed., 1999, chapter 11.
    """

    name: str = "rls"
    forgetting: float = 1.0
    passes: int = 20

    def estimate(self, problem: Problem) -> Estimate:
        """Return the estimate after the last sample and the path of all."""

        def factor() -> Factor:
            return lambda _correction, _belief: 1.0 / self.forgetting

        return fading_estimate(
            problem, factor, method=self.name, own_objective=self.forgetting < 1.0, passes=self.passes
        )
