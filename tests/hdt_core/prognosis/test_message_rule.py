"""What a fleet's failures teach: the message's rule by loops over its grid, recalibration; else the prior stands."""

import numpy as np
import pytest
from scipy.special import expit, logit

from hdt_core.components.pack import CC
from hdt_core.margin.margin import PRIOR_RULE as PRIOR
from hdt_core.prognosis import recalibrate
from hdt_core.prognosis.component_life import learn_limit
from hdt_core.prognosis.hazard import EDGES, SPANS, event_by
from hdt_core.prognosis.recalibrate import TERMS, USUAL_ODDS, HazardCorrection, learn_correction, learn_levels


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
    return recalibrate.learn_rules(recalibrate.rule_onsets(list(overheat.values())), message, operator)


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
def test_posterior_equals_grid_loops(excess_k, of, seed):
    """One operator's lives count in full, others' by a half, those of an operator without a message not at all."""
    overheat, message = lives(9, excess_k, of, seed)
    operator = np.array(["AAA"] * 4 + ["BBB"] * 3 + ["MUT"] * 2)
    message[[1, 5]] += 3
    message[2] += 4
    overheat[0.2][3, 0] = 14.0
    message[3] = 0  # hot at once
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
def test_recovers_known_rule(excess_k, of):
    overheat, message = lives(15, excess_k, of)
    rule = learn_rules(overheat, message, np.full(15, "XXX"))["XXX"]
    assert rule.excess_k == pytest.approx(excess_k, abs=max(1.0, 2.0 * rule.excess_sd_k))
    assert rule.of == of


def test_prior_stands_without_messages():
    overheat, message = lives(8, 5.0, 3)
    rule = learn_rules(overheat, np.full_like(message, -1), np.full(8, "XXX"))["XXX"]
    assert rule.excess_k == pytest.approx(PRIOR.excess_k, abs=0.3)
    assert rule.of == PRIOR.of


def test_persistence_prior_favours_two_of_three():
    """As all else."""
    assert recalibrate.PERSISTENCE_PRIOR == {1: 0.25, 2: 0.25, 3: 0.5}


@pytest.mark.parametrize(
    ("onset", "message", "likelihood"),
    [(10, 10, 0.5), (13, 10, 0.12), (14, 10, 0.03), (-1, 10, 0.03), (-1, -1, 0.92), (5, -1, 0.08)],
    ids=["exact", "near", "far", "missed", "silent", "spurious"],
)
def test_onset_likelihood_falls_with_distance(onset, message, likelihood):
    fit = np.exp(recalibrate._fit(np.array([[onset]]), np.array([[message]])))
    np.testing.assert_allclose(fit[:, 0], [likelihood])


def test_grid_has_every_rule():
    assert len(recalibrate.RULES) == 2 * 3 * 15


def landmarks(n: int, rate: float) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(2)
    death = rng.exponential(1.0 / rate, n)
    left = np.concatenate([np.arange(d, 0.0, -10.0) for d in death])
    life = np.concatenate([np.full(len(np.arange(d, 0.0, -10.0)), i) for i, d in enumerate(death)])
    return left, np.ones(left.size, bool), life


def test_no_failures_leave_no_correction():
    hazard = np.full((30, SPANS), 0.1)
    done = learn_correction(hazard, np.zeros(30), np.full(30, 400.0), np.zeros(30, bool), np.arange(30))
    assert done == HazardCorrection()


def test_no_lives_leave_prior_levels():
    none = np.empty(0)
    levels = learn_levels(np.empty((0, SPANS + 1)), none, np.empty(0, bool), np.empty(0, int), (0.04, 0.5, 0.96))
    assert levels == (0.04, 0.5, 0.96)


def test_stored_correction_may_lack_terms():
    hazard = np.linspace(0.01, 0.4, 3 * SPANS).reshape(3, SPANS)
    short, full = (HazardCorrection(weights) for weights in ((0.1, -0.2, 0.3), (0.1, -0.2, 0.3, 0.0)))
    reserve = np.array([-0.1, 0.1, np.nan])
    np.testing.assert_array_equal(short(hazard, reserve), full(hazard, reserve))


