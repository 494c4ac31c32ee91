"""Linear cases: both filters are the Kalman filter, to eight digits, on series that others have filtered."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints
from filterpy.kalman import UnscentedKalmanFilter as FilterpyUnscented
from scipy.stats import multivariate_normal

from hdt_benchmark.spring_mass_damper import oscillator_problem
from hdt_core.estimation import Belief, ExtendedKalman, Problem, UnscentedKalman, unknown
from hdt_core.estimation.kalman import forward, smooth
from hdt_core.estimation.kalman_step import regression, tangent, upper_root

FOLDER = Path(__file__).parents[2] / "data" / "kalman"
NOTHING = Belief(np.empty(0), np.empty((0, 0)))


def sigma_points(j):
    points = MerweScaledSigmaPoints(j, 1.0, 0.0, 0.0, sqrt_method=upper_root)
    return lambda *args: regression(points, *args)


METHODS = pytest.mark.parametrize("method", ["tangent", "sigma points"])


def linearisation(method, j):
    return tangent if method == "tangent" else sigma_points(j)


def linear_problem(F, H, start, measured, *, sigma, process_sd):
    return Problem(
        names=(),
        bounds=np.empty((0, 2)),
        prior=NOTHING,
        measured=measured,
        sigma=sigma,
        observe=lambda x, _theta, _i: H @ x,
        transition=lambda x, _theta, _i: F @ x,
        start=start,
        process_sd=process_sd,
    )


def nile(start_variance):
    volume = np.loadtxt(FOLDER / "nile.csv", delimiter=",", skiprows=1)[:, 1:]
    one = np.ones((1, 1))
    return linear_problem(
        one,
        one,
        Belief(np.zeros(1), start_variance * one),
        volume,
        sigma=np.sqrt([15099.0]),
        process_sd=np.sqrt([1469.1]),
    )


def log_likelihoods(filtered) -> list[float]:
    """Of each sample given those before it, from the filter's innovations and their precisions."""
    return [
        multivariate_normal.logpdf(c.innovation, cov=np.linalg.inv(c.precision)) if c.innovation.size else 0.0
        for c in filtered.corrections
    ]


def log_likelihoods_of(problem, method):
    return log_likelihoods(forward(problem, linearisation(method, 1)))


@METHODS
def test_nile_likelihood_from_wide_start(method):
    """Variance 1e6 about zero, the first sample's term left out: statsmodels' approximate diffuse start."""
    assert sum(log_likelihoods_of(nile(1e6), method)[1:]) == pytest.approx(-632.537695048, abs=1e-8)


@METHODS
def test_nile_likelihood_from_diffuse_start(method):
    """The limit of an infinite variance: the first sample is the level, to its own noise; -632.5456 by KFAS in R."""
    problem = nile(1.0)
    start = Belief(problem.measured[0], np.array([[15099.0 + 1469.1]]))
    rest = replace(problem, start=start, measured=problem.measured[1:])
    assert sum(log_likelihoods_of(rest, method)) == pytest.approx(-632.5456, abs=5e-5)


@METHODS
def test_clark_states_equal_r(method):
    data = np.loadtxt(FOLDER / "clark1989.csv", delimiter=",")[4:]
    expected = np.loadtxt(FOLDER / "results_clark1989_R.csv", delimiter=",", skiprows=1)[:, 1:]
    measured = np.column_stack([np.log(data[:, 0]), data[:, 1] / 100.0])
    measured[-51:, 1] = np.nan
    p = [0.004863, 0.00668, 0.000295, 0.001518, 0.000306, 1.43859, -0.517385, -0.336789, -0.163511, -0.072012]
    H = np.array([[1, 1, 0, 0, 0, 0], [0, p[7], p[8], p[9], 0, 1]])
    F = np.eye(6, k=-1)
    F[0] = [1, 0, 0, 0, 1, 0]
    F[1] = [0, p[5], p[6], 0, 0, 0]
    F[4] = [0, 0, 0, 0, 1, 0]
    F[5] = [0, 0, 0, 0, 0, 1]
    start = Belief(np.zeros(6), F @ (100.0 * np.eye(6)) @ F.T)
    noise = np.array([p[0], p[1], 0.0, 0.0, p[2], p[3]])
    problem = linear_problem(F, H, start, measured, sigma=np.array([1e-9, p[4]]), process_sd=noise)
    filtered = forward(problem, linearisation(method, 6))
    np.testing.assert_allclose(filtered.means @ F.T, expected, atol=1e-8)
    assert sum(log_likelihoods(filtered)) == pytest.approx(1232.113456, rel=1e-7)


