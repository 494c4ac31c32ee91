"""Filters and the report against sums written out."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints
from scipy.linalg import sqrtm
from small_problems import SLOPES, X, line_through, scalar_problem

from hdt_core.estimation import (
    Belief,
    Estimate,
    ExtendedKalman,
    NonlinearLeastSquares,
    PhysicsInformedNet,
    Problem,
    UnscentedKalman,
    kalman,
    unknown,
)
from hdt_core.estimation.estimate import _correlations
from hdt_core.estimation.fit import Identifiability
from hdt_core.estimation.kalman import (
    FilterPass,
    _line_search,
    _point,
    _stands_still,
    _with_last_mean,
    forward,
    report,
    standardise_innovations,
    trajectory,
)
from hdt_core.estimation.kalman_step import Correction, LostTrackError, regression, tangent, upper_root
from hdt_core.estimation.problem import Kernels, _scale


def line(**more) -> Problem:
    noise = 0.1 * np.where(np.arange(12) % 4 % 3 == 0, 1.0, -1.0)
    return line_through(1.0 + 0.5 * X + noise, **({"prior": Belief(np.zeros(2), 4.0 * np.eye(2))} | more))


each_linear_filter = pytest.mark.parametrize(
    ("estimator", "passes"),
    [
        (ExtendedKalman(), 2),
        (ExtendedKalman(smoother_passes=0), 1),
        (UnscentedKalman(smoother_passes=0, polish=False), 1),
    ],
)


@each_linear_filter
def test_linear_pass_costs_five_evaluations(estimator, passes):
    """Two for each quantity and one. A straight line is filtered once, and once more to see that it stands still."""
    estimate = estimator.estimate(line())
    assert (estimate.status, estimate.n_evals) == ("converged", 5 * passes)


def test_unscented_filter_takes_more_passes():
    assert UnscentedKalman().estimate(line()).n_evals > 10


@each_linear_filter
def test_linear_path_is_running_least_squares(estimator, passes):
    estimate = estimator.estimate(line())
    np.testing.assert_allclose(estimate.path[-1], estimate.belief.mean, rtol=1e-6)
    for k in (0, 5):
        past = SLOPES[: k + 1]
        cov = np.linalg.inv(past.T @ past + 0.25 * np.eye(2))
        np.testing.assert_allclose(estimate.path_sd[k], np.sqrt(np.diag(cov)), rtol=1e-6)
        np.testing.assert_allclose(estimate.path[k], cov @ past.T @ line().measured[: k + 1, 0] / 0.1, rtol=1e-6)


def square(drift=0.0) -> Problem:
    """x^2 seen as 4 three times."""
    return scalar_problem(lambda x: x**2, np.full(3, 4.0), bounds=(0.1, 9.0), sigma=0.1, drift=np.array([drift]),
                          prior=Belief(np.array([1.0]), np.array([[1.0]])))  # fmt: skip


@pytest.mark.parametrize(
    ("estimator", "drift", "status"),
    [
        (ExtendedKalman(smoother_passes=0), 0.0, "approximate"),
        (ExtendedKalman(smoother_passes=1), 0.0, "max_steps"), (ExtendedKalman(), 0.0, "converged"),
        (ExtendedKalman(smoother_passes=0), 0.1, "approximate"),
        (ExtendedKalman(smoother_passes=1), 0.1, "max_steps"), (ExtendedKalman(), 0.1, "converged"),
        (UnscentedKalman(smoother_passes=0, polish=False), 0.0, "approximate"), (UnscentedKalman(), 0.0, "converged"),
        (UnscentedKalman(smoother_passes=0, polish=False), 0.1, "approximate"),
    ],
    ids=str,
)  # fmt: skip
def test_filter_status_follows_passes(estimator, drift, status):
    estimate = replace(estimator, name="other").estimate(square(drift=drift))
    finish = ", finished by least squares" * (estimator == UnscentedKalman())
    assert (estimate.status, estimate.method) == (status, f"other{finish}")
    assert (estimate.innovations is not None) is (drift > 0.0)
    assert np.isnan(estimate.distance) == (drift > 0.0)


@pytest.mark.parametrize(
    ("default", "expected"),
    [
        (ExtendedKalman(), ExtendedKalman("ekf", 20)),
        (UnscentedKalman(), UnscentedKalman("ukf", 1.0, 0.0, 0.0, 5, True)),
        (PhysicsInformedNet(), PhysicsInformedNet("pinn", 30, (0.1, 0.01), 100, True, 0)),
    ],
)
def test_estimators_have_their_defaults(default, expected):
    assert default == expected


def test_static_net_is_least_squares():
    estimate = PhysicsInformedNet().estimate(line())
    assert estimate.method == "pinn, no dynamics, finished by least squares"
    assert estimate.n_evals == NonlinearLeastSquares().estimate(line()).n_evals


STEP_TO_ONE = scalar_problem(measured=1.0, bounds=(-999.0, 999.0))
"""The objective is (x - 1)^2 from 0."""


@pytest.mark.parametrize(
    ("later", "step_end"),
    [
        (1.9, 1.9), (2.1, 1.05), (3.0, 1.5), (9.0, 1.125), (-1.0, -1.0), (400.0, 400.0),
        (2.0**7 * 1.99, 1.99), (2.0**8 * 1.99, 2.0**8 * 1.99),
    ],
)  # fmt: skip
def test_line_search_halves_the_step(later, step_end):
    """Until it pays; seven halvings at most, and the full step where none pays."""
    assert _line_search(STEP_TO_ONE, np.zeros(1), np.array([later])) == pytest.approx([step_end])


@pytest.mark.parametrize("later", [1.9, 2.1, 3.0, 9.0, -1.0, 400.0])
def test_line_search_leaves_undefined_start(later):
    undefined = replace(STEP_TO_ONE, observe=lambda _x, t, i: (np.where(t[0] == 0.0, np.nan, t[0]) + 0.0 * i)[None])
    assert _line_search(undefined, np.zeros(1), np.array([later])) == pytest.approx([later])


@pytest.fixture
def moves(monkeypatch) -> list:
    """Moves and covariances by which a filter judges whether it stands still."""
    calls: list = []
    monkeypatch.setattr(kalman, "_stands_still", lambda move, cov: calls.append((move, cov)))
    return calls


@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_settling_compares_last_belief(moves, drift):
    estimate = ExtendedKalman(smoother_passes=1).estimate(square(drift=drift))
    ((move, _),) = moves
    np.testing.assert_allclose(move, estimate.belief.mean - estimate.path[-1], rtol=1e-9)
    assert abs(move[0]) > 1e-6


@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_settling_scales_by_last_covariance(moves, drift):
    linear = ExtendedKalman(smoother_passes=1).estimate(line(drift=np.full(2, drift)))
    np.testing.assert_allclose(moves[0][1], linear.belief.cov, rtol=1e-6)


def test_filter_ends_within_bounds():
    means = np.array([[0.0, 1.0], [2.0, 3.0], [60.0, 0.0]])
    covs = np.array([np.eye(2), 9.0 * np.eye(2), np.eye(2)])
    covs[2, 0, 1] = covs[2, 1, 0] = 0.5
    np.testing.assert_allclose(_point(line(), FilterPass(means, covs, [], [])), [50.0, -5.0])


@pytest.mark.parametrize("estimator", [ExtendedKalman(), UnscentedKalman()])
def test_lost_pass_is_counted(estimator):
    broken = line(observe=lambda _x, theta, i: np.where(np.asarray(i) == 7, np.nan, theta[0] + theta[1] * X[i])[None])
    estimate = estimator.estimate(broken)
    assert (estimate.status, estimate.n_evals) == ("diverged", 5)


def test_last_mean_replaces_that_of_pass():
    filtered = forward(square(), tangent)
    np.testing.assert_array_equal(_with_last_mean(square(), filtered, np.array([7.0])).means,
                                  [*filtered.means[:2], [7.0]])  # fmt: skip


@pytest.mark.parametrize(
    ("move", "is_still"),
    [
        ([0.99e-4 * 2.0, 0.0], True), ([1.01e-4 * 2.0, 0.0], False), ([0.0, 1.1e-15], False), ([0.0, 0.9e-15], True),
        ([], True),
    ],
)  # fmt: skip
def test_still_filter_moves_within_deviation(move, is_still):
    """By less than a ten-thousandth of it, of 4 and of 0."""
    assert _stands_still(np.array(move), np.diag([9.0, 4.0, 0.0])) == is_still


def test_innovations_are_standardised():
    precision = np.array([[4.0, 1.0], [1.0, 2.0]])
    error = np.array([0.3, -0.7])
    whole = Correction(np.eye(2), np.eye(2), precision, error, np.eye(2))
    half = Correction(np.eye(1, 2), np.eye(2, 1), precision[1:, 1:], error[1:], np.eye(1))
    problem = replace(line(), measured=np.array([[1.0, 1.0], [np.nan, 1.0]]), sigma=np.ones(2))
    rows = standardise_innovations(problem, [whole, half])
    np.testing.assert_allclose(rows, [sqrtm(precision) @ error, [np.nan, np.sqrt(2.0) * -0.7]])


FROM_OUTSIDE = line(prior=unknown(np.array([60.0, 0.0])))
"""A prior's mean beyond the bounds."""
each_compiled_filter = pytest.mark.parametrize(
    ("estimator", "points", "passes"),
    [(ExtendedKalman(name="ekf"), False, 2), (UnscentedKalman(polish=False), True, 5)],
    ids=["ekf", "ukf"],
)
each_ending = pytest.mark.parametrize(("off", "serves"), [(0.0, True), (0.2, False)], ids=["optimum", "off"])


