"""Steps, descents and swarms against plain linear algebra and one-line models."""

from dataclasses import replace

import numpy as np
import pytest
from small_problems import scalar_problem

from hdt_core.estimation import Belief, NonlinearLeastSquares, ParticleSwarm, Problem, descent, unknown
from hdt_core.estimation.compiled import (
    assess_optimum,
    damped_step,
    inverse_spd,
    is_exhausted,
    is_settled,
    next_damping,
)
from hdt_core.estimation.conclude import conclude_at
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.descent import Point, descend, distance_to_optimum
from hdt_core.estimation.fit import invert_information
from hdt_core.physics.model import Param, PhysicsModel, Signal, State

NORMAL = np.array([[4.0, 1.0, -0.5], [1.0, 9.0, 2.0], [-0.5, 2.0, 3.0]])
SIZE = np.array([2.0, 3.5, 1.8])


@pytest.mark.parametrize(
    ("gradient", "lower", "upper", "free", "ends"),
    [
        ([1.0, -2.0, 0.5], [-9, -9, -9], [9, 9, 9], [0, 1, 2], {}),
        ([1.0, -2.0, 0.5], [0, 0, 0], [9, 9, 9], [1], {}),  # two pressed against their lower bounds
        ([-1.0, -2.0, 0.5], [-9, -9, -9], [0, 9, 9], [1, 2], {}),  # one against its upper
        ([1.0, -2.0, 0.5], [-9, -9, -9], [0, 0.01, 9], [0, 1, 2], {1: 0.01}),  # a step ends on the bound
        ([1.0, -2.0, 0.5], [-0.01, -9, 0], [9, 9, 0], [0, 1], {0: -0.01}),  # and one is held
        ([-0.5, -2.0, 0.5], [0, -9, -9], [9, 9, 0], [0, 1, 2], {}),  # two leave their bounds
    ],
)
def test_damped_step_respects_bounds(gradient, lower, upper, free, ends):
    g = np.array(gradient)
    expected = np.zeros(3)
    matrix = (NORMAL + 0.3 * np.diag(SIZE**2))[np.ix_(free, free)]
    expected[free] = np.linalg.solve(matrix, -g[free])
    for i, end in ends.items():
        expected[i] = end
    step, promised = damped_step(NORMAL, g, SIZE, 0.3, np.zeros(3), np.array(lower, float), np.array(upper, float))
    np.testing.assert_allclose(step, expected, rtol=1e-12)
    assert promised == pytest.approx(-2.0 * g @ expected - expected @ NORMAL @ expected)


@pytest.mark.parametrize(
    ("damping", "won", "promised", "after"),
    [
        (0.5, 0.5, 1.0, (0.5, 2.0)), (0.5, 0.25, 1.0, (0.5 * 1.125, 2.0)), (0.5, 0.9, 1.0, (0.5 * 0.488, 2.0)),
        (0.5, 1.0, 1.0, (0.05, 2.0)), (0.5, 5.0, 1.0, (0.05, 2.0)), (2e-15, 1.0, 1.0, (1e-15, 2.0)),
        (0.5, 0.0, 1.0, (2.0, 8.0)), (0.5, -1.0, 1.0, (2.0, 8.0)), (0.5, 1.0, 0.0, (2.0, 8.0)),
    ],
)  # fmt: skip
def test_damping_follows_nielsen(damping, won, promised, after):
    assert next_damping(damping, 4.0, won, promised) == pytest.approx(after, rel=1e-12)


BOX = Problem(("a", "b", "c", "d"), np.array([[-1.0, 3.0], [-np.inf, np.inf], [-np.inf, 5.0], [2.0, 2.0]]),
              Belief(np.array([0.0, 1.0, 4.0, 0.0]), np.diag([1.0, 4.0, np.inf, np.inf])), np.zeros((1, 1)), np.ones(1),
              lambda _x, theta, i: (theta[0] ** 2 + theta[1] * theta[2] + 0.0 * i)[None])  # fmt: skip
BEYOND = pytest.mark.parametrize(("share", "expected"), [(0.99, True), (1.01, False)])


@BEYOND
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_settled_step_gains_next_to_nothing(sign, share, expected):
    """A hundred-millionth of the residuals' variance; 1e-22 without noise."""
    assert is_settled(sign * share * 1e-8 * 500.0 / 50, 500.0, 50) == expected
    assert is_settled(sign * share * 1e-22, 0.0, 50) == expected


