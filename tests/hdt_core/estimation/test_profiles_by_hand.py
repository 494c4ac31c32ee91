"""Doubts about an optimum, profiles, conclusions and the worth of a sensor against one-line models."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import qmc
from small_problems import SLOPES, X, line_through, scalar_problem

from hdt_core.estimation import Belief, NonlinearLeastSquares, Problem, optimum_checks, unknown
from hdt_core.estimation.conclude import conclude
from hdt_core.estimation.descent import Point, descend
from hdt_core.estimation.optimum_checks import (
    RISE,
    _crossing,
    _distinct_points,
    _refit_fixed,
    better_optima,
    check_optima,
    is_nonquadratic,
    least_improvement,
    profile_intervals,
)


def bend(c, bounds=(-np.inf, np.inf), **more):
    """A cubic x + c x^3 seen as 0 with a sigma of 1, and its optimum."""
    problem = scalar_problem(lambda x: x + c * x**3, bounds=bounds, **more)
    normal = np.ones((1, 1)) + problem.prior.information
    return problem, Point(np.zeros(1), 0.0, np.zeros(1), normal)


@pytest.mark.parametrize(
    ("c", "bounds", "variance", "has_prior", "is_bent"),
    [
        # (1 + 4 c)^2 against 2 and a half
        (0.102, (-9, 9), 1.0, False, False), (0.105, (-9, 9), 1.0, False, True),
        (-0.072, (-9, 9), 1.0, False, False), (-0.075, (-9, 9), 1.0, False, True),
        # four times the variance, twice as far
        (0.102 / 4, (-9, 9), 4.0, False, False), (0.105 / 4, (-9, 9), 4.0, False, True),
        # a bound within two deviations, unless a prior closes the end
        (0.0, (-2.01, 9), 1.0, False, False), (0.0, (-1.99, 9), 1.0, False, True), (0.0, (-9, 1.99), 1.0, False, True),
        (0.0, (-1.99, 9), 1.0, True, False), (0.0, (-3.9, 9), 4.0, False, True),
        # an end cut short shows nothing below 0.4 of the objective
        (2.0, (-0.62, 0.62), 1.0, True, False), (2.0, (-0.65, 0.65), 1.0, True, True),
        (2.0, (-0.62, 0.65), 1.0, True, True), (2.0, (-1.24, 1.24), 4.0, True, False),
    ],
)  # fmt: skip
def test_bent_likelihood_is_nonquadratic(c, bounds, variance, has_prior, is_bent):
    """From half or twice the rise that the curvature foresees."""
    problem, at = bend(c, bounds, **({"prior": Belief(np.zeros(1), np.array([[1e6]]))} if has_prior else {}))
    assert is_nonquadratic(problem, [at], np.array([variance])).tolist() == [is_bent]


@pytest.mark.parametrize(("second", "is_bent"), [(5.0, False), (1.0, True)])
def test_bend_shows_along_principal_axes(second, is_bent):
    """Beside a fixed parameter."""
    pair = Problem(
        ("x", "y", "z"),
        np.array([[-9.0, 9.0], [3.0, 3.0], [-9.0, 9.0]]),
        unknown(np.zeros(3)),
        np.zeros((2, 1)),
        np.ones(1),
        lambda _x, t, i: np.where(np.asarray(i) == 0, t[0] + t[2] + 0.1 * t[2] ** 3, 2.0 * t[2])[None],
    )
    at = Point(np.array([0.0, 3.0, 0.0]), 0.0, np.zeros(3), np.array([[1.0, 0, 1.0], [0, 0, 0], [1.0, 0, second]]))
    assert is_nonquadratic(pair, [at], np.ones(1)) == is_bent


def line(cloud=None, **more) -> Problem:
    """A straight line without noise; `cloud` gathers the parameters that are tried."""
    problem = line_through(1.0 + 0.5 * X, **more)
    if cloud is None:
        return problem
    return replace(problem, observe=lambda x, theta, i: (cloud.append(theta), problem.observe(x, theta, i))[1])


OPTIMUM = descend(line(), np.zeros(2))
COV = np.linalg.inv(OPTIMUM.normal)


def test_rise_is_that_of_95_percent():
    assert pytest.approx(1.959964**2, rel=1e-6) == RISE


@pytest.mark.parametrize("variance", [1.0, 4.0])
def test_line_profile_equals_deviation(variance):
    half = np.sqrt(RISE * variance * np.diag(COV))
    profile = profile_intervals(line(), OPTIMUM, COV, variance)
    np.testing.assert_allclose(profile.interval, np.array([1.0, 0.5])[:, None] + np.outer(half, [-1.0, 1.0]), rtol=0.02)
    assert not profile.open.any()
    assert profile.better is None


@pytest.mark.parametrize("variance", [1.0, 4.0])
def test_profile_counts_its_passes(variance):
    """But for a descent's first look at its start."""
    cloud: list = []
    profile = profile_intervals(line(cloud), OPTIMUM, COV, variance)
    passes = sum(theta[0].size for theta in cloud)
    assert 0.9 * passes < profile.n_evals <= passes