def with_compiled_filter(off: float, arguments: list) -> Problem:
    """The line with a compiled filter that ends so far off the optimum, after three passes."""
    best = np.linalg.lstsq(0.1 * SLOPES, FROM_OUTSIDE.measured[:, 0], rcond=None)[0]

    def run_filter(*args):
        arguments.extend(args)
        return np.full((12, 2), 60.0), np.ones((12, 2)), best + np.array([off, 0.0]), 0.001 * np.eye(2), 3

    return replace(FROM_OUTSIDE, kernels=Kernels(FROM_OUTSIDE.simulate, FROM_OUTSIDE.chi2, kalman=run_filter))


@each_compiled_filter
@each_ending
def test_compiled_filter_must_reach_optimum(estimator, points, passes, off, serves):
    belief = estimator.estimate(with_compiled_filter(off, [])).belief
    assert bool(belief.cov[0, 0] == 0.001) is serves


@each_compiled_filter
@each_ending
def test_compiled_filter_starts_within_bounds(estimator, points, passes, off, serves):
    arguments: list = []
    estimator.estimate(with_compiled_filter(off, arguments))
    np.testing.assert_array_equal(arguments[0], [50.0, 0.0])
    np.testing.assert_allclose(arguments[1], np.eye(2) * 100.0**2 / 12.0)
    assert arguments[2].all()
    assert arguments[5:] == [points, 5 if points else 20, 1e-4]


