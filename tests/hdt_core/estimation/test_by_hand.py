"""Problem, fit, Fisher information, doubts and one Kalman step against linear algebra and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy import stats

from hdt_core.estimation import Belief, ExtendedKalman, NonlinearLeastSquares, Problem, unknown
from hdt_core.estimation.conclude import conclude, settle
from hdt_core.estimation.descent import quadratic_model
from hdt_core.estimation.fit import Fit, Identifiability, covariance_of_free, fisher, invert_information, noise_variance
from hdt_core.estimation.kalman_step import (
    Affine,
    LostTrackError,
    compute_gain,
    innovate,
    is_moving,
    joint_belief,
    linearise_step,
    predict_belief,
    project_on_bounds,
    tangent,
    update_belief,
)

X = np.linspace(-1.0, 2.0, 12)
MEASURED = 0.4 + 1.2 * X + 0.1 * np.cos(5.0 * X)
A = np.column_stack([np.ones(12), X]) / 0.1
SIGNS = (-1.0) ** np.arange(31)


def line(**more) -> Problem:
    """An offset and a slope."""
    fields = {"names": ("offset", "slope"), "bounds": np.tile([-50.0, 50.0], (2, 1)), "prior": unknown(np.zeros(2)),
             "measured": MEASURED[:, None], "sigma": np.array([0.1]),
             "observe": lambda _x, theta, i: (theta[0] + theta[1] * X[i])[None]}  # fmt: skip
    return Problem(**(fields | more))


def test_line_equals_linear_algebra():
    measured = MEASURED[:, None].copy()
    measured[3] = np.nan
    prior = Belief(np.array([0.5, 1.0]), np.array([[0.04, 0.01], [0.01, 0.09]]))
    problem = line(measured=measured, prior=prior)
    there = np.isfinite(measured[:, 0])
    weight = np.linalg.inv(prior.cov)
    normal = A[there].T @ A[there] + weight
    mean = np.linalg.solve(normal, A[there].T @ MEASURED[there] / 0.1 + weight @ prior.mean)
    estimate = NonlinearLeastSquares().estimate(problem)
    np.testing.assert_allclose(estimate.belief.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(estimate.belief.cov, np.linalg.inv(normal), rtol=1e-6)
    assert (estimate.status, estimate.method, problem.n_values) == ("converged", "nls", 11)
    residual = (A @ mean - MEASURED / 0.1)[there]
    away = mean - prior.mean
    assert problem.chi2(mean[None])[0] == pytest.approx(residual @ residual)
    assert problem.objective(mean[None])[0] == pytest.approx(residual @ residual + away @ weight @ away)
    np.testing.assert_allclose(problem.sensitivity(mean)[there], A[there], rtol=1e-6)
    assert not problem.sensitivity(mean)[3].any()
    np.testing.assert_allclose(estimate.identifiability.information, A[there].T @ A[there], rtol=1e-6)
    np.testing.assert_allclose(fisher(problem, mean).information, A[there].T @ A[there], rtol=1e-6)
    silent = NonlinearLeastSquares().estimate(line(measured=np.full((12, 1), np.nan), prior=prior)).belief
    np.testing.assert_allclose(silent.mean, prior.mean)  # a record without a value leaves the prior
    np.testing.assert_allclose(silent.cov, prior.cov)


def test_fit_statistics_follow_residuals():
    """White's sandwich with n / (n - p), deviations scaled by reduced chi-square, Akaike's and Schwarz's criteria."""
    estimate = NonlinearLeastSquares().estimate(line())
    mean = np.linalg.lstsq(A, MEASURED / 0.1, rcond=None)[0]
    r = MEASURED / 0.1 - A @ mean
    cov = np.linalg.inv(A.T @ A)
    fit = estimate.fit
    chi2 = r @ r
    assert (fit.n_values, fit.n_free, fit.degrees) == (12, 2, 10)
    assert (fit.chi2, fit.reduced_chi2) == pytest.approx((chi2, chi2 / 10.0))
    assert fit.p_value == pytest.approx(stats.chi2.sf(chi2, 10))
    assert fit.aic == pytest.approx(12 * np.log(chi2 / 12) + 4.0)
    assert fit.bic == pytest.approx(12 * np.log(chi2 / 12) + 2.0 * np.log(12))
    assert fit.serial_correlation == pytest.approx((r[:-1] @ r[1:]) / (chi2 / 12) / np.sqrt(11))
    np.testing.assert_allclose(fit.scaled_sd, np.sqrt(chi2 / 10.0 * np.diag(cov)), rtol=1e-5)
    score = A * r[:, None]
    np.testing.assert_allclose(fit.sandwich_sd, np.sqrt(np.diag(cov @ score.T @ score @ cov) * 1.2), rtol=1e-5)
    assert fit.verdict == "adequate"


