"""Survival arithmetic and scores in numbers that can be checked on paper: risk sets, limits, corrections, bounds."""

import numpy as np
import polars as pl
import pytest
from scipy.optimize import minimize

from benchmarks.prognosis import calibration
from benchmarks.real.lives import life_bounds
from hdt_core.components import Limit
from hdt_core.prognosis.component_life import first_passage, learn_limit
from hdt_core.prognosis.feature_rows import PRIOR_RULES
from hdt_core.prognosis.hazard import (
    EDGES,
    SPANS,
    _by_tree,
    _row_by_row,
    at_risk,
    event_by,
    fit_hazard,
    hazards,
    position,
    quantile,
    with_span,
)
from hdt_core.prognosis.metrics import (
    alpha_lambda,
    auc,
    brier_skill,
    constant_interval_score,
    interval_score,
    score_prognoses,
)  # fmt: skip
from hdt_core.prognosis.recalibrate import HazardCorrection, learn_correction, learn_levels

SPAN_ENDS = [5, 10, 15, 20, 30, 40, 50, 65, 80, 100, 125, 150, 175, 200, 250, 300]


def test_edges_are_declared():
    assert EDGES.tolist() == [0, *SPAN_ENDS]


def test_hazards_add_up_to_chances():
    np.testing.assert_allclose(event_by(np.full((1, SPANS), 0.1))[0], 1.0 - 0.9 ** np.arange(SPANS + 1))


def test_rows_take_their_span_along():
    np.testing.assert_allclose(with_span(np.array([[7.0]]), np.array([2])), [[7.0, 15.0]])


BY = np.array([[0.0, 0.2, 0.4, *[0.8] * 14]])


@pytest.mark.parametrize(("level", "flights"), [(0.1, 2.5), (0.3, 7.5)])
def test_quantiles_are_linear_between_edges(level, flights):
    assert quantile(BY, level)[0] == pytest.approx(flights, rel=1e-6)


@pytest.mark.parametrize(("by", "level", "flights"), [(BY, 0.9, 300.0), (np.full((1, 17), 0.5), 0.1, 0.0)])
def test_quantiles_end_with_the_scale(by, level, flights):
    assert quantile(by, level)[0] == flights


@pytest.mark.parametrize(("left", "at"), [(0.0, 0.0), (2.5, 0.1), (5.0, 0.2), (7.5, 0.3), (12.5, 0.6), (400.0, 0.8)])
def test_positions_are_linear_between_edges(left, at):
    assert position(BY, np.array([left]))[0] == pytest.approx(at)


def test_positions_invert_quantiles():
    by = event_by(np.random.default_rng(0).uniform(0.01, 0.4, (50, SPANS)))
    inside = by[:, -1] > 0.3
    np.testing.assert_allclose(position(by, quantile(by, 0.3))[inside], 0.3, atol=1e-6)


@pytest.mark.parametrize(
    ("left", "failed", "exposure", "hit"),
    [
        (12.0, True, [1.0, 1.0, 1.0], 2),  # the event falls in the third span
        (10.0, True, [1.0, 1.0], 1),  # an end belongs to its span
        (12.0, False, [1.0, 1.0, 0.4], None),  # cut after two fifths of the third
        (10.0, False, [1.0, 1.0], None),
        (400.0, True, [1.0] * 16, None),
        (0.0, True, [], None),
    ],
)
def test_row_is_at_risk_until_end(left, failed, exposure, hit):
    row, span, hits, weight = at_risk(np.array([left]), np.array([failed]))
    assert not row.any()
    assert span.tolist() == list(range(len(exposure)))
    np.testing.assert_allclose(weight, exposure)
    assert np.flatnonzero(hits).tolist() == ([] if hit is None else [hit])


@pytest.fixture(scope="module")
def learners():
    """Units that fail the sooner the higher their first feature, and two models of them."""
    rng = np.random.default_rng(0)
    features = rng.uniform(-1.0, 1.0, (800, 2))
    left = rng.exponential(60.0 * np.exp(-features[:, 0]))
    return [fit_hazard(features, left, np.ones(800, bool), seed, rises=(1, 0)) for seed in (0, 1)]


