"""Problem, fit, Fisher information, doubts and one Kalman step against linear algebra and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy import stats
from small_problems import SLOPES, X, line_through, scalar_problem

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

MEASURED = 0.4 + 1.2 * X + 0.1 * np.cos(5.0 * X)
SIGNS = (-1.0) ** np.arange(31)


def line(**more) -> Problem:
    return line_through(**({"measured": MEASURED} | more))


PRIOR = Belief(np.array([0.5, 1.0]), np.array([[0.04, 0.01], [0.01, 0.09]]))
HOLED = line(measured=np.where(np.arange(12) == 3, np.nan, MEASURED), prior=PRIOR)
"""A line with a prior, of which a value is missing."""
THERE = np.delete(SLOPES, 3, axis=0)
VALUES = np.delete(MEASURED, 3) / 0.1
NORMAL = THERE.T @ THERE + np.linalg.inv(PRIOR.cov)
MEAN = np.linalg.solve(NORMAL, THERE.T @ VALUES + np.linalg.inv(PRIOR.cov) @ PRIOR.mean)


def test_line_equals_linear_algebra():
    estimate = NonlinearLeastSquares().estimate(HOLED)
    np.testing.assert_allclose(estimate.belief.mean, MEAN, rtol=1e-6)
    np.testing.assert_allclose(estimate.belief.cov, np.linalg.inv(NORMAL), rtol=1e-6)
    assert (estimate.status, estimate.method, HOLED.n_values) == ("converged", "nls", 11)
    np.testing.assert_allclose(estimate.identifiability.information, THERE.T @ THERE, rtol=1e-6)


def test_objective_adds_prior_to_chi2():
    residual = THERE @ MEAN - VALUES
    away = MEAN - PRIOR.mean
    assert HOLED.chi2(MEAN[None])[0] == pytest.approx(residual @ residual)
    expected = residual @ residual + away @ np.linalg.inv(PRIOR.cov) @ away
    assert HOLED.objective(MEAN[None])[0] == pytest.approx(expected)


def test_missing_value_has_no_sensitivity():
    expected = np.where(np.arange(12)[:, None] == 3, 0.0, SLOPES)
    np.testing.assert_allclose(HOLED.sensitivity(MEAN), expected, rtol=1e-6)


def test_information_omits_the_prior():
    np.testing.assert_allclose(fisher(HOLED, MEAN).information, THERE.T @ THERE, rtol=1e-6)


def test_record_without_values_leaves_prior():
    silent = NonlinearLeastSquares().estimate(line(measured=np.full(12, np.nan), prior=PRIOR)).belief
    np.testing.assert_allclose(silent.mean, PRIOR.mean)
    np.testing.assert_allclose(silent.cov, PRIOR.cov)


@pytest.fixture(scope="module")
def line_fit():
    """Estimate of the line."""
    return NonlinearLeastSquares().estimate(line())


LEAST = np.linalg.lstsq(SLOPES, MEASURED / 0.1, rcond=None)[0]
RESIDUAL = MEASURED / 0.1 - SLOPES @ LEAST
CHI2 = RESIDUAL @ RESIDUAL


def test_fit_statistics_follow_residuals(line_fit):
    """Among them Akaike's and Schwarz's criteria."""
    fit = line_fit.fit
    assert (fit.n_values, fit.n_free, fit.degrees, fit.verdict) == (12, 2, 10, "adequate")
    assert (fit.chi2, fit.reduced_chi2, fit.p_value) == pytest.approx((CHI2, CHI2 / 10.0, stats.chi2.sf(CHI2, 10)))
    schwarz = 2.0 * np.log(12)
    assert (fit.aic, fit.bic) == pytest.approx((12 * np.log(CHI2 / 12) + 4.0, 12 * np.log(CHI2 / 12) + schwarz))
    neighbours = RESIDUAL[:-1] @ RESIDUAL[1:]
    assert fit.serial_correlation == pytest.approx(neighbours / (CHI2 / 12) / np.sqrt(11))


def test_deviations_follow_residuals(line_fit):
    """Scaled by reduced chi-square; White's sandwich with n / (n - p)."""
    cov = np.linalg.inv(SLOPES.T @ SLOPES)
    np.testing.assert_allclose(line_fit.fit.scaled_sd, np.sqrt(CHI2 / 10.0 * np.diag(cov)), rtol=1e-5)
    score = SLOPES * RESIDUAL[:, None]
    np.testing.assert_allclose(line_fit.fit.sandwich_sd, np.sqrt(np.diag(cov @ score.T @ score @ cov) * 1.2), rtol=1e-5)