@pytest.mark.parametrize(("n", "factor"), [(1, 1.0), (2, 2.0), (3, 3.0), (4, 2.0)])
def test_fit_statistics_at_few_degrees(n, factor):
    """Of 1 + x, off by tenths: chi-square below 1. White's factor is n / (n - p), n without a degree of freedom."""
    slope = np.column_stack([np.ones(n), np.arange(n)])
    r = 0.1 * np.array([1.0, -2.0, 3.0, 1.0])[:n]
    prior = np.eye(2)
    fit = Fit(r[:, None], np.array([True, True]), slope, prior)
    assert fit.degrees == max(n - 2, 0)
    scale = r @ r / (n - 2) if n > 2 else 1.0
    np.testing.assert_allclose(fit.scaled_sd, np.sqrt(np.diag(np.linalg.inv(slope.T @ slope / scale + prior))))
    bread = np.linalg.inv(slope.T @ slope + prior)
    score = slope * r[:, None]
    meat = bread @ (factor * score.T @ score + prior) @ bread
    np.testing.assert_allclose(fit.sandwich_sd, np.sqrt(np.diag(meat)), rtol=1e-9)
    assert fit.bic == pytest.approx(n * np.log(r @ r / n) + 2.0 * np.log(n))
    exact = replace(fit, residuals=np.zeros((n, 1)))
    np.testing.assert_allclose(exact.scaled_sd, np.sqrt(np.diag(bread)))
    silent = replace(fit, residuals=np.full((n, 1), np.nan))
    assert (silent.aic, silent.bic, silent.verdict) == (4.0, 0.0, "untested")


def test_filter_fit_uses_innovations():
    fit = ExtendedKalman().estimate(line(drift=np.array([0.1, 0.1]))).fit
    assert (fit.n_values, fit.n_free, fit.degrees) == (12, 0, 12)
    assert fit.scaled_sd.shape == fit.sandwich_sd.shape == (0,)
    figure = Figure()
    axes = figure.add_subplot()
    NonlinearLeastSquares().estimate(line()).plot(axes)
    band = axes.patches[0].get_extents().transformed(axes.transData.inverted())
    points, zero = axes.lines
    assert (band.y0, band.y1) == pytest.approx((-2.0, 2.0))
    assert set(zero.get_ydata()) == {0.0}
    np.testing.assert_allclose(points.get_ydata(), NonlinearLeastSquares().estimate(line()).fit.residuals[:, 0])
    assert "adequate" in axes.get_title()


@pytest.mark.parametrize(
    ("residuals", "verdict"),
    [
        (np.tile([1.6, -1.6], 10), "lack_of_fit"), (np.tile([1.4, -1.4], 10), "adequate"),
        (np.tile([0.52, -0.52], 10), "adequate"), (np.tile([0.4, -0.4], 10), "sigma_too_large"),
        (np.repeat([1.0, -1.0], 20), "lack_of_fit"), (np.tile([1.0, 1.0, -1.0, -1.0], 10), "adequate"),
        (np.array([0.1]), "untested"),
        # a hundred pairs of which thirty, or one less, change their sign: four deviations, or 4.2
        (np.repeat(SIGNS, [4] * 19 + [2] * 11 + [3]), "adequate"),
        (np.repeat(SIGNS[:30], [4] * 19 + [2] * 10 + [5]), "lack_of_fit"),
        # a pattern a thousandth of sigma high is rounding's
        (0.9e-3 * np.repeat([1.0, -1.0], 20), "sigma_too_large"), (1.1e-3 * np.repeat([1.0, -1.0], 20), "lack_of_fit"),
    ],
)  # fmt: skip
def test_verdict_follows_residuals(residuals, verdict):
    """Quantiles of chi-square: 5.4 and 43.8 for 19 degrees; a series that keeps its sign for twenty values has run."""
    fit = Fit(residuals[:, None], np.array([True]), np.zeros((residuals.size, 1)), np.zeros((1, 1)))
    assert fit.verdict == verdict
    for none in (np.full((3, 1), np.nan), np.zeros((3, 1)), np.array([[1.0], [np.inf], [1.0]]), np.ones((1, 1))):
        assert replace(fit, residuals=none).serial_correlation == 0.0