@pytest.mark.parametrize("variance", [1.0, 4.0])
def test_fixed_parameter_has_closed_profile(variance):
    profile = profile_intervals(line(bounds=np.array([[-50.0, 50.0], [0.5, 0.5]])), OPTIMUM, COV, variance)
    np.testing.assert_allclose(profile.interval[1], 0.5, rtol=1e-6)
    assert not profile.open.any()


@pytest.mark.parametrize("variance", [1.0, 4.0])
@pytest.mark.parametrize(("bounds", "side"), [((-50.0, 0.51), 1), ((0.49, 50.0), 0)])
def test_profile_is_open_at_bound(variance, bounds, side):
    profile = profile_intervals(line(bounds=np.array([[-50.0, 50.0], bounds])), OPTIMUM, COV, variance)
    assert profile.interval[1, side] == bounds[side]
    assert profile.open.tolist() == [[False, False], [side == 0, side == 1]]


def test_refit_follows_fixed_parameter():
    """The guess is the optimum of a straight line: two objectives, one linearisation, and no step."""
    point = _refit_fixed(line(), OPTIMUM, 1, 0.7)
    theta = [1.0 - OPTIMUM.normal[0, 1] / OPTIMUM.normal[0, 0] * 0.2, 0.7]
    np.testing.assert_allclose(point.theta, theta, rtol=1e-9)
    assert point.n_evals == 2 + 5


@pytest.mark.parametrize("variance", [0.36, np.inf, 0.0])
def test_flat_side_has_no_limit(variance):
    """The objective ((e^x - 1) / 0.6)^2 rises to 2.8 downwards, however far, and by 3.84 where e^x is 1 + 1.96 * 0.6.

    Without a deviation the first stretch is the value's own size, at least 1.
    """
    problem = scalar_problem(np.exp, 1.0, sigma=0.6)
    profile = profile_intervals(problem, descend(problem, np.zeros(1)), np.array([[variance]]))
    np.testing.assert_allclose(profile.interval, [[-np.inf, np.log(1.0 + 1.96 * 0.6)]], rtol=0.02)
    assert (profile.open.tolist(), profile.without_limit) == ([[True, False]], ("x",))


def crossing_by_hand(rise, near, far, target):
    """False position on the root of the rise: six at most, never in the last twentieth of the bracket, to 2 %."""
    low = rise(near)
    high = rise(far)
    trials = []
    for _ in range(6):
        share = (target**0.5 - low**0.5) / (high**0.5 - low**0.5) if high < np.inf else 0.5
        trials.append(near + (far - near) * min(max(share, 0.05), 0.95))
        now = rise(trials[-1])
        if abs((now / target) ** 0.5 - 1.0) < 0.02:
            return trials[-1], trials
        near, low, far, high = (trials[-1], now, far, high) if now < target else (near, low, trials[-1], now)
    return far, trials