def small_fit(n: int) -> tuple[Fit, np.ndarray, np.ndarray]:
    """Of 1 + x, off by tenths: chi-square below 1. With its slopes and residuals."""
    slope = np.column_stack([np.ones(n), np.arange(n)])
    r = 0.1 * np.array([1.0, -2.0, 3.0, 1.0])[:n]
    return Fit(r[:, None], np.array([True, True]), slope, np.eye(2)), slope, r


@pytest.mark.parametrize(("n", "factor"), [(1, 1.0), (2, 2.0), (3, 3.0), (4, 2.0)])
def test_fit_statistics_at_few_degrees(n, factor):
    """White's factor is n / (n - p), n without a degree of freedom."""
    fit, slope, r = small_fit(n)
    assert fit.degrees == max(n - 2, 0)
    scale = r @ r / (n - 2) if n > 2 else 1.0
    np.testing.assert_allclose(fit.scaled_sd, np.sqrt(np.diag(np.linalg.inv(slope.T @ slope / scale + np.eye(2)))))
    bread = np.linalg.inv(slope.T @ slope + np.eye(2))
    score = slope * r[:, None]
    meat = bread @ (factor * score.T @ score + np.eye(2)) @ bread
    np.testing.assert_allclose(fit.sandwich_sd, np.sqrt(np.diag(meat)), rtol=1e-9)
    assert fit.bic == pytest.approx(n * np.log(r @ r / n) + 2.0 * np.log(n))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_exact_fit_keeps_its_deviations(n):
    fit, slope, _ = small_fit(n)
    exact = replace(fit, residuals=np.zeros((n, 1)))
    np.testing.assert_allclose(exact.scaled_sd, np.sqrt(np.diag(np.linalg.inv(slope.T @ slope + np.eye(2)))))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_fit_without_values_is_untested(n):
    silent = replace(small_fit(n)[0], residuals=np.full((n, 1), np.nan))
    assert (silent.aic, silent.bic, silent.verdict) == (4.0, 0.0, "untested")


def test_filter_fit_uses_innovations():
    fit = ExtendedKalman().estimate(line(drift=np.array([0.1, 0.1]))).fit
    assert (fit.n_values, fit.n_free, fit.degrees) == (12, 0, 12)
    assert fit.scaled_sd.shape == fit.sandwich_sd.shape == (0,)


@pytest.fixture
def axes(line_fit):
    """A plot of the line's residuals."""
    axes = Figure().add_subplot()
    line_fit.plot(axes)
    return axes


def test_plot_bands_two_sigmas(axes):
    band = axes.patches[0].get_extents().transformed(axes.transData.inverted())
    assert (band.y0, band.y1) == pytest.approx((-2.0, 2.0))


def test_plot_shows_residuals(axes, line_fit):
    points, zero = axes.lines
    assert set(zero.get_ydata()) == {0.0}
    np.testing.assert_allclose(points.get_ydata(), line_fit.fit.residuals[:, 0])
    assert "adequate" in axes.get_title()


def fit_of(residuals: np.ndarray) -> Fit:
    """Of one parameter that has no slope."""
    return Fit(residuals, np.array([True]), np.zeros((residuals.size, 1)), np.zeros((1, 1)))


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
    """Quantiles of chi-square, wrong once in a thousand: 5.4 and 43.8 for 19 degrees; or a series keeps its sign."""
    assert fit_of(residuals[:, None]).verdict == verdict


@pytest.mark.parametrize(
    "residuals", [np.full((3, 1), np.nan), np.zeros((3, 1)), np.array([[1.0], [np.inf], [1.0]]), np.ones((1, 1))]
)
def test_degenerate_residuals_have_no_correlation(residuals):
    assert fit_of(residuals).serial_correlation == 0.0


