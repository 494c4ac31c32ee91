"""The message's rule: its posterior over every rule of the grid, by loops; and where it stays the prior."""

import numpy as np
import pytest

from hdt_core.margin.margin import PRIOR_RULE as PRIOR
from hdt_core.prognosis import message_rule


def lives(n: int, excess_k: float, of: int, seed: int = 0) -> tuple[dict[float, np.ndarray], np.ndarray]:
    """Overheat that grows along each life, and the flight on which the rule is first met."""
    rng = np.random.default_rng(seed)
    level = np.linspace(-10.0, 14.0, 200)[None, :] + 3.0 * rng.standard_normal((n, 200))
    message = np.array([rule_onsets(row, excess_k, of) for row in level])
    after = np.arange(200)[None, :] > np.where(message < 0, 10**6, message)[:, None]
    observed = np.where(after, np.nan, np.maximum(level, 0.0))
    return {0.2: observed, 0.5: np.maximum(observed - 3.0 - rng.exponential(1.0, observed.shape), 0.0)}, message


def rule_onsets(overheat: np.ndarray, excess_k: float, of: int) -> int:
    """The second hot flight of `of`, the first where it is one."""
    hot = overheat > excess_k
    return next((k for k in range(len(hot)) if hot[k] and (of == 1 or hot[max(k - of + 1, 0) : k].any())), -1)


def learn_rules(overheat, message, operator):
    return message_rule.learn_rules(message_rule.rule_onsets(list(overheat.values())), message, operator)


def by_loops(overheat, message, weight) -> tuple[float, int, float, float]:
    """Share, persistence, mean and sd of the excess: a grid of 1 to 15 K, one flight, two of two, two of three."""
    logs = {}
    for share in overheat:
        for of, chance in ((1, 0.25), (2, 0.25), (3, 0.5)):
            for excess in range(1, 16):
                log = np.log(chance) - 0.5 * ((excess - 7.0) / 2.5) ** 2
                for row, true_onset, w in zip(overheat[share], message, weight, strict=True):
                    onset = rule_onsets(np.nan_to_num(row), excess, of)
                    off = abs(onset - true_onset)
                    if true_onset >= 0:
                        likelihood = 0.03 if onset < 0 or off > 3 else 0.5 if off == 0 else 0.12
                    else:
                        likelihood = 0.08 if onset >= 0 else 0.92
                    log += w * np.log(likelihood)
                logs[share, of, excess] = log
    chance = {rule: np.exp(log - max(logs.values())) for rule, log in logs.items()}
    kinds = {rule[:2] for rule in chance}
    share, of = max(sorted(kinds), key=lambda kind: sum(c for rule, c in chance.items() if rule[:2] == kind))
    here = {rule[2]: c for rule, c in chance.items() if rule[:2] == (share, of)}
    total = sum(here.values())
    mean = sum(e * c for e, c in here.items()) / total
    return share, of, mean, np.sqrt(sum(c * (e - mean) ** 2 for e, c in here.items()) / total + 0.25)


@pytest.mark.parametrize(("excess_k", "of", "seed"), [(4.0, 3, 1), (8.0, 2, 2), (6.0, 1, 3)])
def test_the_posterior_is_that_of_every_rule_of_the_grid(excess_k, of, seed):
    """One operator's lives count in full, others' by a half, those of an operator without a message not at all."""
    overheat, message = lives(9, excess_k, of, seed)
    operator = np.array(["AAA"] * 4 + ["BBB"] * 3 + ["MUT"] * 2)
    message[[1, 5]] += 3
    message[2] += 4
    overheat[0.2][3, 0], message[3] = 14.0, 0  # hot at once
    message[7:] = -1
    message[6] = -1
    rules = learn_rules(overheat, message, operator)
    assert set(rules) == {"", "AAA", "BBB", "MUT"}
    for name, own in (("AAA", 4), ("BBB", 2), ("MUT", 0), ("", 6)):
        weight = np.where(operator == "MUT", 0.0, np.where(operator == name, 1.0, 0.5))
        share, persistence, mean, sd = by_loops(overheat, message, weight)
        rule = rules[name]
        assert (rule.share, rule.of, rule.messages) == (share, persistence, own)
        assert (rule.excess_k, rule.excess_sd_k) == pytest.approx((mean, sd))


@pytest.mark.parametrize(("excess_k", "of"), [(4.0, 3), (8.0, 3), (6.0, 1)])
def test_a_rule_is_found_again(excess_k, of):
    overheat, message = lives(15, excess_k, of)
    rule = learn_rules(overheat, message, np.full(15, "XXX"))["XXX"]
    assert rule.excess_k == pytest.approx(excess_k, abs=max(1.0, 2.0 * rule.excess_sd_k))
    assert rule.of == of


def test_without_any_message_the_prior_stands():
    overheat, message = lives(8, 5.0, 3)
    rule = learn_rules(overheat, np.full_like(message, -1), np.full(8, "XXX"))["XXX"]
    assert rule.excess_k == pytest.approx(PRIOR.excess_k, abs=0.3)
    assert rule.of == PRIOR.of


def test_before_any_message_two_flights_of_three_are_as_likely_as_all_else():
    """What is exact counts half; near, missed and spurious are rarer, in this order of likelihood."""
    prior = message_rule.PERSISTENCE_PRIOR
    assert (prior[1], prior[2], prior[3], sum(prior.values())) == (0.25, 0.25, 0.5, 1.0)
    onsets, message = np.array([[10], [13], [14], [-1], [-1], [5]]), np.array([[10], [10], [10], [10], [-1], [-1]])
    np.testing.assert_allclose(np.exp(message_rule._fit(onsets, message))[:, 0], [0.5, 0.12, 0.03, 0.03, 0.92, 0.08])
    assert len(message_rule.RULES) == 2 * 3 * 15