GRID = np.column_stack([np.linspace(-1, 1, 21), np.zeros(21)])


def test_hazards_average_the_learners(learners):
    one, other = (hazards([m], GRID) for m in learners)
    np.testing.assert_allclose(hazards(learners, GRID), (one + other) / 2.0)
    assert np.abs(one - other).max() > 0.0


def test_hazards_rise_as_declared(learners):
    hazard = hazards(learners[:1], GRID)
    assert (np.diff(hazard, axis=0) >= 0.0).all()
    assert (hazard[-1] > 1.5 * hazard[0]).all()


def test_learners_are_as_declared(learners):
    """Small trees, many rows a leaf, no early stop: chosen on simulated fleets, so a change wants them flown again."""
    chosen = {
        "max_iter": 150, "learning_rate": 0.08, "max_leaf_nodes": 12, "min_samples_leaf": 400, "max_features": 0.4,
        "l2_regularization": 1.0, "early_stopping": False, "monotonic_cst": [1, 0, 0], "random_state": 1,
    }  # fmt: skip
    params = learners[1].get_params()
    assert {name: params[name] for name in chosen} == chosen
    assert learners[1].n_features_in_ == 3


PRIOR = Limit(0.25, 0.06, 0.05)


def test_prior_limit_is_declared():
    assert PRIOR_RULES["CC"] == PRIOR


def test_limit_is_robust_normal_posterior():
    """With Huber's weights: losses of 0.2, 0.22 and one far off at 0.5, units 0.05 apart."""
    middle = (0.22 + 0.25) / 2.0
    weight = np.array([1.0, 1.0, 1.5 * 0.05 / (0.5 - middle)])
    precision = 1.0 / 0.06**2 + weight.sum() / 0.05**2
    limit = learn_limit(np.array([0.20, 0.22, np.nan, 0.5]), PRIOR)
    assert limit.mean == pytest.approx((0.25 / 0.06**2 + weight @ [0.20, 0.22, 0.5] / 0.05**2) / precision)
    assert limit.sd == pytest.approx(precision**-0.5)
    assert limit.unit_sd == 0.05


def test_limit_without_losses_is_prior():
    assert learn_limit(np.array([np.nan]), PRIOR) == PRIOR


LIMIT = (np.array([0.25]), np.array([0.06]))
LOSS_RATE = [np.array([v]) for v in (0.1, 0.02, 1e-3, 4e-4)]
"""A unit's loss and rate, each with its deviation."""


def test_first_passage_equals_monte_carlo():
    """Loss, rate and limit normal."""
    rng = np.random.default_rng(1)
    loss, rate, limit = (m + s * rng.standard_normal(100_000) for m, s in ((0.1, 0.02), (1e-3, 4e-4), (0.25, 0.06)))
    crossed = loss + rate * EDGES[:, None] > limit
    np.testing.assert_allclose(first_passage(*LOSS_RATE, LIMIT, np.array([False]))[0], crossed.mean(1), atol=0.006)


def test_flying_unit_has_not_failed():
    """Its limit lies above what it has lost."""
    anyone, alive = (first_passage(*LOSS_RATE, LIMIT, np.array([flies]))[0] for flies in (False, True))
    np.testing.assert_allclose(alive, (anyone - anyone[0]) / (1.0 - anyone[0]), rtol=1e-12)


def test_healing_unit_keeps_its_chance():
    loss, loss_sd, rate, rate_sd = LOSS_RATE
    still = first_passage(loss, loss_sd, -rate, 0.0 * rate_sd, LIMIT, np.array([False]))
    np.testing.assert_allclose(still, first_passage(*LOSS_RATE, LIMIT, np.array([False]))[0, 0])


def terms(end: np.ndarray, reserve: float, odds: np.ndarray) -> np.ndarray:
    """One; near the next flights; reserve between -0.2 and 0.6 about 0.2; odds about -3, after fifty flights."""
    late = np.where(end > 50.0, odds + 3.0, 0.0)
    return np.stack([np.ones_like(odds), np.exp(-end / 50.0), np.clip(reserve, -0.2, 0.6) - 0.2 + 0 * odds, late], -1)