@pytest.mark.parametrize(
    ("chi2", "n", "variance"),
    [(10.8, 3, 1.0), (10.9, 3, 10.9),
     (29.5, 12, 1.0), (29.7, 12, 2.97), (1.5, 12, 1.0), (1.4, 12, 0.14), (86.6, 52, 1.0), (86.7, 52, 86.7 / 50.0),
     (24.7, 52, 1.0), (24.6, 52, 24.6 / 50.0),
     (9.0, 2, 1.0), (np.inf, 12, 1.0), (9.0, 1, 1.0)],
)  # fmt: skip
def test_noise_variance_follows_chi_square(chi2, n, variance):
    assert noise_variance(chi2, n, 2) == pytest.approx(variance)


def test_identifiability_follows_information():
    information = np.array([[4.0, 3.0], [3.0, 9.0]])
    known_info = Identifiability(("a", "b"), information)
    cov = np.linalg.inv(information)
    np.testing.assert_allclose(known_info.scaled_information, [[1.0, 0.5], [0.5, 1.0]])
    assert known_info.condition == pytest.approx(3.0)
    np.testing.assert_allclose(known_info.bound_sd, np.sqrt(np.diag(cov)))
    assert known_info.correlation[0, 1] == pytest.approx(-0.5)
    weakest = known_info.weakest
    assert weakest["a"] == pytest.approx(-weakest["b"])
    blind = np.array([[4.0, 6.0, 0.0], [6.0, 9.0, 0.0], [0.0, 0.0, 25.0]])
    cov_blind, is_regular = invert_information(blind)
    assert not is_regular
    assert np.isinf(np.diag(cov_blind)[:2]).all()
    assert cov_blind[2, 2] == pytest.approx(0.04)
    assert not Identifiability(("a", "b", "c"), blind).identifiable
    cov_free, is_regular = covariance_of_free(np.array([[0.0, 0.0], [-1.0, 1.0]]), information)
    np.testing.assert_allclose(cov_free, [[0.0, 0.0], [0.0, 1.0 / 9.0]])
    assert is_regular


def test_fit_status_follows_optimum():
    optimum = NonlinearLeastSquares().estimate(line())
    mean = optimum.belief.mean
    sd = optimum.belief.sd
    # alone along the first parameter, 4.9e-4 and 5.1e-4 of a deviation away
    step = 1.0 / np.sqrt((A.T @ A)[0, 0])
    for off, reached, status in ((4.9e-4, "max_steps", "converged"), (5.1e-4, "converged", "max_steps"),
                                 (5.1e-4, "approximate", "approximate")):  # fmt: skip
        assert conclude(line(), mean + np.array([off * step, 0.0]), reached, 1).status == status
    assert conclude(line(), mean * np.nan, "converged", 1).status == "diverged"
    bounds = np.array([[-50.0, mean[0] - 0.5 * sd[0]], [-50.0, 50.0]])
    corner = line(bounds=bounds, prior=Belief(np.zeros(2), 25.0 * np.eye(2)))
    assert NonlinearLeastSquares().estimate(corner).status == "at_bound"
    narrow = replace(line(), bounds=np.column_stack([mean - 2.9 * sd, mean + 2.9 * sd]))
    left_open = NonlinearLeastSquares().estimate(narrow)
    assert (left_open.status, left_open.weak) == ("weakly_identifiable", ("offset", "slope"))
    # twice too many parameters for one mean
    twins = line(observe=lambda _x, theta, i: (theta[0] + theta[1] + 0.0 * X[i])[None])
    assert NonlinearLeastSquares().estimate(twins).status == "not_identifiable"
    near = settle(line(), mean + 0.5 * sd, 0, cov=4.0 * optimum.belief.cov)
    np.testing.assert_allclose(near.belief.cov, 4.0 * optimum.belief.cov)
    for off in ([1.05, 0.0], [0.0, -1.05], [2.5, 2.5]):  # the method's covariance, twice as wide, is of another place
        start = mean + np.array(off) * 2.0 * sd
        far = settle(line(), start, 0, cov=4.0 * optimum.belief.cov)
        np.testing.assert_allclose(far.belief.cov, optimum.belief.cov, rtol=1e-6)
    there = settle(line(), mean + np.array([0.95, -0.95]) * 2.0 * sd, 0, cov=4.0 * optimum.belief.cov)
    np.testing.assert_allclose(there.belief.cov, 4.0 * optimum.belief.cov)
    assert settle(line(), mean * [1.0, np.nan], 5).status == "diverged"
    assert settle(line(), mean, 5, polish=False).n_evals == 5
    assert quadratic_model(line(), mean).n_evals == 5


