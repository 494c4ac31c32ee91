"""Learn from a fleet's own lives: the rule of its message, and with shrinkage a correction of the simulated prior's
hazard and interval.

The base model is fitted to thousands of simulated lives, and a fleet has few. A logistic correction of the base's
hazard is fitted with a Gaussian prior about no correction: maximum a posteriori, the prior at 0 failures and the
fleet's own hazard at many.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.special import expit, logit

from hdt_core.margin.exchanger_demand import SHARES
from hdt_core.margin.first_passage import repeated_demand
from hdt_core.margin.margin import PRIOR_RULE, MessageRule
from hdt_core.prognosis.hazard import EDGES, SPANS, at_risk, position
from hdt_core.robust import Array

EXCESS_K = np.arange(1.0, 16.0)
PERSISTENCE = (1, 2, 3)
NEAR_FLIGHTS = 3
PERSISTENCE_PRIOR = {1: 0.25, 2: 0.25, 3: 0.5}
"""Fault messages are latched by persistence, commonly two occurrences: ARINC 624, section 3."""
EXACT, NEAR, MISS, SPURIOUS = 0.5, 0.12, 0.03, 0.08
"""Likelihood of a life whose rule was met on the flight of its message, within `NEAR_FLIGHTS`, never or long before;
and of a life without a message whose rule was met."""
CROSS_WEIGHT = 0.5
"""Weight of other operators' messages: one type, other settings of its monitor."""
RULES = tuple(product(SHARES, PERSISTENCE, EXCESS_K.tolist()))
"""Share of the high samples, flights of which two must be hot, excess [K]."""
Levels = tuple[float, float, float]

TERMS = ("constant", "near", "reserve", "late_odds")
_PRIOR_SD = np.array([0.5, 0.3, 0.5, 0.3])
LATE_AFTER, USUAL_ODDS = 50.0, -3.0
"""Flights after which the term `late_odds` applies, and log odds that it leaves unchanged: about those of a message in
a span of 15 to 50 flights."""
RESERVE = (-0.2, 0.6, 0.2)
"""Lowest and highest reserve that the correction distinguishes, and the reserve at which its term is 0. ln [-]"""
NOMINAL: Levels = (0.05, 0.5, 0.95)
"""Reported quantiles: a 90 % interval and the median."""


def rule_onsets(overheat_k: Sequence[Array]) -> Array:
    """Find the first flight of each life on which each of `RULES` is met, -1 where it never is. (lives, rules)

    Parameters
    ----------
    overheat_k : sequence of array
        For each of `SHARES` how far that share of the high samples lay above its level, (lives, flights), NaN where
        unknown. [K]
    """
    columns = []
    for hot, of in product(map(np.nan_to_num, overheat_k), PERSISTENCE):
        highest = np.fmax.accumulate(repeated_demand(hot, of), axis=1)
        onset = np.stack([(~(highest > excess)).sum(axis=1) for excess in EXCESS_K], axis=1)
        columns.append(np.where(onset < hot.shape[1], onset, -1))
    return np.concatenate(columns, axis=1)


def learn_rules(onset: Array, message: Array, operator: Array) -> dict[str, MessageRule]:
    """Compute the posterior of each operator's rule, and under `""` that of an operator without messages.

    An operator without a single message may send none, so its lives are not used.

    Parameters
    ----------
    onset : array of int, shape (lives, rules)
        From `rule_onsets`.
    message : array of int, shape (lives,)
        Flight of the life's message, -1 for none.
    operator : array of str, shape (lives,)
        Operator of each life.
    """
    fits = _fit(onset, message[:, None])
    prior = np.array(
        [
            np.log(PERSISTENCE_PRIOR[of]) - 0.5 * ((e - PRIOR_RULE.excess_k) / PRIOR_RULE.excess_sd_k) ** 2
            for _, of, e in RULES
        ]
    )
    fits *= np.isin(operator, np.unique(operator[message >= 0]))[:, None]
    out = {}
    for name in ("", *np.unique(operator)):
        weight = np.where(operator == name, 1.0, CROSS_WEIGHT) if name else np.full(operator.size, CROSS_WEIGHT)
        n_messages = int((message >= 0)[operator == name].sum()) if name else int((message >= 0).sum())
        out[str(name)] = _summary(prior + weight @ fits, n_messages)
    return out


def _summary(log_posterior: Array, messages: int) -> MessageRule:
    """Return the most probable share and persistence, and mean and sd of the excess given these."""
    chance = np.exp(log_posterior - log_posterior.max())
    kinds = sorted({(share, of) for share, of, _ in RULES})
    mass = [sum(c for c, (s, of, _) in zip(chance, RULES, strict=True) if (s, of) == kind) for kind in kinds]
    share, of = kinds[int(np.argmax(mass))]
    in_mode = np.array([(s, o) == (share, of) for s, o, _ in RULES])
    excess = np.array([e for *_, e in RULES])[in_mode]
    weight = chance[in_mode] / chance[in_mode].sum()
    mean = float(weight @ excess)
    # half a step of the grid adds to the sd
    sd = float(np.sqrt(weight @ (excess - mean) ** 2 + 0.5**2))
    return MessageRule(share, mean, sd, of, messages)


def _fit(onset: Array, message: Array) -> Array:
    """Compute the log likelihood of each life under each rule."""
    distance = np.abs(onset - message)
    likelihood = np.where(distance == 0, EXACT, np.where(distance <= NEAR_FLIGHTS, NEAR, MISS))
    failed = np.where(onset < 0, MISS, likelihood)
    return np.log(np.where(message >= 0, failed, np.where(onset >= 0, SPURIOUS, 1.0 - SPURIOUS)))