@pytest.mark.parametrize(("reserve", "counts_as"), [(0.35, 0.35), (1.0, 0.6), (-1.0, -0.2), (np.nan, 0.2)])
def test_correction_shifts_log_odds(reserve, counts_as):
    hazard = np.linspace(0.02, 0.5, SPANS)[None, :]
    weights = np.array([0.3, -0.2, 0.5, 0.4])
    odds = np.log(hazard / (1.0 - hazard))
    shifted = odds + terms(EDGES[None, 1:], counts_as, odds) @ weights
    corrected = HazardCorrection(tuple(weights))(hazard, np.array([reserve]))
    np.testing.assert_allclose(corrected, 1.0 / (1.0 + np.exp(-shifted)))


def test_correction_maximises_posterior():
    """Rows of one life share its weight; the prior says no correction, within 0.5, 0.3, 0.5 and 0.3."""
    rng = np.random.default_rng(3)
    n = 60
    life = np.repeat(np.arange(15), 4)
    left = rng.exponential(40.0, n)
    failed = rng.random(n) < 0.7
    hazard = rng.uniform(0.02, 0.3, (n, SPANS))
    reserve = rng.uniform(-0.1, 0.5, n)
    rows = []
    hits = []
    weights = []
    x = []
    offset = []
    for k in range(n):
        for j in range(SPANS):
            start = EDGES[j]
            end = EDGES[j + 1]
            if left[k] <= start:
                break
            hit = failed[k] and left[k] <= end
            rows.append(k)
            hits.append(hit)
            weights.append((1.0 if hit else min(1.0, (left[k] - start) / (end - start))) * 15 / 60)
            offset.append(np.log(hazard[k, j] / (1.0 - hazard[k, j])))
            x.append(terms(np.array(end), reserve[k], np.array(offset[-1])))
    hits, weights, x, offset = (np.array(v) for v in (hits, weights, x, offset))

    def cost(w):
        chance = 1.0 / (1.0 + np.exp(-(offset + x @ w)))
        prior = 0.5 * ((w / [0.5, 0.3, 0.5, 0.3]) ** 2).sum()
        return prior - (weights * np.log(np.where(hits, chance, 1.0 - chance))).sum()

    want = minimize(cost, np.zeros(4), method="BFGS").x
    np.testing.assert_allclose(learn_correction(hazard, reserve, left, failed, life).weights, want, atol=2e-4)


EVEN_BY = np.broadcast_to(np.r_[0.0, np.cumsum(np.diff(EDGES)) / 300.0], (11, SPANS + 1))
EVEN_LEFT = np.r_[30.0 * np.arange(1, 11), 155.0]
EVEN_FAILED = np.arange(11) < 10
PRIOR_LEVELS = (0.04, 0.52, 0.97)
"""Of twenty failed lives."""


def even_levels(left=EVEN_LEFT, failed=EVEN_FAILED, life=None):
    """Of ten events spread evenly over the scale, one more life cut in the middle."""
    return learn_levels(EVEN_BY, left, failed, np.arange(11) if life is None else life, prior=PRIOR_LEVELS)


@pytest.fixture(scope="module")
def kaplan_meier() -> np.ndarray:
    """The levels by themselves."""
    alive = 1.0
    steps = []
    for at in np.sort(EVEN_LEFT):
        risk = (at <= EVEN_LEFT).sum()
        alive *= 1.0 - (1.0 / risk if EVEN_FAILED[at == EVEN_LEFT].any() else 0.0)
        steps.append((at / 300.0, 1.0 - alive))
    return np.array([next(at for at, share in steps if share >= level - 1e-12) for level in (0.05, 0.5, 0.95)])


def test_levels_equal_kaplan_meier(kaplan_meier):
    np.testing.assert_allclose(even_levels(), (10 * kaplan_meier + 20 * np.array(PRIOR_LEVELS)) / 30)


def test_rows_of_life_count_once(kaplan_meier):
    levels = even_levels(life=np.zeros(11, int))
    np.testing.assert_allclose(levels, (kaplan_meier + 20 * np.array(PRIOR_LEVELS)) / 21)