def curved(value: float, sigma: float) -> Problem:
    """One value of exp(theta)."""
    return Problem(("x",), np.array([[-40.0, 40.0]]), unknown(np.array([0.0])), np.full((1, 1), value),
                   np.array([sigma]), lambda _x, theta, i: np.exp(theta[0] + 0.0 * i)[None])  # fmt: skip


def test_logarithm_has_asymmetric_profile():
    """Objective ((e^x - y) / s)^2 rises by 3.84 where e^x is y +- 1.96 s; below zero it never does."""
    estimate = NonlinearLeastSquares().estimate(curved(1.0, 0.4))
    np.testing.assert_allclose(estimate.profile.interval, [np.log([1.0 - 0.784, 1.0 + 0.784])], rtol=0.03)
    assert estimate.status == "converged"
    left = NonlinearLeastSquares().estimate(curved(1.0, 0.6))
    assert left.profile.without_limit == left.weak == ("x",)
    assert left.profile.open.tolist() == [[True, False]]
    assert left.profile.interval[0, 1] == pytest.approx(np.log(1.0 + 1.96 * 0.6), rel=0.03)
    assert left.status == "weakly_identifiable"
    # x squared near 1, and x itself near 1: from below a fit ends near -1.
    two = Problem(("x",), np.array([[-4.0, 4.0]]), unknown(np.array([-2.0])), np.tile([1.0, 0.3], (3, 1)),
                  np.full(2, 0.05),
                  lambda _x, theta, i: np.stack([theta[0] ** 2 + 0.0 * i, 0.3 * theta[0] + 0.0 * i]))  # fmt: skip
    estimate = NonlinearLeastSquares().estimate(two)
    assert estimate.status == "local_optimum"
    assert estimate.belief.mean[0] < -0.9
    assert estimate.better[0] == pytest.approx(1.0, abs=1e-3)
    steep = line(measured=np.zeros((3, 1)))
    steep = replace(steep, observe=lambda _x, t, i: np.stack([
        np.where(t[0] > 0.0, np.inf, 1.0), np.where(t[0] > 0.0, -np.inf, 1.0), np.full_like(t[0], np.inf)
    ], axis=-1).reshape(1, -1, 3))  # fmt: skip
    np.testing.assert_array_equal(steep.sensitivity(np.zeros(2)), [[1e150, 0.0], [-1e150, 0.0], [0.0, 0.0]])


@pytest.mark.parametrize("wrong", [
    {"prior": Belief(np.zeros(2), np.diag([0.0, 1.0]))}, {"sigma": np.zeros(1)}, {"sigma": np.array([-0.5])},
    {"prior": Belief(np.zeros(2), np.diag([1.0, -0.5]))}, {"bounds": np.array([[1.0, 0.0], [0.0, 1.0]])},
    {"bounds": np.zeros((2, 3))}, {"bounds": np.zeros((3, 2))}, {"measured": np.zeros((12, 2))},
    {"measured": np.zeros(12)}, {"measured": np.zeros(4), "sigma": np.zeros(0)},
    {"prior": Belief(np.zeros(2), np.eye(3))}, {"prior": Belief(np.zeros(3), np.eye(2))},
], ids=str)  # fmt: skip
def test_senseless_problem_is_refused(wrong):
    with pytest.raises(ValueError, match=r"names|measured|positive|bound"):
        line(**wrong)