@BEYOND
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_unpaid_step_exhausts_the_descent(sign, share, expected):
    """One that promised a trillionth of the objective."""
    assert is_exhausted(sign * share * 1e-12 * 500.0, 0.0, 500.0) == expected


def test_paid_step_exhausts_nothing():
    assert not is_exhausted(0.0, 1e-9, 500.0)


@pytest.mark.parametrize(
    ("prior", "box"),
    [
        (None, [[-1.0, -7.0, -36.0, 2.0], [3.0, 9.0, 5.0, 2.0]]),
        (unknown(np.array([0.0, 0.5, 0.0, 0.0])), [[-1.0, -9.5, -10.0, 2.0], [3.0, 10.5, 5.0, 2.0]]),
    ],
)
def test_search_box_bounds_every_parameter(prior, box):
    """Bounds, else four deviations of the prior, else ten times the start or ten."""
    np.testing.assert_allclose((BOX if prior is None else replace(BOX, prior=prior)).search_box, box)


def test_inverse_equals_numpy():
    inverse, determinant = inverse_spd(NORMAL)
    np.testing.assert_allclose(inverse, np.linalg.inv(NORMAL), rtol=1e-12)
    assert determinant == pytest.approx(np.linalg.det(NORMAL) / (4.0 * 9.0 * 3.0))


@pytest.mark.parametrize("singular", [[[1.0, 0.0], [0.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]]])
def test_singular_matrix_has_no_determinant(singular):
    assert inverse_spd(np.array(singular))[1] == 0.0