def draw_record(seed, process_sd):
    rng = np.random.default_rng(seed)
    F = np.array([[1.0, 0.1, 0.0], [-0.05, 0.95, 0.1], [0.0, 0.0, 0.9]])
    H = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]])
    start = Belief(np.array([1.0, -1.0, 0.5]), np.array([[1.0, 0.2, 0.0], [0.2, 0.5, 0.1], [0.0, 0.1, 2.0]]))
    sigma = np.array([0.3, 0.7])
    problem = linear_problem(F, H, start, rng.normal(0.0, 1.0, (80, 2)), sigma=sigma, process_sd=np.array(process_sd))
    return problem, F, H


@METHODS
def test_linear_filter_equals_filterpy(method):
    problem, F, H = draw_record(3, [0.1, 0.0, 0.2])
    ours = forward(problem, linearisation(method, 3))
    peer = KalmanFilter(dim_x=3, dim_z=2)
    peer.x = problem.start.mean[:, None]
    peer.P = problem.start.cov
    peer.F = F
    peer.H = H
    peer.R = np.diag(problem.sigma**2)
    peer.Q = np.diag(problem.process_sd**2)
    for k, row in enumerate(problem.measured):
        peer.update(row[:, None])
        np.testing.assert_allclose(ours.means[k], peer.x[:, 0], atol=1e-8)
        np.testing.assert_allclose(ours.covs[k], peer.P, atol=1e-8)
        peer.predict()


@METHODS
def test_smoother_equals_joint_solution(method):
    """Of the linear equations of all samples at once."""
    problem, F, H = draw_record(4, [0.1, 0.05, 0.2])
    ours = smooth(forward(problem, linearisation(method, 3)))
    k = len(problem.measured)
    s = 3
    information = np.zeros((k * s, k * s))
    vector = np.zeros(k * s)
    information[:s, :s] = np.linalg.inv(problem.start.cov)
    vector[:s] = information[:s, :s] @ problem.start.mean
    for i in range(k):
        here = slice(i * s, (i + 1) * s)
        information[here, here] += H.T @ np.diag(problem.sigma**-2.0) @ H
        vector[here] += H.T @ (problem.measured[i] / problem.sigma**2)
        if i + 1 < k:
            step = np.hstack([F, -np.eye(s)])
            both = slice(i * s, (i + 2) * s)
            information[both, both] += step.T @ np.diag(problem.process_sd**-2.0) @ step
    cov = np.linalg.inv(information)
    np.testing.assert_allclose([b.mean for b in ours], (cov @ vector).reshape(k, s), atol=1e-8)
    blocks = cov.reshape(k, s, k, s)[np.arange(k), :, np.arange(k)]
    np.testing.assert_allclose([b.cov for b in ours], blocks, atol=1e-8)


@METHODS
def test_last_sample_is_smoothed_as_filtered(method):
    problem, *_ = draw_record(4, [0.1, 0.05, 0.2])
    filtered = forward(replace(problem, measured=problem.measured[:1]), linearisation(method, 3))
    (alone,) = smooth(filtered)
    np.testing.assert_allclose(alone.cov, filtered.covs[0], atol=1e-12)


each_filter = pytest.mark.parametrize("estimator", [ExtendedKalman(), UnscentedKalman()], ids=lambda e: e.name)


def regression_problem():
    rng = np.random.default_rng(8)
    slope = rng.normal(size=(60, 2))
    measured = slope @ np.array([1.5, -0.7]) + 0.2 * rng.standard_normal(60)
    free = np.tile([-np.inf, np.inf], (2, 1))
    return slope, Problem(
        names=("a", "b"),
        bounds=free,
        prior=Belief(np.array([0.3, 0.1]), np.diag([4.0, 1.0])),
        measured=measured[:, None],
        sigma=np.array([0.2]),
        observe=lambda _x, theta, i: (slope[i, 0] * theta[0] + slope[i, 1] * theta[1])[None],
    )