@pytest.mark.parametrize(
    "rise",
    [
        lambda x: x**2, lambda x: x**4, lambda x: x**1.5, lambda x: 3.84 * (1.0 + 0.9 * (x - 1.9)) if x > 1.9 else 0.01,
        lambda x: 99.0 if x > 1.1 else 1e-4, lambda x: np.inf if x > 2.0 else x**2, lambda x: 40.0 * x**8,
        lambda x: np.inf if x > 1.2 else 0.0,
        *(lambda x, off=off: 3.84 * (1.0 + off) ** 2 * (x / 1.96) ** 2 if 1.5 < x < 2.9 else x**2
          for off in (0.018, 0.022, -0.018, -0.022)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_crossing_uses_false_position(monkeypatch, rise, sign):
    trials: list = []

    def refit(_problem, near, i, value):
        assert near.objective < np.inf  # from the optimum, where the model failed the last time
        trials.append(sign * (value - 0.5))
        return Point(near.theta, 7.0 + rise(trials[-1]), np.zeros(1), np.eye(1), 10)

    monkeypatch.setattr(optimum_checks, "_refit_fixed", refit)
    at = Point(np.array([0.5]), 7.0, np.zeros(1), np.eye(1))
    bracket = ((1.0, rise(1.0)), (3.0, rise(3.0)))
    end, passes = _crossing(bend(0.0)[0], at, at, (0, sign), bracket, 3.84)
    want, visits = crossing_by_hand(rise, 1.0, 3.0, 3.84)
    np.testing.assert_allclose(trials, visits, rtol=1e-9)
    assert (end, passes) == (pytest.approx(want), 10 * len(visits))


def test_checks_limit_their_steps(monkeypatch):
    """Refits twenty-five, descents sixty."""
    steps: list = []
    for name, answer in (("descend", OPTIMUM), ("descend_each", [OPTIMUM])):
        monkeypatch.setattr(
            optimum_checks, name, lambda p, start, most, *spent, a=answer: (steps.append((most, *spent)), a)[1]
        )
    _refit_fixed(line(), OPTIMUM, 1, 0.7)
    better_optima(line(), [OPTIMUM])
    assert steps == [(25, 2)] + [(60,)] * 4


@pytest.mark.parametrize(("sd", "ends"), [(1.01 / 2**11, True), (0.99 / 2**11, False)])
def test_interval_search_doubles_twelve_times(sd, ends):
    """x seen as 0 with a sigma of 1: the end is 1.96, the first stretch 1.96 of what is taken for sd."""
    problem, at = bend(0.0)
    profile = profile_intervals(problem, at, np.array([[sd**2]]))
    assert profile.open.tolist() == [[not ends] * 2]
    np.testing.assert_allclose(profile.interval, [[-1.96, 1.96]] if ends else [[-np.inf, np.inf]], rtol=0.02)


OBJECTIVES = np.arange(1.0, 8.0)


@pytest.mark.parametrize(
    ("objectives", "width", "chosen"),
    [
        (OBJECTIVES, [1.0, 10.0], [0, 2, 3, 4]),
        (OBJECTIVES[::-1], [1.0, 10.0], [6, 5, 4, 3]),
        (np.where(OBJECTIVES > 3.0, np.inf, OBJECTIVES), [1.0, 10.0], [0, 2]),
        (np.where(OBJECTIVES > 3.0, np.inf, OBJECTIVES), [1.0, 0.0], [0, 1, 2]),
    ],
)
def test_search_starts_from_distinct_points(objectives, width, chosen):
    """The best four; neighbours lie within a twentieth of the box in every direction; no start without an answer."""
    cloud = np.array([[0.0, 0.0], [0.049, 0.49], [0.051, 0.0], [0.0, 0.51], [0.5, 5.0], [0.9, 9.0], [1.0, 0.0]])
    np.testing.assert_array_equal(_distinct_points(cloud, objectives, np.array(width)), cloud[chosen])


BOX = np.array([[-50.0, 50.0], [-20.0, 50.0]])
AT_TRUTH = np.array([1.0, 0.5])


def searched_line(cloud=None) -> tuple[Problem, Point]:
    """A line in a box, and its optimum."""
    problem = line(cloud, bounds=BOX, prior=unknown(np.array([1.0, 0.0])))
    return problem, Point(AT_TRUTH, float(problem.objective(AT_TRUTH[None])[0]), np.zeros(2), np.eye(2))


def test_search_fills_the_box():
    """128 points; every other one at another order of magnitude of the present."""
    cloud: list = []
    problem, at = searched_line(cloud)
    cloud.clear()
    better_optima(problem, [at])
    unit = qmc.Sobol(2, rng=np.random.default_rng(0)).random_base2(7)
    starts = BOX[:, 0] + (BOX[:, 1] - BOX[:, 0]) * unit
    starts[::2] = at.theta * 10.0 ** (2.0 * unit[::2] - 1.0)
    np.testing.assert_allclose(cloud[0][:, :, 0].T, np.clip(starts, *BOX.T), rtol=1e-12)


def test_search_returns_the_only_optimum():
    problem, at = searched_line()
    ((better, spent),) = better_optima(problem, [at])
    assert better.objective == pytest.approx(at.objective)
    assert spent > 128 + 4 * 5


@pytest.mark.parametrize(("gap", "is_better"), [(0.9e-4, False), (1e-4, False), (1.1e-4, True)])
def test_better_optimum_is_lower_by_noise(gap, is_better):
    """By a ten-thousandth of its variance."""
    problem, at = searched_line()
    (check,) = check_optima(problem, [replace(at, objective=gap)], np.array([1.0 + 1e-9]))
    assert (check.better is not None) is is_better


def test_least_improvement_is_a_millionth():
    assert least_improvement(1e-9) == 1e-6


@pytest.mark.parametrize(("n", "points"), [(1, 64), (3, 128), (4, 256), (8, 512), (16, 512)])
def test_search_grows_with_free_parameters(n, points):
    cloud: list = []
    many = Problem(
        tuple("abcdefghijklmnopq"[: n + 1]),
        np.array([[-1.0, 1.0]] * n + [[0.5, 0.5]]),
        unknown(np.zeros(n + 1)),
        np.zeros((1, 1)),
        np.ones(1),
        lambda _x, t, i: (cloud.append(t), (t * t).sum(axis=0) + 0.0 * i)[1][None],
    )
    better_optima(many, [Point(np.full(n + 1, 0.5), 1.0, np.zeros(n + 1), np.eye(n + 1))])
    assert cloud[0].shape[1] == points
    assert (cloud[0][n] == 0.5).all()


@pytest.mark.parametrize(("off", "status"), [(0.93e-9, "converged"), (1.07e-9, "max_steps")])
def test_noiseless_optimum_is_met_to_rounding(off, status):
    theta = np.array([1.0 + off / np.linalg.norm(SLOPES[:, 0]), 0.5])
    assert conclude(line(), theta, "max_steps", 1).status == status


@pytest.fixture(params=[(0.9, "at_bound"), (1.1, "converged")], ids=["near", "far"])
def near_bound(request):
    """A share of a thousandth of a deviation by which an optimum lies off its bound, and its status."""
    return request.param


PRIOR = Belief(np.array([1.0, 0.5]), 25.0 * np.eye(2))


@pytest.mark.parametrize("side", [0, 1])
def test_bound_counts_within_thousandth_deviation(near_bound, side):
    share, status = near_bound
    bounds = np.tile([-50.0, 50.0], (2, 1))
    sd = np.sqrt(np.diag(np.linalg.inv(SLOPES.T @ SLOPES + np.eye(2) / 25.0)))
    bounds[1, side] = 0.5 + (2 * side - 1) * share * 1e-3 * sd[1]
    problem = line(prior=PRIOR, bounds=bounds)
    assert conclude(problem, np.array([1.0, 0.5]), "max_steps", 1).status == status
    assert conclude(problem, np.array([1.1, 0.5]), "max_steps", 1).status == "max_steps"


def test_fixed_parameter_rests_on_no_bound():
    problem = line(prior=PRIOR, bounds=np.array([[-50.0, 50.0], [0.5, 0.5]]))
    assert conclude(problem, np.array([1.0, 0.5]), "max_steps", 1).status == "converged"


@pytest.mark.parametrize("side", [0, 1])
def test_bound_counts_beside_fixed_parameter(near_bound, side):
    share, status = near_bound
    bounds = np.array([[-50.0, 50.0], [0.5, 0.5]])
    bounds[0, side] = 1.0 + (2 * side - 1) * share * 1e-3 / np.sqrt(SLOPES[:, 0] @ SLOPES[:, 0] + 1.0 / 25.0)
    assert conclude(line(prior=PRIOR, bounds=bounds), np.array([1.0, 0.5]), "max_steps", 1).status == status


@pytest.mark.parametrize(("half", "weak"), [(2.95, ("slope",)), (3.05, ())])
def test_estimate_wide_in_range_is_weak(half, weak):
    """Data that leave six deviations in the range have hardly narrowed it."""
    noise = 0.1 * np.where(np.arange(12) % 4 % 3 == 0, 1.0, -1.0)  # of the declared variance, across offset and slope
    problem = line_through(1.0 + 0.5 * X + noise)
    estimate = NonlinearLeastSquares().estimate(problem)
    assert estimate.n_checks == 4  # either end of two axes
    mean = estimate.belief.mean
    sd = estimate.belief.sd
    bounds = np.array([[-50.0, 50.0], [mean[1] - half * sd[1], mean[1] + half * sd[1]]])
    assert NonlinearLeastSquares().estimate(replace(problem, bounds=bounds)).weak == weak


@pytest.mark.parametrize(
    ("samples", "rho", "has_profile"), [(200, 0.5, True), (202, 0.5, False), (202, 0.705, False), (202, 0.709, True)]
)
def test_many_values_need_no_profile(samples, rho, has_profile):
    """A hundred values a parameter and a determinant 1 - rho^2 of a half: the bend is then not looked for."""
    wave = np.sqrt(2.0 / samples) * np.cos(2.0 * np.pi * np.outer([1.0, 2.0, 3.0], np.arange(samples)) / samples)
    u = wave[0]
    v = rho * wave[0] + np.sqrt(1.0 - rho**2) * wave[1]
    problem = Problem(("a", "b"), np.tile([-50.0, 50.0], (2, 1)), unknown(np.zeros(2)),
                      np.sqrt(samples) * wave[2][:, None], np.ones(1),
                      lambda _x, t, i: (u[i] * (t[0] + 0.5 * t[0] ** 3) + v[i] * t[1])[None])  # fmt: skip
    estimate = NonlinearLeastSquares().estimate(problem)
    assert (estimate.status, estimate.profile is not None) == ("converged", has_profile)
    assert (estimate.n_checks > 0, estimate.n_checks < 0) == (has_profile, False)


@pytest.fixture(params=[None, np.array([[0.02, 0.001], [0.001, 0.03]])], ids=["laplace", "own"])
def own_cov(request):
    """Covariance of a method's own, or none."""
    return request.param


NOISY = line_through(
    1.0 + 0.5 * X + 0.4 * np.where(np.arange(12) % 2 == 0, 1.0, -1.0),
    prior=Belief(np.array([1.0, 0.5]), np.diag([0.01, 0.02])),
)
"""Residuals of four times the declared sigma."""
NOISY_NORMAL = SLOPES.T @ SLOPES + NOISY.prior.information
NOISY_MEAN = np.linalg.solve(NOISY_NORMAL, SLOPES.T @ NOISY.measured[:, 0] / 0.1 + NOISY.prior.information @ [1.0, 0.5])
EXCESS = NOISY.objective(NOISY_MEAN[None])[0] / 10.0


def test_excess_residuals_widen_covariance(own_cov):
    """The data count by the variance that they show, the prior as it is."""
    wide = np.linalg.inv(SLOPES.T @ SLOPES / EXCESS + NOISY.prior.information)
    estimate = conclude(NOISY, NOISY_MEAN, "max_steps", 9, cov=own_cov)
    added = 0.0 if own_cov is None else own_cov - np.linalg.inv(NOISY_NORMAL)
    np.testing.assert_allclose(estimate.belief.cov, wide + added, rtol=1e-6)
    assert (estimate.status, estimate.n_evals) == ("converged", 9)


@pytest.mark.parametrize(("share", "status"), [(0.98, "converged"), (1.02, "max_steps")])
def test_optimum_is_met_by_shown_deviation(own_cov, share, status):
    """Within half a thousandth of it."""
    off = share * 5e-4 * np.sqrt(EXCESS / NOISY_NORMAL[0, 0]) * np.array([1.0, 0.0])
    assert conclude(NOISY, NOISY_MEAN + off, "max_steps", 9, cov=own_cov).status == status


def test_own_objective_keeps_its_covariance(own_cov):
    estimate = conclude(NOISY, NOISY_MEAN, "converged", 9, cov=own_cov, own_objective=True)
    expected = np.linalg.inv(NOISY_NORMAL) if own_cov is None else own_cov
    np.testing.assert_allclose(estimate.belief.cov, expected, rtol=1e-6)
    assert np.isnan(estimate.distance)


@pytest.mark.parametrize(("variance", "counted"), [(1.1, 1.1), (0.9, 1.0)])
def test_only_excess_variance_counts(variance, counted):
    """Four thousand values of a constant, with a sigma of 1; residuals lie at both sides of it in turn."""
    y = np.sqrt(variance * 3999.0 / 4000.0) * (-1.0) ** np.arange(4000)
    estimate = NonlinearLeastSquares().estimate(scalar_problem(measured=y, bounds=(-9.0, 9.0)))
    assert estimate.belief.cov[0, 0] == pytest.approx(counted / 4000.0)
    assert estimate.status == "converged"