@pytest.mark.parametrize(("share", "is_off"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("side", [0, 1])
def test_optimum_equals_linear_algebra(share, is_off, side):
    """Inverse, determinant, decrement, and whether it lies off its bounds by a thousandth of a deviation."""
    gradient = np.array([0.3, -0.2, 0.1])
    inverse, determinant = inverse_spd(NORMAL)
    bounds = np.tile([-9.0, 9.0], (3, 1))
    bounds[1, side] = (2 * side - 1) * share * 1e-3 * np.sqrt(np.linalg.inv(NORMAL)[1, 1])
    optimum = assess_optimum(NORMAL, gradient, np.zeros(3), bounds)
    np.testing.assert_allclose(optimum[0], inverse)
    assert optimum[1:] == pytest.approx((determinant, np.sqrt(gradient @ inverse @ gradient), is_off))


TIME = np.linspace(0.0, 3.0, 9)
DECAY = 2.0 * np.exp(-1.3 * TIME) + 0.05 * np.sin(9.0 * TIME)


def decay(theta0, measured=DECAY, **more) -> Problem:
    return Problem(("level", "rate"), np.tile([-50.0, 50.0], (2, 1)), unknown(np.array(theta0)), measured[:, None],
                   np.array([0.1]), lambda _x, t, i: (t[0] * np.exp(-t[1] * TIME[i]))[None], **more)  # fmt: skip


def steps_by_hand(theta, most):
    """Levenberg and Marquardt with Nielsen's damping, passes over the record counted."""

    def at(t):
        bell = np.exp(-t[1] * TIME)
        r = (t[0] * bell - DECAY) / 0.1
        slope = np.column_stack([bell, -t[0] * TIME * bell]) / 0.1
        return r @ r, slope.T @ r, slope.T @ slope

    cost, gradient, normal = at(theta)
    evals = 5
    mu = 1e-3
    growth = 2.0
    size = np.zeros(2)
    for _ in range(most):
        size = np.maximum(size, np.diag(normal))
        step = -np.linalg.solve(normal + mu * np.diag(size), gradient)
        promised = -2.0 * gradient @ step - step @ normal @ step
        if promised < 1e-8 * cost / 9:
            return theta + step, evals
        won = cost - at(theta + step)[0]
        evals += 1
        mu, growth = (
            (mu * max(0.1, 1.0 - (2.0 * min(won / promised, 1.0) - 1.0) ** 3), 2.0)
            if won > 0
            else (mu * growth, 2 * growth)
        )
        if won > 0:
            theta = theta + step
            evals += 5
            cost, gradient, normal = at(theta)
    return theta, evals


@pytest.mark.parametrize("start", [(0.1, 4.0), (5.0, 0.1)])
@pytest.mark.parametrize("most", [1, 2, 3, 4, 5, 6, 8, 50])
def test_descent_equals_hand_steps(start, most):
    theta, evals = steps_by_hand(np.array(start), most)
    point = descend(decay(start), np.array(start), most)
    np.testing.assert_allclose(point.theta, theta, rtol=1e-6)
    assert point.n_evals == evals
    assert descend(decay(start), np.array(start), most, 7).n_evals == evals + 7


def test_descent_ends_after_200_steps(monkeypatch):
    monkeypatch.setattr(descent, "damped_step", lambda *_: (np.array([-1.0]), 1e3))
    point = descend(scalar_problem(bounds=(-9e9, 9e9)), np.array([1000.0]))
    assert (point.theta.tolist(), point.n_evals) == ([800.0], 3 + 200 * 4)


def test_descent_stays_without_an_answer():
    nowhere = decay((1.0, -1000.0))
    point = descend(nowhere, np.array([1.0, -1000.0]), n_evals=3)
    assert (point.objective, point.n_evals, point.theta.tolist()) == (np.inf, 3 + 5, [1.0, -1000.0])
    assert conclude_at(nowhere, point).status == "diverged"


def test_least_squares_takes_200_steps():
    assert (NonlinearLeastSquares().max_steps, NonlinearLeastSquares().name) == (200, "nls")


DIAGONAL = [[4.0, 0.0], [0.0, 9.0]]
OPEN = [[-9, 9]] * 2


@pytest.mark.parametrize(
    ("normal", "gradient", "bounds", "distance"),
    [
        ([[1.0, 1.0], [1.0, 1.0]], [1.0, 1.0], OPEN, 1.0),  # one direction is unseen
        ([[4.0, 1.0], [1.0, 2.0]], [1.0, -0.5], OPEN, np.sqrt(4.0 / 7.0)),  # none, and no bound near
        # nor is one with less than 1e-14 of the largest eigenvalue; with more it is followed to the bounds: 2 (9 + 9)
        *(([[1.0, 1.0 - gap], [1.0 - gap, 1.0]], [1.0, -1.0], OPEN, d) for gap, d in ((1.9e-14, 0.0), (2.1e-14, 6.0))),
        (DIAGONAL, [1.0, -3.0], [[-9, 9], [-9, 0]], 0.5),  # pressed against the upper bound
        (DIAGONAL, [1.0, 3.0], [[-9, 9], [-9, 0]], np.sqrt(1.25)),
        (DIAGONAL, [1.0, 3.0], [[-9, 9], [0, 0]], 0.5),  # held
        (DIAGONAL, [1.0, 3.0], [[0, 0], [0, 0]], 0.0),
        (DIAGONAL, [np.inf, 3.0], OPEN, np.inf),
        # on its bound a parameter is held by a gradient outward or none, and leaves it by any inward
        ([[1.0, 0.5], [0.5, 1.0]], [0.0, 1.0], [[0, 9], [-9, 9]], 1.0),
        ([[1.0, 0.5], [0.5, 1.0]], [0.0, -1.0], [[-9, 0], [-9, 9]], 1.0),
        *(
            (DIAGONAL, [g, 3.0], [[-9 * (g > 0) * m, 9], [-9, 9]], d)
            for g, m, d in ((-0.5, 1, np.sqrt(1.0625)), (0.5, 0, 1.0))
        ),
        *((DIAGONAL, [g, 3.0], [[-9, 0], [-9, 9]], d) for g, d in ((0.5, np.sqrt(1.0625)), (-0.5, 1.0))),
        # beyond both lower, or both upper bounds: 2 (0.1 + 0.3) - (0.04 + 0.09)
        (DIAGONAL, [1.0, 3.0], [[-0.1, 9]] * 2, np.sqrt(0.67)),
        (DIAGONAL, [-1.0, -3.0], [[-9, 0.1]] * 2, np.sqrt(0.67)),
        # the optimum at (-1, 1) is outside; the corner (-0.5, 0.5) is the nearest to it
        ([[1.0, 0.9], [0.9, 1.0]], [0.1, -0.1], [[-0.5, 0.5]] * 2, np.sqrt(0.15)),
        ([[4.0, 0.0], [0.0, 0.0]], [1.0, 0.0], OPEN, 0.5),  # no information at all on the second
    ],
)
def test_distance_to_optimum_within_bounds(normal, gradient, bounds, distance):
    at = Point(np.zeros(2), 1.0, np.array(gradient), np.array(normal))
    assert distance_to_optimum(at, np.array(bounds, float)) == pytest.approx(distance)


def test_unseen_direction_has_infinite_variance():
    """And leaves no covariance with the rest."""
    inverse, is_regular = invert_information(np.array([[4.0, 4.0, 1.0], [4.0, 4.0, 1.0], [1.0, 1.0, 25.0]]))
    np.testing.assert_allclose(inverse, [[np.inf, 0, 0], [0, np.inf, 0], [0, 0, 1.0 / (25.0 - 0.25)]], atol=1e-9)
    assert not is_regular


@pytest.mark.parametrize(("share", "is_finite"), [(0.95e-6, True), (1.05e-6, False)])
def test_millionth_of_open_direction_counts(share, is_finite):
    """From so much of the open direction on a parameter is open."""
    open_way = np.array([np.sqrt(0.5), -np.sqrt(0.5), share / np.sqrt(2.0)])
    cov = invert_information(np.eye(3) - np.outer(open_way, open_way) / (open_way @ open_way))[0]
    assert np.isfinite(np.diag(cov)).tolist() == [False, False, is_finite]


WITHIN = replace(decay((1.0, 1.0)), bounds=np.tile([0.5, 4.0], (2, 1)))


def test_swarm_follows_clerc_kennedy():
    rng = np.random.default_rng(5)
    at = 0.5 + 3.5 * rng.random((6, 2))
    at[0] = 1.0
    speed = 0.1 * 3.5 * (2.0 * rng.random((6, 2)) - 1.0)
    own = at.copy()
    best = WITHIN.objective(at)
    for _ in range(12):
        pull = rng.random((2, 6, 2))
        leader = own[np.argmin(best)].copy()
        for p in range(6):
            for j in range(2):
                pulled = 1.49618 * (pull[0, p, j] * (own[p, j] - at[p, j]) + pull[1, p, j] * (leader[j] - at[p, j]))
                speed[p, j] = 0.7298 * speed[p, j] + pulled
                free = at[p, j] + speed[p, j]
                at[p, j] = min(max(free, 0.5), 4.0)
                speed[p, j] *= free == at[p, j]
        now = WITHIN.objective(at)
        own[now < best] = at[now < best]
        best = np.minimum(now, best)
    cloud: list = []
    recorded = replace(WITHIN, observe=lambda x, t, i: (cloud.append(t), WITHIN.observe(x, t, i))[1])
    result = ParticleSwarm(n_particles=6, n_iterations=12, seed=5).search(recorded)
    np.testing.assert_allclose(cloud[-1][:, :, 0].T, at, rtol=1e-9)
    np.testing.assert_allclose(result.best, own[np.argmin(best)], rtol=1e-9)
    assert (result.objective, result.n_evals) == (pytest.approx(best.min()), 78)


def test_swarm_has_clerc_kennedy_constants():
    swarm = ParticleSwarm()
    assert (swarm.inertia, swarm.cognitive, swarm.social, swarm.seed) == (0.7298, 1.49618, 1.49618, 0)


def test_unpolished_swarm_reports_its_search():
    estimate = ParticleSwarm(polish=False).estimate(WITHIN)
    assert estimate.n_evals == 30 * 101
    np.testing.assert_array_equal(estimate.belief.mean, ParticleSwarm().search(WITHIN).best)


def test_polish_converges_after_the_search():
    estimate = ParticleSwarm().estimate(WITHIN)
    assert estimate.n_evals > 30 * 101
    assert estimate.status == "converged"


def test_short_search_does_not_converge():
    assert ParticleSwarm(n_iterations=1, polish=False).estimate(WITHIN).status == "max_steps"


TANK = PhysicsModel(
    name="tank",
    inputs=(Signal("inflow", "-"),),
    outputs=(Signal("level", "-", sigma=0.2), Signal("twice", "-", sigma=0.4)),
    params=(
        Param("rate", "1/s", 0.5, (-0.1, 2.0), "health", drift=0.03),
        Param("gain", "-", 1.0, (0.1, 3.0), "design"),
    ),
    equations=lambda inflow, rate, gain, store: (gain * store, 2.0 * store),
    states=(State("store", "-", 1.5),),
    rates=lambda inflow, rate, gain, store: inflow - rate * store,
    solver="euler",
)


def tank(**more) -> Problem:
    inflow = np.array([0.2, 0.0, 0.4])
    return declared_problem(TANK, ["rate"], {"inflow": inflow}, {"level": np.array([1.4, 1.0, np.nan])}, **more)


def test_declared_state_steps_by_euler():
    x1 = 1.5 + 0.4 * (0.2 - 0.7 * 1.5)
    x2 = x1 + 0.4 * (0.0 - 0.7 * x1)
    np.testing.assert_allclose(tank(dt_s=0.4).simulate(np.array([0.7]))[:, 0], [1.5, x1, x2])


def test_half_steps_are_twice_as_fine():
    half = 1.5 + 0.2 * (0.2 - 0.7 * 1.5)
    fine = half + 0.2 * (0.2 - 0.7 * half)
    np.testing.assert_allclose(tank(dt_s=0.4).half_steps(np.array([1.5]), np.array([0.7]), 0), [fine])


@pytest.mark.parametrize(("more", "drift"), [({"flights_per_sample": 4.0}, 0.06), ({}, 0.0)])
def test_drift_grows_with_root_of_flights(more, drift):
    np.testing.assert_allclose(tank(**more).drift, [drift])


def test_declared_problem_takes_nominal_values():
    problem = tank()
    assert (problem.sigma.tolist(), problem.prior.mean.tolist(), problem.names) == ([0.2], [0.5], ("rate",))
    assert np.isinf(problem.prior.cov).all()
    assert (problem.start.mean.tolist(), problem.start.cov.tolist()) == ([1.5], [[0.0]])


def test_samples_are_a_second_apart():
    np.testing.assert_allclose(tank().transition(np.array([1.5]), np.array([0.7]), 0), [1.5 + 0.2 - 0.7 * 1.5])


def test_outputs_are_matched_by_name():
    measured = {"twice": np.ones(2), "level": np.zeros(2)}
    both = declared_problem(TANK, ["rate", "gain"], {"inflow": np.zeros(2)}, measured)
    np.testing.assert_allclose(both.simulate(np.array([0.5, 0.9]))[0], [1.35, 3.0])
    np.testing.assert_allclose((both.measured[0], both.sigma), ([0.0, 1.0], [0.2, 0.4]))


@pytest.fixture(scope="module")
def tank_estimate():
    return NonlinearLeastSquares().estimate(tank(dt_s=0.4))


def test_step_error_is_its_propagated_change(tank_estimate):
    """The change of the outputs by half the step, through least squares."""
    rate = tank_estimate.belief.mean[0]
    coarse = 1.0 - 0.4 * rate
    fine = 1.0 - 0.2 * rate
    outputs = np.array([1.5 * coarse + 0.08]), np.array([(1.5 * fine + 0.04) * fine + 0.04])
    change = (outputs[1] - outputs[0]) / 0.2
    slope = -0.4 * 1.5 / 0.2
    expected = -change / slope * abs(slope)
    np.testing.assert_allclose(tank_estimate.step_error, expected / (tank_estimate.belief.sd * abs(slope)), rtol=1e-5)


def test_summary_states_step_error(tank_estimate):
    lines = tank_estimate.summary().splitlines()
    error = f"    error of the step    = {abs(tank_estimate.step_error[0]):.2g} standard deviations"
    assert lines.index(error) == lines.index("[[Parameters]]") - 1


@pytest.mark.parametrize(
    "change", [{"problem": replace(tank(dt_s=0.4), half_steps=None)}, {"problem": None}, {"status": "diverged"}]
)
def test_step_error_needs_an_answer(tank_estimate, change):
    assert replace(tank_estimate, **change).step_error is None


def test_fit_needs_its_problem(tank_estimate):
    with pytest.raises(ValueError, match="without its problem"):
        _ = replace(tank_estimate, problem=None).fit


def test_diverged_fit_has_no_slope(tank_estimate):
    assert not replace(tank_estimate, status="diverged").fit.slope.any()
