"""Where curvature is a doubtful witness, profiles run by themselves and the status says what the data leave open."""

import numpy as np
import pytest

from hdt_core.estimation import Belief, ExtendedKalman, NonlinearLeastSquares, Problem, UnscentedKalman, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.descent import descend
from hdt_core.estimation.optimum_checks import RISE, profile_intervals
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER

TIME = np.linspace(0.0, 5.0, 60)
TRUTH = np.array([1.0, 1.0, 1.0, 1.15])


def near_equal(seed, prior=None):
    """Two exponentials whose rates nearly agree: 0.089 +- 0.02 was once said of the first level, which is 1."""
    rng = np.random.default_rng(seed)

    def model(theta, t):
        return theta[0] * np.exp(-theta[1] * t) + theta[2] * np.exp(-theta[3] * t)

    return Problem(
        names=("level_1", "rate_1", "level_2", "rate_2"),
        bounds=np.tile([0.0, 20.0], (4, 1)),
        prior=unknown(np.array([0.5, 0.5, 1.0, 2.0])) if prior is None else prior,
        measured=(model(TRUTH, TIME) + 0.02 * rng.standard_normal(60))[:, None],
        sigma=np.array([0.02]),
        observe=lambda _x, theta, i: model(theta, TIME[i])[None],
    )


@pytest.mark.parametrize(
    "estimator", [NonlinearLeastSquares(), ExtendedKalman(), UnscentedKalman()], ids=lambda e: e.name
)
def test_near_equal_exponentials_are_never_called_converged(estimator):
    statuses = {estimator.estimate(near_equal(seed)).status for seed in range(8)}
    assert "converged" not in statuses
    assert statuses & {"weakly_identifiable", "not_identifiable"}


def test_a_prior_that_tells_them_apart_makes_it_an_estimate():
    prior = Belief(TRUTH, np.diag([0.02, 0.02, 0.02, 0.02]) ** 2)
    assert NonlinearLeastSquares().estimate(near_equal(0, prior)).status == "converged"


def saturating(seed, bounds=((0.0, 500.0), (0.0, 500.0))):
    """Seen below saturation only: the ceiling may be anything from somewhere upward."""
    x = np.linspace(0.1, 1.5, 40)
    noise = 0.06 * np.random.default_rng(seed).standard_normal(40)
    return Problem(
        names=("ceiling", "half"),
        bounds=np.array(bounds),
        prior=unknown(np.array([3.0, 2.0])),
        measured=(4.0 * x / (4.0 + x) + noise)[:, None],
        sigma=np.array([0.06]),
        observe=lambda _s, theta, i: (theta[0] * x[i] / (theta[1] + x[i]))[None],
    )


def test_a_profile_ends_where_the_objective_has_risen_by_its_quantile():
    problem = saturating(1)
    estimate = NonlinearLeastSquares().estimate(problem)
    assert estimate.profile is not None
    low, high = estimate.profile.interval[0]
    least = problem.objective(estimate.belief.mean[None])[0]
    half = np.linspace(0.01, 60.0, 60001)
    for end in (low, high):
        rows = np.column_stack([np.full(half.size, end), half])
        assert problem.objective(rows).min() - least == pytest.approx(RISE, rel=0.05)
    assert high - estimate.belief.mean[0] > 1.5 * (estimate.belief.mean[0] - low)  # which no curvature can say


def test_profiles_cover_what_they_promise():
    inside, wald = [], []
    for seed in range(150):
        problem = saturating(seed)
        at = descend(problem, np.array([4.0, 4.0]))
        cov = np.linalg.inv(at.normal)
        low, high = profile_intervals(problem, at, cov).interval[0]
        inside.append(low <= 4.0 <= high)
        wald.append(abs(at.theta[0] - 4.0) < 1.96 * np.sqrt(cov[0, 0]))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.05)  # 150 records: nearly three times 0.018


def test_an_end_that_the_data_leave_open_is_named():
    estimate = NonlinearLeastSquares().estimate(saturating(1, bounds=((0.0, 4.3), (0.0, 500.0))))
    assert estimate.status in ("weakly_identifiable", "at_bound")
    if estimate.status == "weakly_identifiable":
        assert "ceiling" in estimate.weak
        assert estimate.profile.open[0, 1]


def test_all_parameters_of_the_exchanger_are_profiled_in_few_evaluations():
    """Some 1,500 evaluations of 600 samples."""
    rng, k = np.random.default_rng(0), 600
    ranges = {"hot_flow_kg_s": (0.5, 1.2), "ram_flow_kg_s": (0.6, 2.4), "hot_in_k": (370, 430), "cold_in_k": (225, 280)}
    inputs = {name: rng.uniform(*limits, k) for name, limits in ranges.items()}
    clean = HEAT_EXCHANGER.predict({}, inputs)
    measured = {s.name: clean[s.name] + s.sigma * rng.standard_normal(k) for s in HEAT_EXCHANGER.outputs}
    free = [p.name for p in HEAT_EXCHANGER.free("design")]
    problem = declared_problem(HEAT_EXCHANGER, free, inputs, measured)
    estimate = NonlinearLeastSquares().estimate(problem)
    at = descend(problem, estimate.belief.mean)
    profile = profile_intervals(problem, at, estimate.belief.cov)
    assert profile.n_evals < 2_000
    nominal = np.array([HEAT_EXCHANGER.nominal[name] for name in free])
    assert ((profile.interval[:, 0] < nominal) & (nominal < profile.interval[:, 1])).sum() >= len(free) - 1
