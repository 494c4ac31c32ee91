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

from hdt_core.prognosis.hazard import EDGES, SPANS, at_risk, event_by, position, within_horizon

Array = NDArray[np.float64]

TERMS = ("constant", "near", "level")
_PRIOR_SD = np.array([0.5, 0.3, 0.3])


@dataclass(frozen=True, slots=True)
class Correction:
    """Shift of the hazard's log odds, a linear form in `TERMS`."""

    weights: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __call__(self, hazard: Array, level: Array) -> Array:
        """Corrected hazards, shape (n, SPANS)."""
        span = np.broadcast_to(np.arange(SPANS), hazard.shape)
        shift = _terms(span, level[:, None]) @ np.asarray(self.weights)
        return np.asarray(expit(logit(np.clip(hazard, 1e-7, 1.0 - 1e-7)) + shift))


def learn_correction(
    hazard: Array, level: Array, left: Array, failed: NDArray[np.bool_], life: NDArray[np.int_]
) -> Correction:
    """Correction from a fleet's lives.

    Parameters
    ----------
    hazard : array, shape (n, SPANS)
        Hazards of the base model.
    level : array, shape (n,)
        Loss over its limit.
    left, failed, life : array, shape (n,)
        As in `rows.Rows`.

    Notes
    -----
    Flights of one life repeat each other, so together the rows weigh as much as there are lives: a failure seen from
    every flight of its life is one failure, not two hundred. All rows weigh the same, since lives weighed alike would
    count the short ones too often.
    """
    row, span, hit, exposure = at_risk(left, failed)
    if not hit.any():
        return Correction()
    offset = logit(np.clip(hazard[row, span], 1e-7, 1.0 - 1e-7))
    terms = _terms(span, level[row])
    weight = exposure * np.unique(life).size / life.size

    def cost(w: Array) -> tuple[float, Array]:
        log_odds = offset + terms @ w
        loss = weight @ (np.logaddexp(0.0, log_odds) - hit * log_odds) + 0.5 * np.sum((w / _PRIOR_SD) ** 2)
        return float(loss), terms.T @ (weight * (expit(log_odds) - hit)) + w / _PRIOR_SD**2

    found = minimize(cost, np.zeros(len(TERMS)), jac=True, method="L-BFGS-B")
    return Correction(tuple(float(w) for w in found.x))


def learn_levels(
    by: Array, left: Array, life: NDArray[np.int_], prior: tuple[float, float], prior_lives: float = 10.0
) -> tuple[float, float]:
    """Quantile levels of a 90 % interval: distributional conformal prediction, whole lives exchanged.

    Parameters
    ----------
    by : array, shape (n, SPANS + 1)
        P(event within t) of rows of failed lives of other tails.
    left, life : array, shape (n,)
        Flights until the event; which life a row belongs to.
    prior : tuple of float
        Levels from simulated lives.
    prior_lives : float
        Weight of the prior, in lives.

    References
    ----------
    .. [1] V. Chernozhukov, K. Wuethrich, Y. Zhu, Distributional conformal prediction, PNAS 118 (48), 2021.
    """
    inside = left <= EDGES[-1]
    if not inside.any():
        return prior
    at = position(within_horizon(by[inside]), left[inside])
    lives = np.unique(life[inside]).size
    share = lives / (lives + prior_lives)
    low, high = np.quantile(at, [0.05, 0.95])
    return float((1 - share) * prior[0] + share * low), float((1 - share) * prior[1] + share * high)


def simulated_levels(hazard: Array, left: Array, life: NDArray[np.int_]) -> tuple[float, float]:
    """The same from simulated lives that the model was not trained on."""
    return learn_levels(event_by(hazard), left, life, (0.05, 0.95), prior_lives=0.0)


def _terms(span: NDArray[np.int_], level: Array) -> Array:
    near = np.exp(-EDGES[span + 1] / 50.0)
    return np.stack(np.broadcast_arrays(np.ones(1), near, np.clip(np.nan_to_num(level), 0.0, 1.2) - 0.5), axis=-1)