@pytest.mark.parametrize(
    ("chi2", "n", "variance"),
    [(10.8, 3, 1.0), (10.9, 3, 10.9),
     (29.5, 12, 1.0), (29.7, 12, 2.97), (1.5, 12, 1.0), (1.4, 12, 0.14), (86.6, 52, 1.0), (86.7, 52, 86.7 / 50.0),
     (24.7, 52, 1.0), (24.6, 52, 24.6 / 50.0),
     (9.0, 2, 1.0), (np.inf, 12, 1.0), (9.0, 1, 1.0)],
)  # fmt: skip
def test_noise_variance_follows_chi_square(chi2, n, variance):
    assert noise_variance(chi2, n, 2) == pytest.approx(variance)


INFORMATION = np.array([[4.0, 3.0], [3.0, 9.0]])


def test_identifiability_follows_information():
    summary = Identifiability(("a", "b"), INFORMATION)
    np.testing.assert_allclose(summary.scaled_information, [[1.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(summary.bound_sd, np.sqrt(np.diag(np.linalg.inv(INFORMATION))))
    assert (summary.condition, summary.correlation[0, 1]) == pytest.approx((3.0, -0.5))
    assert summary.weakest["a"] == pytest.approx(-summary.weakest["b"])


def test_blind_direction_has_infinite_variance():
    blind = np.array([[4.0, 6.0, 0.0], [6.0, 9.0, 0.0], [0.0, 0.0, 25.0]])
    cov, is_regular = invert_information(blind)
    assert not is_regular
    assert np.diag(cov) == pytest.approx([np.inf, np.inf, 0.04])
    assert not Identifiability(("a", "b", "c"), blind).identifiable


def test_fixed_parameter_has_no_variance():
    cov, is_regular = covariance_of_free(np.array([[0.0, 0.0], [-1.0, 1.0]]), INFORMATION)
    np.testing.assert_allclose(cov, [[0.0, 0.0], [0.0, 1.0 / 9.0]])
    assert is_regular


@pytest.mark.parametrize(
    ("off", "reached", "status"),
    [
        (4.9e-4, "max_steps", "converged"), (5.1e-4, "converged", "max_steps"), (5.1e-4, "approximate", "approximate"),
        (np.nan, "converged", "diverged"),
    ],
)  # fmt: skip
def test_fit_status_follows_optimum(line_fit, off, reached, status):
    """Alone along the first parameter, so many deviations away."""
    away = np.array([off / np.linalg.norm(SLOPES[:, 0]), 0.0])
    assert conclude(line(), line_fit.belief.mean + away, reached, 1).status == status


def test_fit_ends_at_bound(line_fit):
    bounds = np.array([[-50.0, line_fit.belief.mean[0] - 0.5 * line_fit.belief.sd[0]], [-50.0, 50.0]])
    corner = line(bounds=bounds, prior=Belief(np.zeros(2), 25.0 * np.eye(2)))
    assert NonlinearLeastSquares().estimate(corner).status == "at_bound"


def test_narrow_bounds_leave_parameters_open(line_fit):
    reach = 2.9 * np.array([-1.0, 1.0]) * line_fit.belief.sd[:, None]
    estimate = NonlinearLeastSquares().estimate(line(bounds=line_fit.belief.mean[:, None] + reach))
    assert (estimate.status, estimate.weak) == ("weakly_identifiable", ("offset", "slope"))


def test_two_parameters_for_one_mean():
    twins = line(observe=lambda _x, theta, i: (theta[0] + theta[1] + 0.0 * X[i])[None])
    assert NonlinearLeastSquares().estimate(twins).status == "not_identifiable"


@pytest.mark.parametrize(
    ("off", "is_near"),
    [
        ([0.25, 0.25], True), ([0.95, -0.95], True),
        ([1.05, 0.0], False), ([0.0, -1.05], False), ([2.5, 2.5], False),
    ],
)  # fmt: skip
def test_own_covariance_counts_near_optimum(line_fit, off, is_near):
    """Within a deviation by it, here twice the line's; farther off it is of another place."""
    belief = line_fit.belief
    end = settle(line(), belief.mean + np.array(off) * 2.0 * belief.sd, 0, cov=4.0 * belief.cov)
    np.testing.assert_allclose(end.belief.cov, (4.0 if is_near else 1.0) * belief.cov, rtol=1e-7 if is_near else 1e-6)


def test_settling_without_a_point_diverges(line_fit):
    assert settle(line(), line_fit.belief.mean * [1.0, np.nan], 5).status == "diverged"


def test_unpolished_end_costs_nothing_more(line_fit):
    assert settle(line(), line_fit.belief.mean, 5, polish=False).n_evals == 5


def test_quadratic_model_costs_five_evaluations(line_fit):
    assert quadratic_model(line(), line_fit.belief.mean).n_evals == 5


def fit_logarithm(sigma: float):
    """Estimate of one value of exp(x)."""
    return NonlinearLeastSquares().estimate(scalar_problem(np.exp, 1.0, sigma=sigma, bounds=(-40.0, 40.0)))


def test_logarithm_has_asymmetric_profile():
    """Objective ((e^x - y) / s)^2 rises by 3.84 where e^x is y +- 1.96 s."""
    estimate = fit_logarithm(0.4)
    np.testing.assert_allclose(estimate.profile.interval, [np.log([1.0 - 0.784, 1.0 + 0.784])], rtol=0.03)
    assert estimate.status == "converged"


def test_flat_logarithm_is_open_below():
    estimate = fit_logarithm(0.6)
    assert estimate.profile.without_limit == estimate.weak == ("x",)
    assert estimate.profile.open.tolist() == [[True, False]]
    assert estimate.profile.interval[0, 1] == pytest.approx(np.log(1.0 + 1.96 * 0.6), rel=0.03)
    assert estimate.status == "weakly_identifiable"


def test_local_optimum_names_the_better():
    """x squared near 1, and x itself near 1: from below a fit ends near -1."""
    two = Problem(("x",), np.array([[-4.0, 4.0]]), unknown(np.array([-2.0])), np.tile([1.0, 0.3], (3, 1)),
                  np.full(2, 0.05),
                  lambda _x, theta, i: np.stack([theta[0] ** 2 + 0.0 * i, 0.3 * theta[0] + 0.0 * i]))  # fmt: skip
    estimate = NonlinearLeastSquares().estimate(two)
    assert estimate.status == "local_optimum"
    assert estimate.belief.mean[0] < -0.9
    assert estimate.better[0] == pytest.approx(1.0, abs=1e-3)


def test_infinite_sensitivity_is_limited():
    steep = replace(line(), measured=np.zeros((3, 1)), observe=lambda _x, t, i: np.stack([
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
        replace(line(), **wrong)


COV = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.0], [0.1, 0.0, 0.5]])
BELIEF = Belief(np.array([1.0, -1.0, 0.5]), COV)
H = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, -1.0]])
MODEL = Affine(H, np.array([0.2, -0.1]), np.diag([0.01, 0.02]))
SIGMA = np.array([0.3, 0.4])
READING = np.array([2.0, -2.0])
ERROR = READING - (H @ BELIEF.mean + [0.2, -0.1])
TOTAL = H @ COV @ H.T + np.diag([0.01 + 0.09, 0.02 + 0.16])


