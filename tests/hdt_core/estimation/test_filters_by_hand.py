"""Filters and the report against sums written out."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints
from scipy.linalg import sqrtm

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

X = np.linspace(-1.0, 2.0, 12)


def line(**more) -> Problem:
    noise = 0.1 * np.where(np.arange(12) % 4 % 3 == 0, 1.0, -1.0)
    fields = {"names": ("offset", "slope"), "bounds": np.tile([-50.0, 50.0], (2, 1)),
             "prior": Belief(np.zeros(2), 4.0 * np.eye(2)), "measured": (1.0 + 0.5 * X + noise)[:, None],
             "sigma": np.array([0.1]), "observe": lambda _x, theta, i: (theta[0] + theta[1] * X[i])[None]}  # fmt: skip
    return Problem(**(fields | more))


@pytest.mark.parametrize(
    ("estimator", "passes"),
    [
        (ExtendedKalman(), 2),
        (ExtendedKalman(smoother_passes=0), 1),
        (UnscentedKalman(smoother_passes=0, polish=False), 1),
    ],
)
def test_linear_pass_costs_five_evaluations(estimator, passes):
    """A straight line is filtered once, and once more to see that it stands still."""
    estimate = estimator.estimate(line())
    assert (estimate.status, estimate.n_evals) == ("converged", 5 * passes)
    assert UnscentedKalman().estimate(line()).n_evals > 10
    np.testing.assert_allclose(estimate.path[-1], estimate.belief.mean, rtol=1e-6)
    slope = np.column_stack([np.ones(12), X]) / 0.1
    for k in (0, 5):
        cov = np.linalg.inv(slope[: k + 1].T @ slope[: k + 1] + 0.25 * np.eye(2))
        np.testing.assert_allclose(estimate.path_sd[k], np.sqrt(np.diag(cov)), rtol=1e-6)
        path = cov @ slope[: k + 1].T @ line().measured[: k + 1, 0] / 0.1
        np.testing.assert_allclose(estimate.path[k], path, rtol=1e-6)


def square(measured=4.0, drift=0.0, sigma=0.1) -> Problem:
    return Problem(
        ("x",),
        np.array([[0.1, 9.0]]),
        Belief(np.array([1.0]), np.array([[1.0]])),
        np.full((3, 1), measured),
        np.array([sigma]),
        lambda _x, t, i: (t[0] ** 2 + 0.0 * i)[None],
        drift=np.array([drift]),
    )


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


def test_estimator_defaults():
    assert ExtendedKalman() == ExtendedKalman("ekf", 20)
    assert UnscentedKalman() == UnscentedKalman("ukf", 1.0, 0.0, 0.0, 5, True)
    assert PhysicsInformedNet() == PhysicsInformedNet("pinn", 30, (0.1, 0.01), 100, True, 0)
    estimate = PhysicsInformedNet().estimate(line())
    assert estimate.method == "pinn, no dynamics, finished by least squares"
    assert estimate.n_evals == NonlinearLeastSquares().estimate(line()).n_evals


@pytest.mark.parametrize(
    ("later", "step_end"), [(1.9, 1.9), (2.1, 1.05), (3.0, 1.5), (9.0, 1.125), (-1.0, -1.0), (400.0, 400.0)]
)
def test_line_search_halves_the_step(later, step_end):
    """The objective is (x - 1)^2 from 0: seven halvings at most, and the full step where none pays."""
    one = Problem(("x",), np.array([[-999.0, 999.0]]), unknown(np.zeros(1)), np.ones((1, 1)), np.ones(1),
                  lambda _x, t, i: (t[0] + 0.0 * i)[None])  # fmt: skip
    assert _line_search(one, np.zeros(1), np.array([later])) == pytest.approx([step_end])
    assert _line_search(one, np.zeros(1), np.array([2.0**7 * 1.99])) == pytest.approx([1.99])
    assert _line_search(one, np.zeros(1), np.array([2.0**8 * 1.99])) == pytest.approx([2.0**8 * 1.99])
    undefined = replace(one, observe=lambda _x, t, i: (np.where(t[0] == 0.0, np.nan, t[0]) + 0.0 * i)[None])
    assert _line_search(undefined, np.zeros(1), np.array([later])) == pytest.approx([later])


@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_settling_compares_last_belief(monkeypatch, drift):
    moves: list = []
    monkeypatch.setattr(kalman, "_stands_still", lambda move, cov: moves.append((move, cov)))
    estimate = ExtendedKalman(smoother_passes=1).estimate(square(drift=drift))
    ((move, _),) = moves
    np.testing.assert_allclose(move, estimate.belief.mean - estimate.path[-1], rtol=1e-9)
    assert abs(move[0]) > 1e-6
    moves.clear()
    linear = ExtendedKalman(smoother_passes=1).estimate(line(drift=np.full(2, drift)))
    np.testing.assert_allclose(moves[0][1], linear.belief.cov, rtol=1e-6)


def test_filter_ends_within_bounds():
    means = np.array([[0.0, 1.0], [2.0, 3.0], [60.0, 0.0]])
    covs = np.array([np.eye(2), 9.0 * np.eye(2), np.eye(2)])
    covs[2, 0, 1] = covs[2, 1, 0] = 0.5
    np.testing.assert_allclose(_point(line(), FilterPass(means, covs, [], [])), [50.0, -5.0])
    broken = line(observe=lambda _x, theta, i: np.where(np.asarray(i) == 7, np.nan, theta[0] + theta[1] * X[i])[None])
    for estimator in (ExtendedKalman(), UnscentedKalman()):
        estimate = estimator.estimate(broken)
        assert (estimate.status, estimate.n_evals) == ("diverged", 5)
    filtered = forward(square(), tangent)
    np.testing.assert_array_equal(_with_last_mean(square(), filtered, np.array([7.0])).means,
                                  [*filtered.means[:2], [7.0]])  # fmt: skip
    cov = np.diag([9.0, 4.0, 0.0])
    assert _stands_still(np.array([0.99e-4 * 2.0, 0.0]), cov)
    assert not _stands_still(np.array([1.01e-4 * 2.0, 0.0]), cov)
    assert not _stands_still(np.array([0.0, 1.1e-15]), cov)
    assert _stands_still(np.array([0.0, 0.9e-15]), cov)
    assert _stands_still(np.zeros(0), cov)
    precision = np.array([[4.0, 1.0], [1.0, 2.0]])
    error = np.array([0.3, -0.7])
    whole = Correction(np.eye(2), np.eye(2), precision, error, np.eye(2))
    half = Correction(np.eye(1, 2), np.eye(2, 1), precision[1:, 1:], error[1:], np.eye(1))
    problem = line(measured=np.array([[1.0, 1.0], [np.nan, 1.0]]), sigma=np.ones(2))
    rows = standardise_innovations(problem, [whole, half])
    np.testing.assert_allclose(rows, [sqrtm(precision) @ error, [np.nan, np.sqrt(2.0) * -0.7]])


@pytest.mark.parametrize(("points", "passes"), [(False, 2), (True, 5)])
@pytest.mark.parametrize(("mean", "n_passes", "serves"), [([1.0, 0.5], 3, True), ([1.2, 0.5], 3, False)])
def test_compiled_filter_must_reach_optimum(points, passes, mean, n_passes, serves):
    arguments: list = []

    def kalman(*args):
        arguments.extend(args)
        return np.full((12, 2), 60.0), np.ones((12, 2)), np.array(mean), 0.001 * np.eye(2), n_passes

    problem = line(prior=unknown(np.array([60.0, 0.0])), sigma=np.array([0.1]))
    best = np.linalg.lstsq(np.column_stack([np.ones(12), X]), problem.measured[:, 0], rcond=None)[0]
    mean[:] = best + np.array([mean[0] - 1.0, 0.0])
    kernels = Kernels(problem.simulate, problem.chi2, kalman=kalman)
    estimator = UnscentedKalman(polish=False) if points else ExtendedKalman(name="ekf")
    estimate = estimator.estimate(replace(problem, kernels=kernels))
    assert bool(estimate.belief.cov[0, 0] == 0.001) is serves
    np.testing.assert_array_equal(arguments[0], [50.0, 0.0])  # the prior's mean inside the bounds
    np.testing.assert_allclose(arguments[1], np.eye(2) * 100.0**2 / 12.0)
    assert arguments[2].all()
    assert arguments[5:] == [points, 5 if points else 20, 1e-4]
    if serves:
        assert estimate.n_evals == (1 + n_passes) * passes
        assert estimate.status == "converged"
        assert estimate.method == estimator.name
        assert (estimate.path == 50.0).all()  # kept inside the bounds
    without = replace(estimator, smoother_passes=0).estimate(replace(problem, kernels=kernels))
    assert without.status == ("converged" if serves else "approximate")
    assert without.n_evals == (1 + n_passes) * passes  # not put aside: one pass is what was asked for
    moving = estimator.estimate(replace(problem, kernels=kernels, drift=np.array([0.1, 0.1])))
    assert moving.innovations is not None


def test_sigma_points_linearise_a_square():
    """z0^2 of N(m, P): mean m^2 + P, slope 2 m, left over P either way with these weights."""
    points = MerweScaledSigmaPoints(2, 1.0, 0.0, 0.0, sqrt_method=upper_root)
    belief = Belief(np.array([1.5, -1.0]), np.diag([0.25, 0.09]))
    free = np.full(2, np.inf)
    fit = regression(points, lambda z: z[:1] ** 2, belief, -free, free)
    np.testing.assert_allclose(fit.slope, [[3.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(fit.offset, [1.5**2 + 0.25 - 4.5], atol=1e-9)
    np.testing.assert_allclose(fit.spread, [[0.0625]], atol=1e-9)
    inside = regression(points, lambda z: z[:1], belief, -free, np.array([1.5, 9.0]))
    np.testing.assert_allclose(inside.slope, [[0.5, 0.0]], atol=1e-9)
    exact = regression(points, lambda z: z[:1], Belief(np.array([1.0, 0.0]), np.zeros((2, 2))), -free, free)
    np.testing.assert_allclose(exact.slope, [[1.0, 0.0]], atol=1e-6)
    for bad in (Belief(np.array([np.nan, 0.0]), np.eye(2)), Belief(np.zeros(2), np.diag([np.inf, 1.0]))):
        with pytest.raises(LostTrackError):
            regression(points, lambda z: z[:1], bad, -free, free)
    with pytest.raises(LostTrackError):
        regression(points, lambda z: np.inf * z[:1], belief, -free, free)
    np.testing.assert_allclose(upper_root(np.diag([0.0, 4.0])), np.diag([2e-6, 2.0]), rtol=1e-9)
    np.testing.assert_allclose(upper_root(np.zeros((1, 1))), [[1e-12]])
    for lift in (1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2):  # a correlation above 1 by less has this root
        root = upper_root(np.array([[4.0, 2.0 * (1.0 + 0.93 * lift)], [2.0 * (1.0 + 0.93 * lift), 1.0]]))
        assert root[0, 0] ** 2 / 4.0 - 1.0 == pytest.approx(lift, rel=0.05, abs=6e-16)
    np.testing.assert_array_equal(upper_root(np.array([[4.0, 4.0], [4.0, 1.0]])), np.diag([2.0, 1.0]))


def test_tangent_is_one_sided_at_bound():
    belief = Belief(np.array([2.0, 0.5]), np.eye(2))
    lower = np.array([-9.0, -9.0])
    upper = np.array([1.0, 9.0])
    linear = tangent(lambda z: np.stack([z[0] * z[1], z[0] ** 2]), belief, lower, upper)
    np.testing.assert_allclose(linear.slope, [[0.5, 1.0], [2.0, 0.0]], atol=1e-4)
    np.testing.assert_allclose(linear.slope @ [1.0, 0.5] + linear.offset, [0.5, 1.0], rtol=1e-9)
    assert not linear.spread.any()
    assert linear.spread.shape == (2, 2)
    held = tangent(lambda z: z[:1] * z[1:], belief, np.array([2.0, -9.0]), np.array([2.0, 9.0]))
    np.testing.assert_allclose(held.slope, [[0.0, 2.0]], atol=1e-9)
    # steps are the cube root of the rounding, of the value or of the deviation, which counts from 1e-6 to 1000
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
    for belief in (Belief(np.array([np.nan, 0.0]), np.eye(2)), Belief(np.zeros(2), np.diag([np.inf, 1.0]))):
        result = report(line(), belief, "converged", 7, path=np.zeros((12, 2)), path_sd=np.ones((12, 2)), method="m")
        assert (result.status, result.n_evals, result.method) == ("diverged", 7, "m")
    whole = Belief(np.array([0.3, 0.2]), np.eye(2))  # a belief off the optimum stays where it is
    result = report(line(), whole, "approximate", 7, path=np.zeros((12, 2)), path_sd=np.ones((12, 2)), method="m")
    assert (result.status, result.n_evals, result.belief.mean.tolist()) == ("approximate", 7, [0.3, 0.2])


def test_summary_lists_all_results():
    problem = line(prior=unknown(np.array([3.0, 0.0])))
    fitted = NonlinearLeastSquares().estimate(problem)
    estimate = replace(fitted, weak=("slope",), better=np.array([2.0, 0.25]), n_checks=17)
    fit = estimate.fit
    cov = np.linalg.inv(estimate.identifiability.information)
    sd = np.sqrt(np.diag(cov))
    mean = estimate.belief.mean
    head = [
        "    status               = converged",
        f"    model evaluations    = {estimate.n_evals}, and 17 to question the answer",
        "    values               = 12",
        "    free parameters      = 2",
        "    degrees of freedom   = 10",
        f"    reduced chi-square   = {fit.chi2 / 10:.6g}",
        "    fit                  = adequate: model and sigma explain the record",
    ]
    lines = estimate.summary().splitlines()
    assert set(head) <= set(lines)
    row = next(text for text in lines if text.startswith("    offset "))
    assert row.startswith(
        f"    offset  {mean[0]:.8g} +/- {sd[0]:.4g} ({100 * sd[0] / mean[0]:.2f} %), scaled {fit.scaled_sd[0]:.4g}"
    )
    assert row.endswith("(init 3)")
    assert f"    C(offset, slope) = {cov[0, 1] / sd[0] / sd[1]:+.4f}" in lines
    assert lines[lines.index("[[Left open by the data]]") + 1] == "    slope"
    wide = replace(estimate, belief=Belief(np.array([0.0, 2.0]), np.diag([4.0, np.inf]))).summary().splitlines()
    rows = [text.partition(", ")[0] for text in wide if text.startswith(("    offset ", "    slope  "))]
    assert rows == ["    offset  0 +/- 2", "    slope   2 +/- inf"]  # no share of nothing, nor of no end
    assert lines[lines.index("[[A better optimum]]") + 1] == "    near offset 2, slope 0.25"
    rho = np.eye(3)
    rho[0, 1] = rho[1, 0] = -0.101
    rho[0, 2] = rho[2, 0] = 0.099
    rho[1, 2] = rho[2, 1] = 0.4
    information = Identifiability(("a", "b", "c"), np.eye(3))
    sizes = np.diag([1.0, 2.0, 3.0])
    lines_shown = _correlations(Estimate(Belief(np.ones(3), sizes @ rho @ sizes), "converged", 1, information))
    assert lines_shown == ["[[Correlations]] (below 0.1 not shown)", "    C(b, c) = +0.4000", "    C(a, b) = -0.1010"]
    assert _correlations(Estimate(Belief(np.ones(3), np.eye(3)), "converged", 1, information)) == []
    tenth = Belief(np.ones(2), np.array([[1.0, 0.1], [0.1, 1.0]]))
    pair = Identifiability(("a", "b"), np.eye(2))
    assert _correlations(Estimate(tenth, "converged", 1, pair))[1:] == ["    C(a, b) = +0.1000"]


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
