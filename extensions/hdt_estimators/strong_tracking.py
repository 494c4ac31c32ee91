"""Strong tracking filter, and modified Bayes classification of faults from its path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.kalman_step import Correction
from hdt_core.estimation.problem import Array, Belief, Problem
from hdt_estimators.fading import Factor, fading_estimate, windowed_change


@dataclass(frozen=True, slots=True)
class StrongTracking:
    r"""Extended Kalman filter that raises its gain when innovations exceed their expected size.

    .. math:: \lambda_i = \max\left(1, \frac{\mathrm{tr}(V_i - \beta R)}{\mathrm{tr}(H P H^T)}\right)

    with V the innovations' own covariance times the running ratio of their square to it, so that a guess known to be
    wrong raises no alarm. A parameter that jumps is followed within a few samples; between
    jumps the filter is the plain one.

    Parameters
    ----------
    memory : float
        Weight of the past in V, per sample.
    softening : float
        beta: how many times the noise the innovations may have before the gain opens.
    passes : int
        At most, after the first, where the gain stays closed; where it opened, what was followed is `approximate`.

    References
    ----------
    .. [1] D. H. Zhou and P. M. Frank, Strong tracking filtering of nonlinear time-varying stochastic systems with
       coloured noise, Int. J. Control 65(2), 1996.
    """

    name: str = "strong_tracking"
    memory: float = 0.98
    softening: float = 1.8
    passes: int = 20

    def estimate(self, problem: Problem) -> Estimate:
        """Return the estimate after the last sample and the path of all."""

        def new_factor() -> Factor:
            running: list[float] = []

            def factor(correction: Correction, belief: Belief) -> float:
                own = float(np.trace(correction.slope @ belief.cov @ correction.slope.T))
                noise = float(np.trace(correction.noise))
                now = float(correction.innovation @ correction.innovation) / (own + noise)
                before = running[-1] if running else 1.0  # nothing suspicious has been seen yet
                running.append(self.memory * before + (1.0 - self.memory) * now)
                excess = running[-1] * (own + noise) - self.softening * noise
                return max(1.0, min(excess / own, 1e6)) if own > 0.0 else 1.0

            return factor

        return fading_estimate(problem, new_factor, method=self.name, own_objective=False, passes=self.passes)


@dataclass(frozen=True, slots=True)
class Classification:
    """Probability (k, n), after each sample, that a parameter has left its nominal value."""

    names: tuple[str, ...]
    probability: Array

    def first(self, level: float = 0.95) -> dict[str, int | None]:
        """Return the sample at which each parameter's probability first exceeded `level`; None where it never did."""
        passed = self.probability > level
        hits = [int(np.argmax(column)) if column.any() else None for column in passed.T]
        return dict(zip(self.names, hits, strict=True))


def classify(
    names: tuple[str, ...], estimate: Estimate, nominal: Belief, *, window: int = 30, prior_probability: float = 0.01
) -> Classification:
    r"""Classify every parameter as nominal or shifted from the last `window` estimates of a path.

    The windowed estimates are summed up as N(m, s2), where s2 counts the filter's own variance. Nominal is N(m0,
    s02) widened by the same variance; shifted is N(m, s2) itself. The Bayes factor of a window that is worth one
    independent estimate is

    .. math:: \ln B = \tfrac12\left[\frac{(m - m_0)^2 + s^2}{s_0^2} - \ln\frac{s^2}{s_0^2} - 1\right]

    Parameters
    ----------
    estimate : Estimate
        With a path, from a recursive method.
    nominal : Belief
        Values (n,) without a fault, and how far they may scatter.
    window : int
        Samples.
    prior_probability : float
        Of a shift, before the record.

    Raises
    ------
    ValueError
        The estimate has no path.

    Notes
    -----
    After Zhou, Xi and Zhang's modified Bayes algorithm, whose window of estimates compares mean and variance at
    once; the statistic here is the divergence between the two normal distributions.
    """
    if estimate.path is None or estimate.path_sd is None:
        raise ValueError("classification needs the path of a recursive method")
    mean, variance = windowed_change(estimate.path, estimate.path_sd, window)
    reference = np.diag(nominal.cov) + estimate.path_sd**2
    log_odds = 0.5 * (((mean - nominal.mean) ** 2 + variance) / reference - np.log(variance / reference) - 1.0)
    return Classification(names, expit(log_odds + np.log(prior_probability / (1.0 - prior_probability))))