def test_innovation_has_inverse_covariance():
    correction = innovate(BELIEF, MODEL, READING, SIGMA)
    np.testing.assert_allclose(correction.precision, np.linalg.inv(TOTAL))
    np.testing.assert_allclose(correction.innovation, ERROR)


def test_kalman_update_is_conditional_normal():
    after = update_belief(BELIEF, innovate(BELIEF, MODEL, READING, SIGMA))
    np.testing.assert_allclose(after.mean, BELIEF.mean + COV @ H.T @ np.linalg.solve(TOTAL, ERROR))
    np.testing.assert_allclose(after.cov, COV - COV @ H.T @ np.linalg.solve(TOTAL, H @ COV), atol=1e-12)


def test_batch_of_one_updates_as_single():
    correction = innovate(BELIEF, MODEL, READING, SIGMA)
    after = update_belief(BELIEF, correction)
    alone = Belief(BELIEF.mean[None], COV[None])
    batch = update_belief(alone, compute_gain(alone, replace(MODEL, spread=correction.noise[None]), READING[None]))
    np.testing.assert_allclose(batch.mean, [after.mean])
    np.testing.assert_allclose(batch.cov, [after.cov])


def test_missing_output_updates_nothing():
    one = update_belief(BELIEF, innovate(BELIEF, MODEL, np.array([np.nan, -2.0]), SIGMA))
    np.testing.assert_allclose(one.mean, BELIEF.mean + COV @ H[1] / TOTAL[1, 1] * ERROR[1])


