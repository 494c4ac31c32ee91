"""What a fleet's own lives teach the simulated prior: a correction of hazard and interval, shrunk by how few.

The base model has seen thousands of simulated lives and no real one. A fleet gives a handful. So the base is kept and a
logistic correction of its hazard is fitted with a Gaussian prior about "no correction": maximum a posteriori, which is
the prior at 0 failures and the fleet's own truth at many.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit
from scipy.stats import CensoredData, ecdf

from hdt_core.prognosis.hazard import EDGES, SPANS, at_risk, position

Array = NDArray[np.float64]
Levels = tuple[float, float, float]

TERMS = ("constant", "near", "reserve", "late_odds")
_PRIOR_SD = np.array([0.5, 0.3, 0.5, 0.3])
LATE_AFTER, USUAL_ODDS = 50.0, -3.0
"""Flights after which a fleet may be surer, or less sure, than the base; and log odds that this leaves where they are:
about those of a message in a span of 15 to 50 flights."""
RESERVE = (-0.2, 0.6, 0.2)
"""Lowest and highest reserve that the correction tells apart, and the one in between where it does nothing. ln [-]"""
NOMINAL: Levels = (0.05, 0.5, 0.95)
"""Points of the distribution that are told: 90 % of it, and its middle."""


@dataclass(frozen=True, slots=True)
class HazardCorrection:
    """Shift of the hazard's log odds, a linear form in `TERMS`; one learned when there were fewer has fewer weights."""

    weights: tuple[float, ...] = (0.0,) * len(TERMS)

    def __call__(self, hazard: Array, reserve: Array) -> Array:
        """Corrected hazards, shape (n, SPANS)."""
        span, odds = np.broadcast_to(np.arange(SPANS), hazard.shape), _log_odds(hazard)
        shift = _terms(span, reserve[:, None], odds)[..., : len(self.weights)] @ np.asarray(self.weights)
        return np.asarray(expit(odds + shift))


def learn_correction(
    hazard: Array, reserve: Array, left: Array, failed: NDArray[np.bool_], life: NDArray[np.int_]
) -> HazardCorrection:
    """Correction from a fleet's lives.

    Parameters
    ----------
    hazard : array, shape (n, SPANS)
        Hazards of the base model.
    reserve : array, shape (n,)
        Ln conductance above what one flight in twenty asks. [-]
    left, failed, life : array, shape (n,)
        As in `FeatureRows`.

    Notes
    -----
    Flights of one life repeat each other, so together the rows weigh as much as there are lives: a failure seen from
    every flight of its life is one failure, not two hundred. All rows weigh the same, since lives weighed alike would
    count the short ones too often.

    The weight of `late_odds` is a calibration slope [1]: above 0 where, beyond the next fifty flights, units that the
    base calls sound last longer than it says and those that it calls worn last less long. How steadily units wear, and
    so how far ahead they can be foretold, differs from operation to operation; what is near hangs on the reserve.

    References
    ----------
    .. [1] D. R. Cox, Two further applications of a model for binary regression, Biometrika 45, 1958.
    """
    row, span, hit, exposure = at_risk(left, failed)
    if not hit.any():
        return HazardCorrection()
    offset = _log_odds(hazard[row, span])
    terms = _terms(span, reserve[row], offset)
    weight = exposure * np.unique(life).size / life.size

    def cost(w: Array) -> tuple[float, Array]:
        log_odds = offset + terms @ w
        loss = weight @ (np.logaddexp(0.0, log_odds) - hit * log_odds) + 0.5 * np.sum((w / _PRIOR_SD) ** 2)
        return float(loss), terms.T @ (weight * (expit(log_odds) - hit)) + w / _PRIOR_SD**2

    def curvature(w: Array) -> Array:
        chance = expit(offset + terms @ w)
        return np.asarray((terms.T * (weight * chance * (1.0 - chance))) @ terms + np.diag(_PRIOR_SD**-2))

    found = minimize(cost, np.zeros(len(TERMS)), jac=True, hess=curvature, method="trust-exact")
    return HazardCorrection(tuple(float(w) for w in found.x))


def learn_levels(
    by: Array,
    left: Array,
    failed: NDArray[np.bool_],
    life: NDArray[np.int_],
    prior: Levels = NOMINAL,
    prior_lives: float = 20.0,
    nominal: Levels = NOMINAL,
) -> Levels:
    """Quantile levels at which the distribution is told: distributional conformal prediction with censored lives.

    Parameters
    ----------
    by : array, shape (n, SPANS + 1)
        P(event within t) of rows of other tails.
    left, failed, life : array, shape (n,)
        Flights until the event or until the life was cut; whether it ended in the event; which life a row belongs to.
    prior : tuple of float
        Levels from simulated lives.
    prior_lives : float
        Weight of the prior, in failed lives.
    nominal : tuple of float
        Levels that are wanted: lower, middle and upper point.

    Notes
    -----
    The probability that the event has come by its time is uniform where the distribution is right. Of a life that was
    cut it is known to be larger than at the cut; the Kaplan-Meier estimate [2] of its distribution takes both.

    References
    ----------
    .. [1] V. Chernozhukov, K. Wuethrich, Y. Zhu, Distributional conformal prediction, PNAS 118 (48), 2021.
    .. [2] E. L. Kaplan, P. Meier, Nonparametric estimation from incomplete observations, JASA 53, 1958.
    """
    within = failed & (left <= EDGES[-1])
    if not within.any():
        return prior
    at = np.clip(position(by, np.minimum(left, EDGES[-1])), 1e-9, 1.0)
    alive = ecdf(CensoredData.right_censored(at, ~within)).sf
    lives = np.unique(life[within]).size
    share = lives / (lives + prior_lives)
    reached = np.append(1.0 - alive.probabilities, 1.0)
    own = [float(np.append(alive.quantiles, 1.0)[np.searchsorted(reached, level)]) for level in nominal]
    low, middle, high = ((1.0 - share) * p + share * o for p, o in zip(prior, own, strict=True))
    return low, middle, high


def _log_odds(hazard: Array) -> Array:
    return np.asarray(logit(np.clip(hazard, 1e-7, 1.0 - 1e-7)))


def _terms(span: NDArray[np.int_], reserve: Array, odds: Array) -> Array:
    near = np.exp(-EDGES[span + 1] / 50.0)
    low, high, zero = RESERVE
    known = np.clip(np.nan_to_num(reserve, nan=zero), low, high) - zero
    late = np.where(EDGES[span + 1] > LATE_AFTER, odds - USUAL_ODDS, 0.0)
    return np.stack(np.broadcast_arrays(np.ones(1), near, known, late), axis=-1)
