"""The panel's least squares against dense matrices: every covariance written out, nothing eliminated."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from hdt_core.estimation.panel import Equation, Panel, PanelLeastSquares, Walk, forward_differences
from hdt_core.estimation.problem import Belief

P = 3
Q = 2
UNITS = 4
TIME = np.array([0, 0, 1, 4, 4, 5, 9, 10, 10, 12, 2, 3, 3, 4, 7, 8, 9, 9, 11, 6])
UNIT = np.repeat([0, 2, 3], [10, 9, 1])
TRUTH = np.array([0.3, -0.2, 0.1])


def equation(rng, sd: float, effect: float) -> Equation:
    """Linear in design and unit, one row unusable, one far off; level and slope go together, as under a controller."""
    level = np.where((UNIT == 2) & (TIME > 6), 0.8, 0.0) + 0.02 * TIME
    by_design = rng.standard_normal((UNIT.size, P)) + 0.3 * level[:, None]
    by_unit = rng.standard_normal((UNIT.size, Q))
    y = level - 0.1 * rng.standard_normal(UNIT.size)
    y[7], y[3] = np.nan, y[3] + 1.0
    return Equation(lambda d, u: y + by_design @ (d - TRUTH) + np.einsum("nq,qn->n", by_unit, u), sd, effect)


def panel(seed: int = 1, **changes) -> Panel:
    rng = np.random.default_rng(seed)
    values = {
        "names": tuple("abc"), "bounds": np.tile([-9.0, 9.0], (P, 1)), "unit": UNIT, "time": TIME,
        "prior": Belief(np.zeros(P), np.diag([0.3, 0.4, 0.5]) + 0.01),
        "unit_mean": 0.05 * rng.standard_normal((UNITS, Q)),
        "unit_sd": rng.uniform(0.05, 0.1, (UNITS, Q)), "noise_sd": rng.uniform(0.01, 0.05, (UNIT.size, Q)),
        "levelled": equation(rng, 0.03, 2.0), "walk": Walk(0.04, 0.03, 0.5), "others": (equation(rng, 0.2, 3.0),),
        "instruments": rng.standard_normal((UNIT.size, 5)), "step": np.ones(P), "unit_step": np.ones(Q),
        "prior_terms": lambda d: np.array([2.0 * (d[0] - d[1]) - 0.1]),
    }  # fmt: skip
    return Panel(**values | changes)


def columns_of(panel: Panel, equation: Equation, design, units):
    """Slopes of every parameter (n, p + units * q), those of each row's own unit, and the residual."""
    own = units[panel.unit].T
    residual = equation.residual(design, own)
    by_design = [equation.residual(design + e, own) - residual for e in np.eye(P)]
    by_unit = np.array([equation.residual(design, own + e[:, None]) - residual for e in np.eye(Q)]).T
    whole = np.zeros((len(residual), UNITS, Q))
    whole[np.arange(len(residual)), panel.unit] = by_unit
    return np.column_stack([*by_design, whole.reshape(len(residual), -1)]), by_unit, residual


def walk_covariance(keys: list[tuple[int, int]], loose: dict[int, float], effect: float) -> np.ndarray:
    """Covariance of the levels of each unit's times, its walk begun anew where it jumped."""
    walk = np.zeros((len(keys),) * 2)
    for i, (unit, _) in enumerate(keys):
        for j, (other, _) in enumerate(keys):
            steps = range(1, min(i, j) + 1)
            past = [loose.get(k, 1.0) * (keys[k][1] - keys[k - 1][1]) for k in steps if keys[k - 1][0] == unit]
            walk[i, j] = (unit == other) * (0.5**2 + 0.04**2 * effect * sum(past))
    return walk


def fit_by_instruments(instruments, slopes, precision, keys) -> np.ndarray:
    """Predictor of the levels: the first stage knows design and sensor, not whose sensor it is."""
    weighed = instruments.T @ precision
    fitted = instruments @ np.linalg.solve(weighed @ instruments, weighed @ slopes)
    owner = np.array([unit for unit, _ in keys])[:, None] == np.arange(UNITS)
    own = owner[:, :, None] * fitted[:, None, P:]
    return np.column_stack([fitted[:, :P], own.reshape(len(keys), -1)])


