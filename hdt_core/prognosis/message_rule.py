"""Estimate the rule of the message: how hot, for which share of a flight, how often; from past messages."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from hdt_core.margin.exchanger_demand import SHARES
from hdt_core.margin.first_passage import repeated_demand
from hdt_core.margin.margin import PRIOR_RULE, MessageRule
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
    excess, weight = np.array([e for *_, e in RULES])[in_mode], chance[in_mode] / chance[in_mode].sum()
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