@dataclass(frozen=True, slots=True)
class HazardCorrection:
    """Shift of the hazard's log odds, linear in `TERMS`; one fitted when there were fewer terms has fewer weights."""

    weights: tuple[float, ...] = (0.0,) * len(TERMS)

    def __call__(self, hazard: Array, reserve: Array) -> Array:
        """Return corrected hazards, shape (n, SPANS)."""
        span = np.broadcast_to(np.arange(SPANS), hazard.shape)
        odds = _log_odds(hazard)
        shift = _terms(span, reserve[:, None], odds)[..., : len(self.weights)] @ np.asarray(self.weights)
        return np.asarray(expit(odds + shift))


def learn_correction(hazard: Array, reserve: Array, remaining: Array, failed: Array, life: Array) -> HazardCorrection:
    """Fit a correction to a fleet's lives.

    Parameters
    ----------
    hazard : array, shape (n, SPANS)
        Hazards of the base model.
    reserve : array, shape (n,)
        Ln conductance above the demand of one flight in twenty. [-]
    remaining, failed, life : array, shape (n,)
        As in `FeatureRows`.

    Notes
    -----
    Flights of one life repeat each other, so together the rows weigh as much as there are lives: a failure seen from
    every flight of its life is one failure, not two hundred. All rows weigh the same, since lives weighed alike would
    count the short ones too often.

    The weight of `late_odds` is a calibration slope [1]: above 0 where, beyond the next fifty flights, units with a low
    predicted hazard last longer than predicted and those with a high one less long. How steadily units wear differs
    from operation to operation; the near hazard depends on the reserve.

    References
    ----------
    .. [1] D. R. Cox, Two further applications of a model for binary regression, Biometrika 45, 1958.
    """
    from scipy.optimize import minimize  # noqa: PLC0415 (loads for a fifth of a second, and few nights learn)

    row, span, is_event, exposure = at_risk(remaining, failed)
    if not is_event.any():
        return HazardCorrection()
    offset = _log_odds(hazard[row, span])
    terms = _terms(span, reserve[row], offset)
    weight = exposure * np.unique(life).size / life.size

    def cost(w: Array) -> tuple[float, Array]:
        log_odds = offset + terms @ w
        loss = weight @ (np.logaddexp(0.0, log_odds) - is_event * log_odds) + 0.5 * np.sum((w / _PRIOR_SD) ** 2)
        return float(loss), terms.T @ (weight * (expit(log_odds) - is_event)) + w / _PRIOR_SD**2

    def curvature(w: Array) -> Array:
        chance = expit(offset + terms @ w)
        return np.asarray((terms.T * (weight * chance * (1.0 - chance))) @ terms + np.diag(_PRIOR_SD**-2))

    solution = minimize(cost, np.zeros(len(TERMS)), jac=True, hess=curvature, method="trust-exact")
    return HazardCorrection(tuple(float(w) for w in solution.x))


def learn_levels(
    by: Array,
    remaining: Array,
    failed: Array,
    life: Array,
    prior: Levels = NOMINAL,
    prior_lives: float = 20.0,
    nominal: Levels = NOMINAL,
) -> Levels:
    """Estimate the levels of the reported quantiles: distributional conformal prediction with censored lives.

    Parameters
    ----------
    by : array, shape (n, SPANS + 1)
        P(event within t) of rows of other tails.
    remaining, failed, life : array, shape (n,)
        Flights until the event or until the life was cut; whether it ended in the event; which life a row belongs to.
    prior : tuple of float
        Levels from simulated lives.
    prior_lives : float
        Weight of the prior, in failed lives.
    nominal : tuple of float
        Nominal levels: lower, middle and upper point.

    Notes
    -----
    The probability that the event has come by its time is uniform where the distribution is right. Of a life that was
    cut it is known to be larger than at the cut; the Kaplan-Meier estimate [2] of its distribution takes both.

    References
    ----------
    .. [1] V. Chernozhukov, K. Wuethrich, Y. Zhu, Distributional conformal prediction, PNAS 118 (48), 2021.
    .. [2] E. L. Kaplan, P. Meier, Nonparametric estimation from incomplete observations, JASA 53, 1958.
    """
    from scipy.stats import CensoredData, ecdf  # noqa: PLC0415 (loads for half a second, and few nights learn)

    is_observed = failed & (remaining <= EDGES[-1])
    if not is_observed.any():
        return prior
    at = np.clip(position(by, np.minimum(remaining, EDGES[-1])), 1e-9, 1.0)
    alive = ecdf(CensoredData.right_censored(at, ~is_observed)).sf
    lives = np.unique(life[is_observed]).size
    share = lives / (lives + prior_lives)
    cumulative = np.append(1.0 - alive.probabilities, 1.0)
    fleet_levels = [float(np.append(alive.quantiles, 1.0)[np.searchsorted(cumulative, level)]) for level in nominal]
    low, middle, high = ((1.0 - share) * p + share * o for p, o in zip(prior, fleet_levels, strict=True))
    return low, middle, high


def _log_odds(hazard: Array) -> Array:
    return np.asarray(logit(np.clip(hazard, 1e-7, 1.0 - 1e-7)))


def _terms(span: Array, reserve: Array, odds: Array) -> Array:
    near = np.exp(-EDGES[span + 1] / 50.0)
    low, high, zero = RESERVE
    reserve_term = np.clip(np.nan_to_num(reserve, nan=zero), low, high) - zero
    late = np.where(EDGES[span + 1] > LATE_AFTER, odds - USUAL_ODDS, 0.0)
    return np.stack(np.broadcast_arrays(np.ones(1), near, reserve_term, late), axis=-1)