def test_unreached_level_ends_the_scale():
    """Where nearly all were cut."""
    assert even_levels(failed=np.arange(11) < 3)[2] == pytest.approx((3 * 1.0 + 20 * 0.97) / 23)


def test_event_after_horizon_is_none():
    assert even_levels(left=np.where(EVEN_FAILED, EVEN_LEFT + 301.0, EVEN_LEFT)) == PRIOR_LEVELS


LIVES = np.random.default_rng(0).permutation(np.arange(1.0, 401.0))


def test_life_bounds_are_order_statistics():
    """All were watched alike: a tenth looks first, of the others' 360 the 18th from either end."""
    bounds = life_bounds(LIVES, np.ones(400, bool), np.full(400, 500.0))
    rest = np.sort(np.delete(LIVES, np.arange(0, 400, 10)))
    assert (bounds.low, bounds.high) == (rest[17], rest[342])


def test_lives_beyond_record_bound_from_below():
    """Most are not over by its end."""
    bounds = life_bounds(np.minimum(LIVES, 300.0), LIVES < 300.0, np.full(400, 300.0))
    rest = np.sort(np.minimum(np.delete(LIVES, np.arange(0, 400, 10)), 300.0))
    assert (bounds.low, bounds.high) == (rest[35], np.inf)


@pytest.mark.parametrize(("over", "two_sided"), [(37, False), (38, True)])
def test_upper_bound_needs_ended_lives(over, two_sided):
    """Nineteen of twenty, of those that look first."""
    late = np.where((np.arange(400) % 10 == 0) & (np.arange(400) // 10 >= over), 1000.0, LIVES)
    assert np.isfinite(life_bounds(late, late < 500.0, np.full(400, 1000.0)).high) == two_sided


@pytest.mark.parametrize(("n", "n_used"), [(1000, 400), (300, 200), (40, 40)])
def test_longest_watched_units_are_used(n, n_used):
    """A fair sample of two hundred at least, two fifths of all: those that could have been watched for longest."""
    watched = np.arange(1.0, n + 1.0) + 1000.0
    lives = np.random.default_rng(2).uniform(0.0, 1000.0, n)
    bounds = life_bounds(lives, np.ones(n, bool), watched)
    rest = np.sort(np.delete(lives[-n_used:], np.arange(0, n_used, 10)))
    first = int(np.floor(0.05 * (rest.size + 1)))
    assert bounds == (rest[first - 1] if first else 0.0, rest[rest.size - first])


def test_life_ends_while_watched():
    watched = np.full(40, 1000.0)
    with pytest.raises(ValueError, match="longer than its unit"):
        life_bounds(watched + 1.0, np.ones(40, bool), watched)


def test_uncensored_lives_are_order_statistics():
    """Of the half that is not used for weights."""
    lives = np.random.default_rng(1).permutation(np.arange(1.0, 401.0))
    bounds = life_bounds(lives, np.ones(400, bool))
    half = np.sort(lives[1::2])
    assert bounds.low == half[int(np.floor(0.05 * 201 + 1e-9)) - 1]
    assert bounds.high == half[int(np.ceil(0.95 * 201 - 1e-9)) - 1]


def test_censored_lives_are_weighed():
    """Half of the units leave at 150 for other reasons: whoever ends later stands for about two."""
    lives = np.random.default_rng(1).permutation(np.arange(1.0, 401.0))
    cut = np.where(np.arange(400) % 4 < 2, np.minimum(lives, 150.5), lives)
    weighed = life_bounds(cut, cut == lives)
    others = cut[::2]
    stay = 1.0 - (others == 150.5).sum() / (others >= 150.5).sum()
    sample = np.sort(cut[1::2][cut[1::2] == lives[1::2]])
    mass = np.cumsum(np.where(sample > 150.5, 1.0 / stay, 1.0)) / 201.0
    assert weighed.low == sample[np.flatnonzero(mass <= 0.05)[-1]]
    assert weighed.high == sample[np.flatnonzero(mass >= 0.95)[0]]


def test_bounds_need_an_ended_life():
    with pytest.raises(ValueError, match="no life ended"):
        life_bounds([1.0, 2.0], [False, False])


def draw_rates(rng: np.random.Generator, n: int) -> np.ndarray:
    """Hazards a flight, even in their logarithm."""
    return np.exp(rng.uniform(np.log(0.003), np.log(0.03), n))


@pytest.fixture(scope="module")
def censored_learner():
    """Model of units by their ln hazard, half of them cut."""
    rng = np.random.default_rng(1)
    rate = draw_rates(rng, 8000)
    death = rng.exponential(1.0 / rate)
    cut = rng.uniform(0.0, 200.0, 8000)
    return fit_hazard(np.log(rate)[:, None], np.minimum(death, cut), death <= cut, seed=0)


@pytest.mark.parametrize("rate", [0.005, 0.01, 0.02])
def test_hazard_is_learned_under_censoring(censored_learner, rate):
    near = np.log(rate) + np.linspace(-0.2, 0.2, 200)[:, None]
    p_50 = event_by(hazards([censored_learner], near))[:, EDGES.tolist().index(50.0)].mean()
    assert p_50 == pytest.approx(1.0 - np.exp(-rate * 50.0), abs=0.04)


def test_trees_answer_as_row_by_row():
    """Asked once a cut."""
    rng = np.random.default_rng(4)
    rate = draw_rates(rng, 4000)
    model = fit_hazard(np.log(rate)[:, None], rng.exponential(1.0 / rate), np.ones(4000, bool), seed=0)
    features = np.where(rng.random((500, 1)) < 0.1, np.nan, np.log(rng.choice(rate, (500, 1))))
    assert np.array_equal(_by_tree(model, features, EDGES[1:]), _row_by_row(model, features, EDGES[1:]))


NORMAL = np.random.default_rng(0).standard_normal(20000)


def mean_score(half: float) -> float:
    """Of an interval of so many deviations either side."""
    return interval_score(NORMAL, np.full_like(NORMAL, -half), np.full_like(NORMAL, half)).mean()


@pytest.mark.parametrize("half", [0.8, 1.2, 2.2, 3.0])
def test_interval_score_is_proper(half):
    assert mean_score(half) > mean_score(1.645)


def test_constant_interval_is_honest():
    assert constant_interval_score(NORMAL) == pytest.approx(mean_score(1.645), rel=0.01)


EVENTS = np.array([1.0, 0.0, 0.0, 0.0])


def test_base_rate_has_no_skill():
    assert brier_skill(EVENTS, np.full(4, 0.25)) == pytest.approx(0.0)


def test_perfect_forecast_has_full_skill():
    assert brier_skill(EVENTS, EVENTS) == 1.0


@pytest.mark.parametrize(
    ("events", "forecast", "area"), [([1, 1, 0, 0], [0.9, 0.4, 0.5, 0.1], 0.75), ([1, 0], [0.5, 0.5], 0.5)]
)
def test_auc_counts_pairs(events, forecast, area):
    assert auc(events, forecast) == area


def test_alpha_lambda_counts_near_forecasts():
    assert alpha_lambda(np.array([100.0, 50.0, 10.0, 1.0]), np.array([150.0, 55.0, 11.0, 1.0])) == 0.75


def test_true_chances_are_calibrated():
    rng = np.random.default_rng(1)
    p = rng.random(50000)
    table = calibration(rng.random(50000) < p, p)
    np.testing.assert_allclose(table["observed"], table["predicted"], atol=0.03)


def test_surviving_units_omit_failure_scores():
    prognoses = pl.DataFrame(
        {
            "remaining": [320.0, 400.0], "rul_flights": [280.0, 300.0], "rul_low": [150.0, 200.0],
            "rul_high": [300.0, 300.0],
        }
    ).with_columns(failed=False, life=pl.Series([0, 1]), event_50=0.0, p_event_50=0.01)  # fmt: skip
    scores = score_prognoses(prognoses)
    assert scores["mae_flights"] == 10.0
    assert scores["coverage"] == 1.0
    assert not {"interval_skill", "coverage_last_100", "alpha_lambda_20", "brier_skill"} & scores.keys()