@each_filter
def test_linear_filter_equals_least_squares(estimator):
    slope, problem = regression_problem()
    information = slope.T @ slope / 0.04 + np.linalg.inv(problem.prior.cov)
    right = slope.T @ problem.measured[:, 0] / 0.04 + np.linalg.inv(problem.prior.cov) @ problem.prior.mean
    estimate = estimator.estimate(problem)
    np.testing.assert_allclose(estimate.belief.mean, np.linalg.solve(information, right), atol=1e-8)
    np.testing.assert_allclose(estimate.belief.cov, np.linalg.inv(information), atol=1e-8)
    np.testing.assert_allclose(estimate.identifiability.information, slope.T @ slope / 0.04, rtol=1e-6, atol=1e-6)


def test_unscented_filter_equals_filterpy():
    problem = oscillator_problem(5, compiled=False)
    start = Belief(problem.start.mean, np.diag([1e-4, 1e-4]))
    # filterpy keeps no bounds: the guess lies far enough inside them here
    prior = Belief(np.array([0.6, 1.8]), np.diag([0.05, 0.1]) ** 2)
    problem = replace(problem, start=start, measured=problem.measured[:200]).with_prior(prior)
    ours = forward(problem, sigma_points(4))
    points = MerweScaledSigmaPoints(4, 1.0, 0.0, 0.0)
    state = {"i": 0}

    def step(z, _dt):
        return np.concatenate([problem.transition(z[:2], z[2:], state["i"]), z[2:]])

    peer = FilterpyUnscented(4, 1, dt=0.01, hx=lambda z: z[:1], fx=step, points=points)
    peer.x = np.array([0.0, 0.0, 0.6, 1.8])
    peer.P = np.diag([1e-4, 1e-4, 0.05**2, 0.1**2])
    peer.R = problem.sigma[:, None] ** 2
    peer.Q = np.zeros((4, 4))
    peer.sigmas_f = points.sigma_points(peer.x, peer.P)
    for i, row in enumerate(problem.measured):
        state["i"] = i
        peer.update(row)
        np.testing.assert_allclose(ours.means[i], peer.x, atol=1e-8)
        peer.predict()


def test_indefinite_covariance_has_a_root():
    indefinite = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(indefinite)
    root = upper_root(indefinite)
    np.testing.assert_allclose(root.T @ root, indefinite, atol=1e-6)


def test_zero_variance_has_a_root():
    root = upper_root(np.diag([0.0, 4.0]))
    assert (np.diag(root) > 0.0).all()
    np.testing.assert_allclose(root.T @ root, np.diag([0.0, 4.0]), atol=1e-9)


@each_filter
def test_flat_prior_recovers_parameters(estimator):
    _, problem = regression_problem()
    estimate = estimator.estimate(problem.with_prior(unknown(np.zeros(2))))
    np.testing.assert_allclose(estimate.belief.mean, [1.5, -0.7], atol=0.1)


@each_filter
@pytest.mark.parametrize("sigma", [1e-12, 1e-3])
def test_filters_survive_tiny_noise(estimator, sigma):
    time = np.linspace(0.0, 5.0, 200)
    problem = Problem(
        names=("rate", "level"),
        bounds=np.array([[0.0, 10.0], [-10.0, 10.0]]),
        prior=Belief(np.array([0.5, 1.0]), np.diag([4.0, 4.0])),
        measured=(2.0 * np.exp(-0.7 * time))[:, None],
        sigma=np.array([sigma]),
        observe=lambda _x, theta, i: (theta[1] * np.exp(-theta[0] * time[i]))[None],
    )
    estimate = estimator.estimate(problem)
    assert np.isfinite(estimate.belief.mean).all()
    assert np.isfinite(estimate.belief.cov).all()
    assert (np.linalg.eigvalsh(estimate.belief.cov) >= -1e-12).all()