def test_kalman_update_is_conditional_normal():
    cov = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.0], [0.1, 0.0, 0.5]])
    belief = Belief(np.array([1.0, -1.0, 0.5]), cov)
    h = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, -1.0]])
    model = Affine(h, np.array([0.2, -0.1]), np.diag([0.01, 0.02]))
    sigma = np.array([0.3, 0.4])
    measured = np.array([2.0, -2.0])
    s = h @ cov @ h.T + np.diag([0.01 + 0.09, 0.02 + 0.16])
    error = measured - (h @ belief.mean + [0.2, -0.1])
    correction = innovate(belief, model, measured, sigma)
    after = update_belief(belief, correction)
    np.testing.assert_allclose(after.mean, belief.mean + cov @ h.T @ np.linalg.solve(s, error))
    np.testing.assert_allclose(after.cov, cov - cov @ h.T @ np.linalg.solve(s, h @ cov), atol=1e-12)
    np.testing.assert_allclose(correction.precision, np.linalg.inv(s))
    np.testing.assert_allclose(correction.innovation, error)
    alone = Belief(belief.mean[None], cov[None])  # as a batch of one
    batch = update_belief(alone, compute_gain(alone, replace(model, spread=correction.noise[None]), measured[None]))
    np.testing.assert_allclose(batch.mean, [after.mean])
    np.testing.assert_allclose(batch.cov, [after.cov])
    one = update_belief(belief, innovate(belief, model, np.array([np.nan, -2.0]), sigma))
    gain = cov @ h[1] / s[1, 1]
    np.testing.assert_allclose(one.mean, belief.mean + gain * error[1])
    for slope, offset in (([[1.0, np.inf, 0.0]] * 2, [0.0, 0.0]), (h, [0.0, np.nan])):
        with pytest.raises(LostTrackError):
            innovate(belief, Affine(np.array(slope), np.array(offset), np.zeros((2, 2))), measured, sigma)
    ahead = np.array([[1.0, 0.5, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]])
    move = Affine(ahead, np.array([0.0, 0.1, 0.0]), 0.1 * np.eye(3))
    later = predict_belief(belief, move)
    np.testing.assert_allclose(later.mean, [0.5, -0.8, 0.5])
    np.testing.assert_allclose(later.cov, move.slope @ cov @ move.slope.T + 0.1 * np.eye(3))


def test_drift_adds_variance():
    moving = line(drift=np.array([0.1, 0.2]))
    assert is_moving(moving)
    assert not is_moving(line(drift=np.zeros(2)))
    step = linearise_step(moving, tangent, joint_belief(moving), 0)
    np.testing.assert_allclose(step.spread, np.diag([0.01, 0.04]))
    np.testing.assert_allclose(step.slope, np.eye(2))
    states = replace(
        moving, start=Belief(np.array([2.0]), np.array([[0.5]])), process_sd=np.array([0.3]),
        transition=lambda x, theta, _i: 0.5 * x**2 + theta[:1],
    )  # fmt: skip
    start = joint_belief(states)
    # a parameter of which nothing is known is as unsure as a uniform one over its bounds
    np.testing.assert_allclose(np.diag(start.cov), [0.5, 100.0**2 / 12.0, 100.0**2 / 12.0])
    step = linearise_step(states, tangent, start, 0)
    np.testing.assert_allclose(step.slope, [[2.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(step.spread, np.diag([0.09, 0.01, 0.04]))
    assert (step.slope @ start.mean + step.offset)[0] == pytest.approx(2.0)
    open_ended = joint_belief(line(bounds=np.tile([-np.inf, np.inf], (2, 1)), prior=unknown(np.array([0.5, 3.0]))))
    np.testing.assert_allclose(np.diag(open_ended.cov), [1e6, 9e6])
    fixed = joint_belief(line(bounds=np.array([[0.3, 0.3], [-1.0, 1.0]])))
    np.testing.assert_allclose(np.diag(fixed.cov), [0.0, 4.0 / 12.0])
    assert fixed.mean[0] == 0.3
    prior = Belief(np.array([0.3, -0.5]), np.array([[4.0, 0.5], [0.5, 1.0]]))  # nor is one that has a prior
    fixed = joint_belief(line(bounds=np.array([[0.3, 0.3], [-1.0, 0.0]]), prior=prior))
    np.testing.assert_array_equal(fixed.cov, np.diag([0.0, 1.0]))


def test_bound_drags_correlated_parameters():
    belief = Belief(np.array([1.5, 0.0]), np.array([[1.0, 0.5], [0.5, 1.0]]))
    np.testing.assert_allclose(project_on_bounds(belief, np.array([-1.0, -1.0]), np.array([1.0, 1.0])), [1.0, -0.25])
    np.testing.assert_allclose(project_on_bounds(belief, np.array([-2.0, -1.0]), np.array([2.0, 1.0])), [1.5, 0.0])
    for sign in (1.0, -1.0):  # one that lies on its bound is free to leave it
        edge = Belief(sign * np.array([1.5, 1.0]), belief.cov)
        np.testing.assert_allclose(project_on_bounds(edge, -np.ones(2), np.ones(2)), sign * np.array([1.0, 0.75]))
    belief = Belief(np.array([1.0, 2.0]), np.diag([4.0, 9.0]))
    np.testing.assert_allclose(belief.interval()[:, 1] - belief.mean, [1.644854 * 2.0, 1.644854 * 3.0], rtol=1e-6)
    np.testing.assert_allclose(belief.interval(0.95), [[1.0 - 3.92, 1.0 + 3.92], [2.0 - 5.88, 2.0 + 5.88]], atol=1e-3)