@each_compiled_filter
def test_compiled_filter_reports_its_passes(estimator, points, passes):
    estimate = estimator.estimate(with_compiled_filter(0.0, []))
    assert (estimate.n_evals, estimate.status, estimate.method) == (4 * passes, "converged", estimator.name)
    assert (estimate.path == 50.0).all()  # kept inside the bounds


@each_compiled_filter
@each_ending
def test_single_compiled_pass_is_final(estimator, points, passes, off, serves):
    """Not put aside: one pass is what was asked for."""
    without = replace(estimator, smoother_passes=0).estimate(with_compiled_filter(off, []))
    assert (without.status, without.n_evals) == ("converged" if serves else "approximate", 4 * passes)


@each_compiled_filter
@each_ending
def test_drifting_problem_is_not_compiled(estimator, points, passes, off, serves):
    moving = replace(with_compiled_filter(off, []), drift=np.array([0.1, 0.1]))
    assert estimator.estimate(moving).innovations is not None


NONFINITE = [Belief(np.array([np.nan, 0.0]), np.eye(2)), Belief(np.zeros(2), np.diag([np.inf, 1.0]))]
POINTS = MerweScaledSigmaPoints(2, 1.0, 0.0, 0.0, sqrt_method=upper_root)
BELIEF = Belief(np.array([1.5, -1.0]), np.diag([0.25, 0.09]))
FREE = np.full(2, np.inf)


