"""The message's rule is found again from lives it ended, and stays the prior where nothing was heard."""

import numpy as np
import pytest

from hdt_core.prognosis.message_rule import PRIOR, learn_rules


def lives(n: int, excess_k: float, of: int, seed: int = 0) -> tuple[dict[float, np.ndarray], np.ndarray]:
    """Overheat that grows along each life, and the flight on which the rule is first met."""
    rng = np.random.default_rng(seed)
    level = np.linspace(-10.0, 14.0, 200)[None, :] + 3.0 * rng.standard_normal((n, 200))
    hot = level > excess_k
    before = np.zeros_like(hot)
    for lag in range(1, of):
        before[:, lag:] |= hot[:, :-lag]
    met = hot & before if of > 1 else hot
    message = np.where(met.any(axis=1), met.argmax(axis=1), -1)
    after = np.arange(200)[None, :] > np.where(message < 0, 10**6, message)[:, None]
    seen = np.where(after, np.nan, np.maximum(level, 0.0))
    return {0.2: seen, 0.5: np.maximum(seen - 3.0 - rng.exponential(1.0, seen.shape), 0.0)}, message


@pytest.mark.parametrize(("excess_k", "of"), [(4.0, 3), (8.0, 3), (6.0, 1)])
def test_a_rule_is_found_again(excess_k, of):
    overheat, message = lives(15, excess_k, of)
    rule = learn_rules(overheat, message, np.full(15, "XXX"))["XXX"]
    assert rule.excess_k == pytest.approx(excess_k, abs=max(1.0, 2.0 * rule.excess_sd_k))
    assert rule.of == of
    assert rule.messages == 15


def test_the_doubt_falls_with_the_messages():
    few, many = (learn_rules(*lives(n, 6.0, 3), np.full(n, "XXX"))["XXX"].excess_sd_k for n in (1, 15))
    assert many < few <= PRIOR.excess_sd_k + 0.6


def test_an_operator_that_sends_nothing_has_the_rule_of_the_others():
    overheat, message = lives(12, 5.0, 3)
    operator = np.repeat(["AAA", "MUT"], 6)
    rules = learn_rules(overheat, np.where(operator == "MUT", -1, message), operator)
    assert rules["MUT"].messages == 0
    assert rules["MUT"].excess_k == pytest.approx(rules[""].excess_k, abs=0.2)


def test_without_any_message_the_prior_stands():
    overheat, message = lives(8, 5.0, 3)
    rule = learn_rules(overheat, np.full_like(message, -1), np.full(8, "XXX"))["XXX"]
    assert rule.excess_k == pytest.approx(PRIOR.excess_k, abs=0.3)
    assert rule.of == PRIOR.of
