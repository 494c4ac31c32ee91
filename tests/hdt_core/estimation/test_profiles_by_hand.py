"""Doubts about an optimum, profiles, conclusions and the worth of a sensor against one-line models."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import qmc

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


def bend(c, bounds=(-np.inf, np.inf), prior=None):
    """A cubic x + c x^3 seen as 0 with a sigma of 1, and its optimum."""
    problem = Problem(("x",), np.array([bounds]), prior or unknown(np.zeros(1)), np.zeros((1, 1)), np.ones(1),
                      lambda _x, t, i: (t[0] + c * t[0] ** 3 + 0.0 * i)[None])  # fmt: skip
    normal = np.ones((1, 1)) + problem.prior.information
    return problem, Point(np.zeros(1), 0.0, np.zeros(1), normal)


@pytest.mark.parametrize(
    ("c", "bounds", "variance", "has_prior", "bent"),
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
def test_bent_likelihood_is_nonquadratic(c, bounds, variance, has_prior, bent):
    problem, at = bend(c, bounds, Belief(np.zeros(1), np.array([[1e6]])) if has_prior else None)
    assert is_nonquadratic(problem, [at], np.array([variance])).tolist() == [bent]


def test_bend_shows_along_principal_axes():
    pair = Problem(
        ("x", "y", "z"),
        np.array([[-9.0, 9.0], [3.0, 3.0], [-9.0, 9.0]]),
        unknown(np.zeros(3)),
        np.zeros((2, 1)),
        np.ones(1),
        lambda _x, t, i: np.where(np.asarray(i) == 0, t[0] + t[2] + 0.1 * t[2] ** 3, 2.0 * t[2])[None],
    )
    at = Point(np.array([0.0, 3.0, 0.0]), 0.0, np.zeros(3), np.array([[1.0, 0, 1.0], [0, 0, 0], [1.0, 0, 5.0]]))
    assert not is_nonquadratic(pair, [at], np.ones(1))
    assert is_nonquadratic(pair, [replace(at, normal=np.array([[1.0, 0, 1.0], [0, 0, 0], [1.0, 0, 1.0]]))], np.ones(1))


def line(cloud=None, **more) -> Problem:
    x = np.linspace(-1.0, 2.0, 12)

    def observe(_x, theta, i):
        if cloud is not None:
            cloud.append(theta)
        return (theta[0] + theta[1] * x[i])[None]

    fields = {"names": ("offset", "slope"), "bounds": np.tile([-50.0, 50.0], (2, 1)), "prior": unknown(np.zeros(2)),
             "measured": (1.0 + 0.5 * x)[:, None], "sigma": np.array([0.1]), "observe": observe}  # fmt: skip
    return Problem(**(fields | more))


@pytest.mark.parametrize("variance", [1.0, 4.0])
def test_line_profile_equals_deviation(variance):
    cloud: list = []
    problem = line(cloud)
    at = descend(problem, np.zeros(2))
    cov = np.linalg.inv(at.normal)
    cloud.clear()
    half = np.sqrt(RISE * variance * np.diag(cov))
    assert pytest.approx(1.959964**2, rel=1e-6) == RISE
    profile = profile_intervals(problem, at, cov, variance)
    np.testing.assert_allclose(profile.interval, np.array([1.0, 0.5])[:, None] + np.outer(half, [-1.0, 1.0]), rtol=0.02)
    passes = sum(theta[0].size for theta in cloud)  # of which a descent's first look at its start is not counted
    assert 0.9 * passes < profile.n_evals <= passes
    assert not profile.open.any()
    assert profile.better is None
    fixed = profile_intervals(line(bounds=np.array([[-50.0, 50.0], [0.5, 0.5]])), at, cov, variance)
    np.testing.assert_allclose(fixed.interval[1], 0.5, rtol=1e-6)
    assert not fixed.open.any()
    wall = profile_intervals(line(bounds=np.array([[-50.0, 50.0], [-50.0, 0.51]])), at, cov, variance)
    assert (wall.interval[1, 1], wall.open.tolist()) == (0.51, [[False, False], [False, True]])
    wall = profile_intervals(line(bounds=np.array([[-50.0, 50.0], [0.49, 50.0]])), at, cov, variance)
    assert (wall.interval[1, 0], wall.open.tolist()) == (0.49, [[False, False], [True, False]])


def test_refit_follows_fixed_parameter():
    """The guess is the optimum of a straight line: two objectives, one linearisation, and no step."""
    problem = line()
    at = descend(problem, np.zeros(2))
    point = _refit_fixed(problem, at, 1, 0.7)
    theta = [1.0 - at.normal[0, 1] / at.normal[0, 0] * 0.2, 0.7]
    np.testing.assert_allclose(point.theta, theta, rtol=1e-9)
    assert point.n_evals == 2 + 5
    # The objective ((e^x - 1) / 0.6)^2 rises to 2.8 downwards, however far.
    problem = Problem(("x",), np.array([[-np.inf, np.inf]]), unknown(np.zeros(1)), np.ones((1, 1)), np.array([0.6]),
                      lambda _x, t, i: np.exp(t[0] + 0.0 * i)[None])  # fmt: skip
    at = descend(problem, np.zeros(1))
    profile = profile_intervals(problem, at, np.array([[0.36]]))
    assert (profile.interval[0, 0], profile.open.tolist(), profile.without_limit) == (-np.inf, [[True, False]], ("x",))
    # without a deviation the first stretch is the value's own size, at least 1
    for blind in (np.inf, 0.0):
        interval = profile_intervals(problem, at, np.array([[blind]])).interval
        np.testing.assert_allclose(interval, profile.interval, rtol=0.02)


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
    most: list = []
    problem = line()
    at = descend(line(), np.zeros(2))
    for name, answer in (("descend", at), ("descend_each", [at])):
        monkeypatch.setattr(
            optimum_checks, name, lambda p, start, steps, *spent, a=answer: (most.append((steps, *spent)), a)[1]
        )
    _refit_fixed(problem, at, 1, 0.7)
    better_optima(problem, [at])
    assert most == [(25, 2)] + [(60,)] * 4


@pytest.mark.parametrize(("sd", "ends"), [(1.01 / 2**11, True), (0.99 / 2**11, False)])
def test_interval_search_doubles_twelve_times(sd, ends):
    """x seen as 0 with a sigma of 1: the end is 1.96, the first stretch 1.96 of what is taken for sd."""
    problem, at = bend(0.0)
    profile = profile_intervals(problem, at, np.array([[sd**2]]))
    assert profile.open.tolist() == [[not ends] * 2]
    np.testing.assert_allclose(profile.interval, [[-1.96, 1.96]] if ends else [[-np.inf, np.inf]], rtol=0.02)


def test_search_starts_from_distinct_points():
    """Neighbours lie within a twentieth of the box in every direction; without an answer nothing is begun."""
    cloud = np.array([[0.0, 0.0], [0.049, 0.49], [0.051, 0.0], [0.0, 0.51], [0.5, 5.0], [0.9, 9.0], [1.0, 0.0]])
    objectives = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    width = np.array([1.0, 10.0])
    np.testing.assert_array_equal(_distinct_points(cloud, objectives, width), cloud[[0, 2, 3, 4]])
    np.testing.assert_array_equal(_distinct_points(cloud, objectives[::-1], width), cloud[[6, 5, 4, 3]])
    objectives[3:] = np.inf
    np.testing.assert_array_equal(_distinct_points(cloud, objectives, width), cloud[[0, 2]])
    np.testing.assert_array_equal(_distinct_points(cloud, objectives, width * [1.0, 0.0]), cloud[[0, 1, 2]])


def test_search_fills_the_box():
    """128 points for two or three free parameters; every other one at another order of magnitude of the present."""
    cloud: list = []
    bounds = np.array([[-50.0, 50.0], [-20.0, 50.0]])
    problem = line(cloud, bounds=bounds, prior=unknown(np.array([1.0, 0.0])))
    at = Point(np.array([1.0, 0.5]), float(problem.objective(np.array([[1.0, 0.5]]))[0]), np.zeros(2), np.eye(2))
    cloud.clear()
    (better, spent), *others = better_optima(problem, [at])
    unit = qmc.Sobol(2, rng=np.random.default_rng(0)).random_base2(7)
    starts = bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) * unit
    starts[::2] = at.theta * 10.0 ** (2.0 * unit[::2] - 1.0)
    np.testing.assert_allclose(cloud[0][:, :, 0].T, np.clip(starts, *bounds.T), rtol=1e-12)
    assert better.objective == pytest.approx(at.objective)
    assert (spent > 128 + 4 * 5, others) == (True, [])

    def has_better(gap: float) -> bool:
        return check_optima(problem, [replace(at, objective=gap)], np.array([1.0 + 1e-9]))[0].better is not None

    for gap, is_better in ((0.9e-4, False), (1e-4, False), (1.1e-4, True)):
        assert has_better(gap) is is_better
    assert least_improvement(1e-9) == 1e-6
    for n, points in ((1, 64), (3, 128), (4, 256), (8, 512), (16, 512)):
        tried: list = []
        many = Problem(
            tuple("abcdefghijklmnopq"[: n + 1]),
            np.array([[-1.0, 1.0]] * n + [[0.5, 0.5]]),
            unknown(np.zeros(n + 1)),
            np.zeros((1, 1)),
            np.ones(1),
            lambda _x, t, i, tried=tried: (tried.append(t), (t * t).sum(axis=0) + 0.0 * i)[1][None],
        )
        better_optima(many, [Point(np.full(n + 1, 0.5), 1.0, np.zeros(n + 1), np.eye(n + 1))])
        assert tried[0].shape[1] == points
        assert (tried[0][n] == 0.5).all()


X12 = np.linspace(-1.0, 2.0, 12)
A = np.column_stack([np.ones(12), X12]) / 0.1


@pytest.mark.parametrize(("off", "status"), [(0.93e-9, "converged"), (1.07e-9, "max_steps")])
def test_noiseless_optimum_is_met_to_rounding(off, status):
    theta = np.array([1.0 + off / np.linalg.norm(A[:, 0]), 0.5])
    assert conclude(line(), theta, "max_steps", 1).status == status


@pytest.mark.parametrize(("share", "status"), [(0.9, "at_bound"), (1.1, "converged")])
@pytest.mark.parametrize("side", [0, 1])
def test_bound_counts_within_thousandth_deviation(share, status, side):
    prior = Belief(np.array([1.0, 0.5]), 25.0 * np.eye(2))
    bounds = np.tile([-50.0, 50.0], (2, 1))
    sd = np.sqrt(np.diag(np.linalg.inv(A.T @ A + np.eye(2) / 25.0)))
    bounds[1, side] = 0.5 + (2 * side - 1) * share * 1e-3 * sd[1]
    assert conclude(line(prior=prior, bounds=bounds), np.array([1.0, 0.5]), "max_steps", 1).status == status
    assert conclude(line(prior=prior, bounds=bounds), np.array([1.1, 0.5]), "max_steps", 1).status == "max_steps"
    bounds[1] = 0.5  # a held parameter rests on no bound, another beside it may
    assert conclude(line(prior=prior, bounds=bounds), np.array([1.0, 0.5]), "max_steps", 1).status == "converged"
    bounds[0, side] = 1.0 + (2 * side - 1) * share * 1e-3 / np.sqrt(A[:, 0] @ A[:, 0] + 1.0 / 25.0)
    assert conclude(line(prior=prior, bounds=bounds), np.array([1.0, 0.5]), "max_steps", 1).status == status


@pytest.mark.parametrize(("half", "weak"), [(2.95, ("slope",)), (3.05, ())])
def test_estimate_wide_in_range_is_weak(half, weak):
    noise = 0.1 * np.where(np.arange(12) % 4 % 3 == 0, 1.0, -1.0)  # of the declared variance, across offset and slope
    problem = line(measured=(1.0 + 0.5 * X12 + noise)[:, None])
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


@pytest.mark.parametrize("own", [None, np.array([[0.02, 0.001], [0.001, 0.03]])])
def test_excess_residuals_widen_covariance(own):
    noise = 0.4 * np.where(np.arange(12) % 2 == 0, 1.0, -1.0)
    prior = Belief(np.array([1.0, 0.5]), np.diag([0.01, 0.02]))
    problem = line(measured=(1.0 + 0.5 * X12 + noise)[:, None], prior=prior)
    normal = A.T @ A + np.linalg.inv(prior.cov)
    mean = np.linalg.solve(normal, A.T @ problem.measured[:, 0] / 0.1 + np.linalg.inv(prior.cov) @ prior.mean)
    objective = problem.objective(mean[None])[0]
    wide = np.linalg.inv(A.T @ A / (objective / 10.0) + np.linalg.inv(prior.cov))
    estimate = conclude(problem, mean, "max_steps", 9, cov=own)
    added = 0.0 if own is None else own - np.linalg.inv(normal)
    np.testing.assert_allclose(estimate.belief.cov, wide + added, rtol=1e-6)
    assert (estimate.status, estimate.n_evals) == ("converged", 9)
    for share, status in ((0.98, "converged"), (1.02, "max_steps")):  # of half a thousandth of a deviation as it shows
        off = share * 5e-4 * np.sqrt(objective / 10.0 / normal[0, 0]) * np.array([1.0, 0.0])
        assert conclude(problem, mean + off, "max_steps", 9).status == status
    own_cov = conclude(problem, mean, "converged", 9, cov=own, own_objective=True)
    np.testing.assert_allclose(own_cov.belief.cov, np.linalg.inv(normal) if own is None else own, rtol=1e-6)
    assert np.isnan(own_cov.distance)


@pytest.mark.parametrize(("variance", "counted"), [(1.1, 1.1), (0.9, 1.0)])
def test_only_excess_variance_counts(variance, counted):
    """Four thousand of a constant, with a sigma of 1; residuals lie at both sides of it in turn."""
    y = np.sqrt(variance * 3999.0 / 4000.0) * (-1.0) ** np.arange(4000)
    problem = Problem(("x",), np.array([[-9.0, 9.0]]), unknown(np.zeros(1)), y[:, None], np.ones(1),
                      lambda _x, t, i: (t[0] + 0.0 * i)[None])  # fmt: skip
    estimate = NonlinearLeastSquares().estimate(problem)
    assert estimate.belief.cov[0, 0] == pytest.approx(counted / 4000.0)
    assert estimate.status == "converged"