def dense(panel: Panel, n_steps: int):
    """Design, its covariance and the units after so many steps: generalised least squares of all rows at once."""
    design = panel.prior.mean
    units = panel.unit_mean
    level = None
    loose = {}
    keys = sorted({*zip(panel.unit, panel.time, strict=True)})
    of_row = np.array([keys.index(k) for k in zip(panel.unit, panel.time, strict=True)])
    for count in range(n_steps):
        normal = np.zeros((P + UNITS * Q,) * 2)
        normal[:P, :P] = np.linalg.inv(panel.prior.cov)
        normal[P:, P:] = np.diag(panel.unit_sd.ravel() ** -2.0)
        right = normal @ np.r_[panel.prior.mean - design, (panel.unit_mean - units).ravel()]
        for e in (panel.levelled, *panel.others):
            a, own, r = columns_of(panel, e, design, units)
            use = np.isfinite(r)
            a = a[use]
            own = own[use]
            r = r[use]
            weight = 1.0 / (((own * panel.noise_sd[use]) ** 2).sum(1) + e.sd**2)
            if level is not None:
                weight /= 1.0 + (r - (level[of_row[use]] if e is panel.levelled else 0.0)) ** 2 * weight / 9.0
            weight /= e.design_effect
            if e is not panel.levelled:
                normal = normal + a.T @ np.diag(weight) @ a
                right = right - a.T @ (weight * r)
                continue
            share = (of_row[use] == np.arange(len(keys))[:, None]) * weight
            total = share.sum(1)
            mean = share / total[:, None]
            walk = walk_covariance(keys, loose, e.design_effect)
            precision = np.linalg.inv(walk + np.diag(1.0 / total + 0.03**2 * e.design_effect))
            within = np.diag(weight) - share.T @ mean
            predictor = mean @ a
            if panel.instruments is not None:
                short = mean @ np.column_stack([a[:, :P], own])
                predictor = fit_by_instruments(mean @ panel.instruments[use], short, precision, keys)
            normal = normal + a.T @ within @ a + predictor.T @ precision @ predictor
            right = right - a.T @ within @ r - predictor.T @ precision @ mean @ r
            levels = walk @ precision @ mean @ np.column_stack([a, r])
        term = panel.prior_terms(design)
        slope = np.array([2.0, -2.0, 0.0])
        normal[:P, :P] += np.outer(slope, slope)
        right[:P] -= slope * term
        step = np.linalg.solve(normal, right)
        design = design + step[:P]
        units = units + step[P:].reshape(UNITS, Q)
        level = levels @ np.r_[step, 1.0]
        if count >= 3:
            jumps = {k for k in range(1, len(keys)) if abs(level[k] - level[k - 1]) > 4 * 0.04}
            loose = dict.fromkeys(jumps, 1001.0)
    return design, np.linalg.inv(normal)[:P, :P], units