def exponential_by(n: int) -> np.ndarray:
    """Chances of units that live for 120 flights in the mean."""
    return np.broadcast_to(event_by(1.0 - np.exp(-np.diff(EDGES)[None, :] / 120.0)), (n, SPANS + 1))


def test_levels_are_nominal_under_censoring():
    rng = np.random.default_rng(3)
    death = rng.exponential(120.0, 4000)
    cut = rng.uniform(0.0, 250.0, 4000)
    low, middle, high = learn_levels(
        exponential_by(4000), np.minimum(death, cut), death <= cut, np.arange(4000), prior_lives=0.0
    )
    assert low == pytest.approx(0.05, abs=0.01)
    assert middle == pytest.approx(0.5, abs=0.03)
    assert high > 0.85  # nothing was seen beyond the cuts: as far as the lives reach


def test_late_distribution_lowers_levels():
    death = np.random.default_rng(4).exponential(60.0, 2000)
    _, middle, _ = learn_levels(exponential_by(2000), death, np.ones(2000, bool), np.arange(2000))
    assert middle == pytest.approx(1.0 - np.exp(-0.5 * np.log(2.0)), abs=0.03)


@pytest.mark.parametrize(("n", "share"), [(3, 0.1), (200, 0.6)])
def test_low_hazard_is_corrected(n, share):
    left, failed, life = landmarks(n, 0.02)
    hazard = np.broadcast_to(1.0 - np.exp(-0.01 * np.diff(EDGES)), (left.size, SPANS))
    done = learn_correction(hazard, np.full(left.size, 0.5), left, failed, life)
    before = event_by(hazard)[0, 7]
    after = event_by(done(hazard[:1], np.array([0.5])))[0, 7]
    truth = 1.0 - np.exp(-0.02 * 50.0)
    assert after > before
    assert (after - before) / (truth - before) > share
    assert after < truth + 0.1


def steady_and_worn(n: int) -> tuple[np.ndarray, ...]:
    """True hazards (n, SPANS) and lives of two kinds of units: one fails in a hundred flights, one in a thousand."""
    rng = np.random.default_rng(5)
    rate = np.where(np.arange(n) % 2 == 0, 0.01, 0.001)
    death = rng.exponential(1.0 / rate)
    hazard = 1.0 - np.exp(-rate[:, None] * np.diff(EDGES))
    return hazard, np.minimum(death, 300.0), death <= 300.0, np.arange(n)


LATE = EDGES[1:] > 50.0


@pytest.mark.parametrize(("flattened", "slope"), [(1.0, 0.0), (1.5, 0.5)])
def test_flattened_base_is_corrected(flattened, slope):
    """A base that tells units too little apart far ahead; no slope is found where it is right."""
    truth, left, failed, life = steady_and_worn(4000)
    base = np.where(LATE, expit(USUAL_ODDS + (logit(truth) - USUAL_ODDS) / flattened), truth)
    done = learn_correction(base, np.full(left.size, 0.2), left, failed, life)
    assert done.weights[TERMS.index("late_odds")] == pytest.approx(slope, abs=0.12)
    np.testing.assert_allclose(logit(done(base[:2], np.full(2, 0.2))), logit(truth[:2]), atol=0.25)


def test_late_slope_leaves_next_flights():
    truth, *_ = steady_and_worn(4000)
    alone = HazardCorrection((0.0, 0.0, 0.0, 0.5))(truth[:2], np.full(2, 0.2))
    np.testing.assert_allclose(alone[:, ~LATE], truth[:2, ~LATE])


def test_limit_without_losses_is_prior():
    assert learn_limit(np.empty(0), CC.limit) == CC.limit


def test_limit_moves_with_messages():
    prior = CC.limit
    few, many = (learn_limit(np.full(n, 0.15), prior) for n in (1, 30))
    assert 0.15 < few.mean < prior.mean
    assert many.mean == pytest.approx(0.15, abs=0.01)
    assert many.sd < few.sd < prior.sd


def test_clog_moves_limit_little():
    levels = np.array([0.25, 0.26, 0.24, 0.25])
    clean, clogged = (learn_limit(own, CC.limit) for own in (levels, np.append(levels, 0.65)))
    assert abs(clogged.mean - clean.mean) < 0.03