def test_sigma_points_linearise_a_square():
    """z0^2 of N(m, P): mean m^2 + P, slope 2 m, left over P either way with these weights."""
    fit = regression(POINTS, lambda z: z[:1] ** 2, BELIEF, -FREE, FREE)
    np.testing.assert_allclose(fit.slope, [[3.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(fit.offset, [1.5**2 + 0.25 - 4.5], atol=1e-9)
    np.testing.assert_allclose(fit.spread, [[0.0625]], atol=1e-9)


def test_sigma_points_stay_within_bounds():
    inside = regression(POINTS, lambda z: z[:1], BELIEF, -FREE, np.array([1.5, 9.0]))
    np.testing.assert_allclose(inside.slope, [[0.5, 0.0]], atol=1e-9)


def test_exact_belief_has_sigma_points():
    exact = regression(POINTS, lambda z: z[:1], Belief(np.array([1.0, 0.0]), np.zeros((2, 2))), -FREE, FREE)
    np.testing.assert_allclose(exact.slope, [[1.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize(
    ("belief", "scale"),
    [
        *((belief, 1.0) for belief in NONFINITE),
        (BELIEF, np.inf),
    ],
    ids=["mean", "covariance", "function"],
)
def test_nonfinite_sigma_points_are_lost(belief, scale):
    with pytest.raises(LostTrackError):
        regression(POINTS, lambda z: scale * z[:1], belief, -FREE, FREE)


@pytest.mark.parametrize(
    ("matrix", "root"),
    [(np.diag([0.0, 4.0]), np.diag([2e-6, 2.0])), (np.zeros((1, 1)), [[1e-12]])],
)
def test_zero_variance_has_tiny_root(matrix, root):
    np.testing.assert_allclose(upper_root(matrix), root, rtol=1e-9)


@pytest.mark.parametrize("lift", [1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2])
def test_root_lifts_excess_correlation(lift):
    """A correlation above 1 by less."""
    root = upper_root(np.array([[4.0, 2.0 * (1.0 + 0.93 * lift)], [2.0 * (1.0 + 0.93 * lift), 1.0]]))
    assert root[0, 0] ** 2 / 4.0 - 1.0 == pytest.approx(lift, rel=0.05, abs=6e-16)


def test_impossible_correlation_is_dropped():
    np.testing.assert_array_equal(upper_root(np.array([[4.0, 4.0], [4.0, 1.0]])), np.diag([2.0, 1.0]))


OFF_BOUND = Belief(np.array([2.0, 0.5]), np.eye(2))


def test_tangent_is_one_sided_at_bound():
    linear = tangent(
        lambda z: np.stack([z[0] * z[1], z[0] ** 2]), OFF_BOUND, np.array([-9.0, -9.0]), np.array([1.0, 9.0])
    )
    np.testing.assert_allclose(linear.slope, [[0.5, 1.0], [2.0, 0.0]], atol=1e-4)
    np.testing.assert_allclose(linear.slope @ [1.0, 0.5] + linear.offset, [0.5, 1.0], rtol=1e-9)
    np.testing.assert_array_equal(linear.spread, np.zeros((2, 2)))


def test_tangent_holds_fixed_coordinate():
    fixed = tangent(lambda z: z[:1] * z[1:], OFF_BOUND, np.array([2.0, -9.0]), np.array([2.0, 9.0]))
    np.testing.assert_allclose(fixed.slope, [[0.0, 2.0]], atol=1e-9)


def test_tangent_steps_follow_rounding():
    """The cube root of it, of the value or of the deviation, which counts from 1e-6 to 1000."""
    ends: list = []
    at = Belief(np.array([0.0, 0.0, -7.0, 0.0]), np.diag([0.0, 5000.0**2, 1.0, 0.25]))
    tangent(lambda z: (ends.append(z), z)[1], at, np.full(4, -9e9), np.full(4, 9e9))
    size = np.cbrt(2.0**-52) * np.array([1e-6, 1e3 + 1e-6, 7.0, 0.5 + 1e-6])
    np.testing.assert_allclose(ends[0][:, :4] - ends[0][:, 8:], np.diag(size), rtol=1e-8, atol=1e-15)
    np.testing.assert_allclose(ends[0][:, 8:] - ends[0][:, 4:8], np.diag(size), rtol=1e-8, atol=1e-15)


def test_trajectory_has_no_covariance():
    walk = replace(square(), transition=lambda x, t, _i: x + t[0], start=Belief(np.array([2.0]), np.array([[1.0]])))
    beliefs = trajectory(walk, np.array([0.5]))
    np.testing.assert_allclose([b.mean for b in beliefs], [[2.0, 0.5], [2.5, 0.5], [3.0, 0.5]])
    assert not any(b.cov.any() for b in beliefs)


def report_belief(belief: Belief, status: str) -> Estimate:
    return report(line(), belief, status, 7, path=np.zeros((12, 2)), path_sd=np.ones((12, 2)), method="m")


@pytest.mark.parametrize("belief", NONFINITE)
def test_nonfinite_report_diverges(belief):
    result = report_belief(belief, "converged")
    assert (result.status, result.n_evals, result.method) == ("diverged", 7, "m")


def test_report_keeps_belief_off_optimum():
    result = report_belief(Belief(np.array([0.3, 0.2]), np.eye(2)), "approximate")
    assert (result.status, result.n_evals, result.belief.mean.tolist()) == ("approximate", 7, [0.3, 0.2])


@pytest.fixture(scope="module")
def doubtful() -> Estimate:
    """A line's estimate with a weak parameter, a better optimum and the passes that it took to find them."""
    fitted = NonlinearLeastSquares().estimate(line(prior=unknown(np.array([3.0, 0.0]))))
    return replace(fitted, weak=("slope",), better=np.array([2.0, 0.25]), n_checks=17)


def test_summary_lists_the_fit(doubtful):
    head = [
        "    status               = converged",
        f"    model evaluations    = {doubtful.n_evals}, and 17 to question the answer",
        "    values               = 12",
        "    free parameters      = 2",
        "    degrees of freedom   = 10",
        f"    reduced chi-square   = {doubtful.fit.chi2 / 10:.6g}",
        "    fit                  = adequate: model and sigma explain the record",
    ]
    assert set(head) <= set(doubtful.summary().splitlines())


def test_summary_lists_parameters(doubtful):
    cov = np.linalg.inv(doubtful.identifiability.information)
    sd = np.sqrt(np.diag(cov))
    mean = doubtful.belief.mean
    scaled = f"scaled {doubtful.fit.scaled_sd[0]:.4g}"
    lines = doubtful.summary().splitlines()
    row = next(text for text in lines if text.startswith("    offset "))
    assert row.startswith(f"    offset  {mean[0]:.8g} +/- {sd[0]:.4g} ({100 * sd[0] / mean[0]:.2f} %), {scaled}")
    assert row.endswith("(init 3)")
    assert f"    C(offset, slope) = {cov[0, 1] / sd[0] / sd[1]:+.4f}" in lines


@pytest.mark.parametrize(
    ("heading", "line_below"),
    [("[[Left open by the data]]", "    slope"), ("[[A better optimum]]", "    near offset 2, slope 0.25")],
)
def test_summary_lists_doubts(doubtful, heading, line_below):
    lines = doubtful.summary().splitlines()
    assert lines[lines.index(heading) + 1] == line_below


def test_summary_omits_impossible_shares(doubtful):
    """No share of nothing, nor of no end."""
    wide = replace(doubtful, belief=Belief(np.array([0.0, 2.0]), np.diag([4.0, np.inf]))).summary().splitlines()
    rows = [text.partition(", ")[0] for text in wide if text.startswith(("    offset ", "    slope  "))]
    assert rows == ["    offset  0 +/- 2", "    slope   2 +/- inf"]


RHO = np.array([[1.0, -0.101, 0.099], [-0.101, 1.0, 0.4], [0.099, 0.4, 1.0]])
SIZES = np.diag([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("cov", "lines"),
    [
        (SIZES @ RHO @ SIZES, ["    C(b, c) = +0.4000", "    C(a, b) = -0.1010"]),
        (np.eye(3), []),
        (np.array([[1.0, 0.1], [0.1, 1.0]]), ["    C(a, b) = +0.1000"]),
    ],
)
def test_correlations_are_shown_from_a_tenth(cov, lines):
    n = len(cov)
    estimate = Estimate(Belief(np.ones(n), cov), "converged", 1, Identifiability(tuple("abc"[:n]), np.eye(n)))
    heading = ["[[Correlations]] (below 0.1 not shown)"] if lines else []
    assert _correlations(estimate) == heading + lines


@pytest.mark.parametrize(
    ("bounds", "prior", "expected"),
    [
        ([[-2.0, 2.0], [0.0, 5.0]], Belief(np.zeros(2), np.diag([9.0, 0.25])), [3e-3, 5e-4]),
        ([[-2.0, 2.0], [0.0, 5.0]], Belief(np.zeros(2), np.diag([9.0, np.inf])), [3e-3, 5e-3]),
        ([[-2.0, np.inf], [1.0, 1.0]], unknown(np.array([-7.0, 1.0])), [7e-3, 1e-3]),
    ],
)
def test_scale_at_zero_follows_prior(bounds, prior, expected):
    np.testing.assert_allclose(_scale(line(bounds=np.array(bounds), prior=prior)), expected)