@pytest.mark.parametrize(
    ("slope", "offset"), [(np.array([[1.0, np.inf, 0.0]] * 2), np.zeros(2)), (H, np.array([0.0, np.nan]))]
)
def test_nonfinite_model_is_lost(slope, offset):
    with pytest.raises(LostTrackError):
        innovate(BELIEF, Affine(slope, offset, np.zeros((2, 2))), READING, SIGMA)


def test_prediction_is_affine():
    ahead = np.array([[1.0, 0.5, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]])
    later = predict_belief(BELIEF, Affine(ahead, np.array([0.0, 0.1, 0.0]), 0.1 * np.eye(3)))
    np.testing.assert_allclose(later.mean, [0.5, -0.8, 0.5])
    np.testing.assert_allclose(later.cov, ahead @ COV @ ahead.T + 0.1 * np.eye(3))


MOVING = line(drift=np.array([0.1, 0.2]))


@pytest.mark.parametrize(("problem", "expected"), [(MOVING, True), (line(drift=np.zeros(2)), False)])
def test_drift_moves_a_problem(problem, expected):
    assert is_moving(problem) is expected


def test_drift_adds_variance():
    step = linearise_step(MOVING, tangent, joint_belief(MOVING), 0)
    np.testing.assert_allclose(step.spread, np.diag([0.01, 0.04]))
    np.testing.assert_allclose(step.slope, np.eye(2))


def test_process_noise_adds_variance():
    states = replace(
        MOVING, start=Belief(np.array([2.0]), np.array([[0.5]])), process_sd=np.array([0.3]),
        transition=lambda x, theta, _i: 0.5 * x**2 + theta[:1],
    )  # fmt: skip
    start = joint_belief(states)
    # a parameter of which nothing is known is as unsure as a uniform one over its bounds
    np.testing.assert_allclose(np.diag(start.cov), [0.5, 100.0**2 / 12.0, 100.0**2 / 12.0])
    step = linearise_step(states, tangent, start, 0)
    np.testing.assert_allclose(step.slope, [[2.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(step.spread, np.diag([0.09, 0.01, 0.04]))
    assert (step.slope @ start.mean + step.offset)[0] == pytest.approx(2.0)


def test_unbounded_start_is_wide():
    """A thousand times the value, or a thousand."""
    start = joint_belief(line(bounds=np.tile([-np.inf, np.inf], (2, 1)), prior=unknown(np.array([0.5, 3.0]))))
    np.testing.assert_allclose(np.diag(start.cov), [1e6, 9e6])


def test_fixed_parameter_starts_at_bound():
    fixed = joint_belief(line(bounds=np.array([[0.3, 0.3], [-1.0, 1.0]])))
    np.testing.assert_allclose(np.diag(fixed.cov), [0.0, 4.0 / 12.0])
    assert fixed.mean[0] == 0.3


def test_fixed_parameter_needs_no_prior():
    prior = Belief(np.array([0.3, -0.5]), np.array([[4.0, 0.5], [0.5, 1.0]]))
    fixed = joint_belief(line(bounds=np.array([[0.3, 0.3], [-1.0, 0.0]]), prior=prior))
    np.testing.assert_array_equal(fixed.cov, np.diag([0.0, 1.0]))


@pytest.mark.parametrize(
    ("mean", "reach", "expected"),
    [
        ([1.5, 0.0], [1.0, 1.0], [1.0, -0.25]),
        ([1.5, 0.0], [2.0, 1.0], [1.5, 0.0]),
        # one that lies on its bound is free to leave it
        ([1.5, 1.0], [1.0, 1.0], [1.0, 0.75]),
        ([-1.5, -1.0], [1.0, 1.0], [-1.0, -0.75]),
    ],
)
def test_bound_drags_correlated_parameters(mean, reach, expected):
    belief = Belief(np.array(mean), np.array([[1.0, 0.5], [0.5, 1.0]]))
    np.testing.assert_allclose(project_on_bounds(belief, -np.array(reach), np.array(reach)), expected)


def test_interval_spans_normal_quantiles():
    belief = Belief(np.array([1.0, 2.0]), np.diag([4.0, 9.0]))
    np.testing.assert_allclose(belief.interval()[:, 1] - belief.mean, [1.644854 * 2.0, 1.644854 * 3.0], rtol=1e-6)
    np.testing.assert_allclose(belief.interval(0.95), [[1.0 - 3.92, 1.0 + 3.92], [2.0 - 5.88, 2.0 + 5.88]], atol=1e-3)