@pytest.mark.parametrize("has_instruments", [True, False])
@pytest.mark.parametrize("n_steps", [1, 2, 6])
def test_panel_equals_generalised_least_squares(n_steps, has_instruments):
    declared = panel() if has_instruments else panel(instruments=None)
    estimate, units = PanelLeastSquares(max_steps=n_steps, tolerance=0.0, max_step=9.0).estimate(declared)
    design, cov, dense_units = dense(declared, n_steps)
    np.testing.assert_allclose(estimate.belief.mean, design, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(estimate.belief.cov, cov, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(units, dense_units, rtol=1e-9, atol=1e-12)
    assert (estimate.status, estimate.n_evals, estimate.method) == ("max_steps", n_steps * 6, "panel")
    # what is known besides the rows: the prior and the prior term
    beside = np.linalg.inv(declared.prior.cov) + np.outer([2.0, -2.0, 0.0], [2.0, -2.0, 0.0])
    np.testing.assert_allclose(estimate.identifiability.information, np.linalg.inv(cov) - beside, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("sure", [1.0, 1e-3])
def test_steps_end_once_design_settles(sure):
    """Within a ten-thousandth in every coordinate; with a design that is known beforehand that is soon."""
    declared = panel(prior=Belief(np.zeros(P), sure**2 * np.eye(P)))
    estimates = [PanelLeastSquares(max_steps=n).estimate(declared)[0] for n in range(1, 16)]
    whole = PanelLeastSquares().estimate(declared)[0]
    n = whole.n_evals // 6
    designs = [np.zeros(P), *(e.belief.mean for e in estimates[:n])]
    small = [bool(np.abs(b - a).max() < 1e-4) for a, b in pairwise(designs)]
    assert [e.status == "converged" for e in estimates[:n]] == small
    assert 7 <= n < 15
    assert small[-1]
    assert not any(small[6:-1])
    assert (n == 7) == (sure < 1.0)
    np.testing.assert_array_equal(whole.belief.mean, designs[-1])


def test_step_is_half_at_most():
    far = PanelLeastSquares(max_steps=1).estimate(panel(prior=Belief(np.full(P, 4.0), 1e9 * np.eye(P))))[0]
    np.testing.assert_array_equal(far.belief.mean, 3.5)


def test_derivatives_step_down_at_bound():
    slopes = forward_differences(lambda x: np.array([x[0] ** 2, x @ x]), np.ones(2), np.array([1.0, 2.0]),
                                 np.full(2, 0.5), np.array([1.5, 1.4]))  # fmt: skip
    np.testing.assert_allclose(slopes, [[2.5, 0.0], [2.5, 1.5]])


@pytest.mark.parametrize("limits", [(-9.0, 0.05), (0.5, 9.0)])
def test_others_follow_bounded_parameter(limits):
    """The optimum inside the bounds by the normal equations at that point; a fixed one has no variance."""
    bounds = np.array([limits, [-9.0, 9.0], [0.2, 0.2]])
    settings = PanelLeastSquares(max_steps=60, tolerance=1e-12, cauchy_sd=1e9, steps_before_jumps=99)
    plain = panel(prior=Belief(np.array([0.0, 0.0, 0.2]), np.eye(P)), instruments=None)
    estimate, free = (settings.estimate(p)[0] for p in (replace(plain, bounds=bounds), plain))
    root = np.linalg.cholesky(np.linalg.inv(free.belief.cov)).T
    within = bounds + np.array([0.0, 1e-12])
    expected = lsq_linear(root, root @ free.belief.mean, bounds=within.T, tol=1e-14).x
    assert 0.1 < free.belief.mean[0] < 0.4
    assert estimate.status == "at_bound"
    np.testing.assert_allclose(estimate.belief.mean, expected, atol=1e-8)
    assert estimate.belief.cov[2].tolist() == [0.0] * 3
    inner = np.linalg.inv(free.belief.cov)[:2, :2]
    np.testing.assert_allclose(estimate.belief.cov[:2, :2], np.linalg.inv(inner), rtol=1e-6)


def test_unobserved_parameter_stays_open():
    blind = equation(np.random.default_rng(3), 0.03, 2.0)
    no_third = Equation(lambda d, u: blind.residual(np.r_[d[:2], 0.0], u), 0.03, 2.0)
    prior = Belief(np.zeros(P), np.diag([1.0, 1.0, np.inf]))
    estimate = PanelLeastSquares().estimate(panel(levelled=no_third, others=(), prior=prior))[0]
    assert estimate.status == "not_identifiable"
    assert np.isinf(estimate.belief.sd).tolist() == [False, False, True]
    assert estimate.belief.mean[2] == 0.0
    assert not estimate.identifiability.identifiable


def test_empty_panel_keeps_its_priors():
    empty = panel(unit=UNIT[:0], time=TIME[:0])
    estimate, units = PanelLeastSquares().estimate(empty)
    assert (estimate.status, estimate.belief, estimate.n_evals) == ("converged", empty.prior, 0)
    np.testing.assert_array_equal(units, empty.unit_mean)


def test_single_row_updates_by_its_gain():
    one = panel(unit=UNIT[:1], time=TIME[:1], noise_sd=np.full((1, Q), 0.01), instruments=None, others=(),
                levelled=Equation(lambda d, u: 0.4 + d[:1] + u[0], 0.03), prior_terms=lambda d: d[:0])  # fmt: skip
    estimate, units = PanelLeastSquares(max_steps=1).estimate(one)
    variance = 0.5**2 + 0.03**2 + (0.01**2 + 0.03**2) + one.unit_sd[0, 0] ** 2
    gain = one.prior.cov[:, 0] / (one.prior.cov[0, 0] + variance)
    np.testing.assert_allclose(estimate.belief.mean, -gain * (0.4 + one.unit_mean[0, 0]), rtol=1e-6)
    np.testing.assert_array_equal(units[1:], one.unit_mean[1:])
