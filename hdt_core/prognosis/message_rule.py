"""The rule by which the message comes: how hot, how much of a flight, how often; learned from messages there were."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from hdt_core.margin.conditions import repeated_demand
from hdt_core.margin.exchanger_demand import SHARES
from hdt_core.margin.margin import PRIOR_RULE as PRIOR
from hdt_core.margin.margin import MessageRule

Array = NDArray[np.float64]

EXCESS_K = np.arange(1.0, 16.0)
OFS = (1, 2, 3)
PRIOR_OF = {1: 0.25, 2: 0.25, 3: 0.5}
"""Fault messages are latched by persistence, commonly two occurrences: ARINC 624, section 3."""
EXACT, NEAR, MISSED, SPURIOUS = 0.5, 0.12, 0.03, 0.08
"""Likelihood of a life whose rule was met on the flight of its message, within three flights of it, never or long
before; and of a life without a message whose rule was met."""
OTHERS = 0.5
"""Weight of other operators' messages: one type, other settings of its monitor."""
RULES = tuple(product(SHARES, OFS, EXCESS_K.tolist()))
"""Share of the high samples, flights of which two must be hot, excess [K]."""


def first_met(overheat_k: Sequence[Array]) -> NDArray[np.int_]:
    """First flight of each life on which each of `RULES` is met, -1 where it never is. (lives, rules)

    Parameters
    ----------
    overheat_k : sequence of array
        For each of `SHARES` how far that share of the high samples lay above its level, (lives, flights), NaN where
        unknown. [K]
    """
    columns = []
    for hot, of in product(map(np.nan_to_num, overheat_k), OFS):
        most = np.fmax.accumulate(repeated_demand(hot, of), axis=1)
        below = np.stack([(~(most > excess)).sum(axis=1) for excess in EXCESS_K], axis=1)
        columns.append(np.where(below < hot.shape[1], below, -1))
    return np.concatenate(columns, axis=1)


def learn_rules(met: NDArray[np.int_], message: NDArray[np.int_], operator: NDArray[np.str_]) -> dict[str, MessageRule]:
    """Posterior of the rule for each operator, and under `""` for one that is not there.

    An operator without a single message may be one that sends none: its quiet lives are no evidence.

    Parameters
    ----------
    met : array of int, shape (lives, rules)
        From `first_met`.
    message : array of int, shape (lives,)
        Flight of the life's message, -1 for none.
    operator : array of str, shape (lives,)
        Whose life it was.
    """
    fits = _fit(met, message[:, None])
    prior = np.array(
        [np.log(PRIOR_OF[of]) - 0.5 * ((e - PRIOR.excess_k) / PRIOR.excess_sd_k) ** 2 for _, of, e in RULES]
    )
    fits *= np.isin(operator, np.unique(operator[message >= 0]))[:, None]
    out = {}
    for name in ("", *np.unique(operator)):
        weight = np.where(operator == name, 1.0, OTHERS) if name else np.full(operator.size, OTHERS)
        own = int((message >= 0)[operator == name].sum()) if name else int((message >= 0).sum())
        out[str(name)] = _summary(prior + weight @ fits, own)
    return out


def _summary(log_posterior: Array, messages: int) -> MessageRule:
    """The likeliest share and persistence, mean and spread of the excess given these."""
    chance = np.exp(log_posterior - log_posterior.max())
    kinds = sorted({(share, of) for share, of, _ in RULES})
    mass = [sum(c for c, (s, of, _) in zip(chance, RULES, strict=True) if (s, of) == kind) for kind in kinds]
    share, of = kinds[int(np.argmax(mass))]
    here = np.array([(s, o) == (share, of) for s, o, _ in RULES])
    excess, weight = np.array([e for *_, e in RULES])[here], chance[here] / chance[here].sum()
    mean = float(weight @ excess)
    # the grid's own step counts as doubt
    sd = float(np.sqrt(weight @ (excess - mean) ** 2 + 0.5**2))
    return MessageRule(share, mean, sd, of, messages)


def _fit(met: NDArray[np.int_], message: NDArray[np.int_]) -> Array:
    """Log likelihood of each life under a rule."""
    off = np.abs(met - message)
    failed = np.where(met < 0, MISSED, np.where(off == 0, EXACT, np.where(off <= 3, NEAR, MISSED)))
    return np.log(np.where(message >= 0, failed, np.where(met >= 0, SPURIOUS, 1.0 - SPURIOUS)))
