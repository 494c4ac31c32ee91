"""What an estimate says of its fit and what data can tell where the answer is known; profiles that run alone."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from compressor_problem import AREA_M2, BETA_RAD, DIAMETER_M, compressor
from small_problems import scalar_problem

from hdt_core.estimation import Belief, ExtendedKalman, NonlinearLeastSquares, Problem, UnscentedKalman, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.descent import descend
from hdt_core.estimation.fit import Identifiability, fisher, invert_information
from hdt_core.estimation.optimum_checks import RISE, profile_intervals
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER

X = np.linspace(0.0, 4.0, 80)


def line(noise=1.0, bend=0.0, seed=1, sigma=0.1):
    measured = 2.0 * X + 1.0 + bend * np.sin(3.0 * X) + noise * sigma * np.random.default_rng(seed).standard_normal(80)
    return Problem(
        names=("slope", "offset"),
        bounds=np.tile([-100.0, 100.0], (2, 1)),
        prior=unknown(np.zeros(2)),
        measured=measured[:, None],
        sigma=np.array([sigma]),
        observe=lambda _x, theta, i: (theta[0] * X[i] + theta[1])[None],
    )


@pytest.fixture(scope="module")
def sound():
    """Estimate of a line whose sigma is the true one."""
    return NonlinearLeastSquares().estimate(line())


def test_deviation_meets_cramer_rao_bound(sound):
    np.testing.assert_allclose(sound.belief.sd, sound.identifiability.bound_sd, rtol=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "nls", "converged", "chi-square", "reduced chi-square", "Akaike", "Bayesian", "model evaluations", "slope",
        "(init 0)", "C(slope, offset) = -0.86",  # of the design alone: -mean(x) / rms(x)
    ],
)  # fmt: skip
def test_summary_prints_what_lmfit_prints(sound, text):
    assert text in sound.summary()


def test_estimate_survives_pickling(sound):
    there = pickle.loads(pickle.dumps(sound))
    np.testing.assert_array_equal(there.fit.residuals, sound.fit.residuals)
    assert "chi-square" in there.summary()


def test_right_sigma_is_seldom_rejected():
    verdicts = [NonlinearLeastSquares().estimate(line(seed=seed)).fit.verdict for seed in range(400)]
    assert verdicts.count("adequate") >= 396  # 400 records, 2 in 1,000 each


def test_interval_follows_residual_scatter():
    """Beside a fixed parameter, of a sigma declared three times too small.

    The deviation is that of the residuals over the root of the sum of squares. Nine of ten intervals hold the truth:
    200 records, three times 0.021.
    """
    bounds = np.array([[-100.0, 100.0], [1.0, 1.0]])
    estimates = [NonlinearLeastSquares().estimate(replace(line(3.0, seed=k), bounds=bounds)) for k in range(200)]
    slope, sd = np.array([(e.belief.mean[0], e.belief.sd[0]) for e in estimates]).T
    scatter = [np.linalg.norm(e.fit.residuals) * 0.1 / np.sqrt(79) for e in estimates]
    np.testing.assert_allclose(sd, scatter / np.linalg.norm(X), rtol=1e-6)
    assert {e.belief.sd[1] for e in estimates} == {0.0}
    assert np.mean(np.abs(slope - 2.0) < 1.645 * sd) == pytest.approx(0.9, abs=0.065)


def follow_walk(drift):
    """A filter's estimate of a level that walks by 0.05."""
    rng = np.random.default_rng(3)
    level = 1.0 + np.cumsum(0.05 * rng.standard_normal(300))
    measured = level + 0.2 * rng.standard_normal(300)
    walk = scalar_problem(measured=measured, bounds=(-20.0, 20.0), start=1.0, sigma=0.2, drift=np.array([drift]))
    return ExtendedKalman().estimate(walk)


def test_innovations_accept_true_drift():
    right = follow_walk(0.05)
    assert (right.status, right.fit.verdict) == ("converged", "adequate")


def test_innovations_reject_small_drift():
    assert follow_walk(0.001).fit.verdict == "lack_of_fit"


def test_information_has_rank_one():
    information = fisher(compressor(), np.array([AREA_M2, DIAMETER_M, BETA_RAD]))
    assert not information.identifiable
    assert np.linalg.matrix_rank(information.scaled_information, tol=1e-6) == 1
    assert np.isinf(information.bound_sd).all()


def test_only_product_is_identifiable():
    estimate = NonlinearLeastSquares().estimate(compressor())
    assert estimate.status == "not_identifiable"
    product = estimate.belief.mean[0] * estimate.belief.mean[1] * np.tan(estimate.belief.mean[2])
    assert product == pytest.approx(AREA_M2 * DIAMETER_M * np.tan(BETA_RAD), rel=0.02)


def test_prior_closes_open_direction():
    sd = np.array([0.001, 0.01, np.deg2rad(2.0)])
    estimate = NonlinearLeastSquares().estimate(compressor(Belief(np.array([0.0098, 0.11, 0.63]), np.diag(sd**2))))
    assert estimate.status == "converged"
    assert not estimate.identifiability.identifiable  # what the data alone say does not change
    assert (estimate.belief.sd < sd).all()


@pytest.mark.parametrize(("gap", "is_observable"), [(2.1e-14, True), (1.9e-14, False)])
def test_condition_decides_observability(gap, is_observable):
    # eigenvalues of [[1, c], [c, 1]] are 1 + c and 1 - c: a condition of 2 / gap
    information = np.array([[1.0, 1.0 - gap], [1.0 - gap, 1.0]])
    cov, observable = invert_information(information)
    assert observable is is_observable
    assert np.isfinite(cov).all() == is_observable
    assert Identifiability(("a", "b"), information).identifiable is is_observable


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
def test_near_equal_exponentials_stay_open(estimator):
    statuses = {estimator.estimate(near_equal(seed)).status for seed in range(8)}
    assert "converged" not in statuses
    assert statuses & {"weakly_identifiable", "not_identifiable"}


def test_prior_separates_near_equal_exponentials():
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


def test_profile_ends_where_objective_rises():
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


def test_open_profile_is_named():
    estimate = NonlinearLeastSquares().estimate(saturating(1, bounds=((0.0, 4.3), (0.0, 500.0))))
    assert (estimate.status, estimate.weak) == ("weakly_identifiable", ("ceiling",))
    assert estimate.profile.open.tolist() == [[False, True], [False, False]]


def test_profiles_cover_at_stated_rate():
    inside = []
    wald = []
    for seed in range(150):
        problem = saturating(seed)
        at = descend(problem, np.array([4.0, 4.0]))
        cov = np.linalg.inv(at.normal)
        low, high = profile_intervals(problem, at, cov).interval[0]
        inside.append(low <= 4.0 <= high)
        wald.append(abs(at.theta[0] - 4.0) < 1.96 * np.sqrt(cov[0, 0]))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.05)  # 150 records: nearly three times 0.018


def test_exchanger_profiles_need_few_evaluations():
    """Some 1,500 evaluations of 600 samples."""
    rng = np.random.default_rng(0)
    k = 600
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
