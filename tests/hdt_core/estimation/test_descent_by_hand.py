"""Steps, descents and swarms against plain linear algebra and one-line models."""

from dataclasses import replace

import numpy as np
import pytest

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
from hdt_core.estimation.fit import Identifiability, invert_information
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


def test_last_step_gains_next_to_nothing():
    """A hundred-millionth of the residuals' variance, 1e-22 without noise; a trillionth of the objective if unpaid."""
    for sign in (1.0, -1.0):
        assert [is_settled(sign * share * 1e-8 * 500.0 / 50, 500.0, 50) for share in (0.99, 1.01)] == [True, False]
        assert [is_settled(sign * share * 1e-22, 0.0, 50) for share in (0.99, 1.01)] == [True, False]
        assert [is_exhausted(sign * share * 1e-12 * 500.0, 0.0, 500.0) for share in (0.99, 1.01)] == [True, False]
    assert not is_exhausted(0.0, 1e-9, 500.0)
    # Bounds, else four deviations of the prior, else ten times the start or ten.
    np.testing.assert_allclose(BOX.search_box, [[-1.0, -7.0, -36.0, 2.0], [3.0, 9.0, 5.0, 2.0]])
    origin = replace(BOX, prior=unknown(np.array([0.0, 0.5, 0.0, 0.0])))
    np.testing.assert_allclose(origin.search_box[1], [3.0, 10.5, 5.0, 2.0])


def test_optimum_equals_linear_algebra():
    inverse, determinant = inverse_spd(NORMAL)
    np.testing.assert_allclose(inverse, np.linalg.inv(NORMAL), rtol=1e-12)
    assert determinant == pytest.approx(np.linalg.det(NORMAL) / (4.0 * 9.0 * 3.0))
    for singular in ([[1.0, 0.0], [0.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]]):
        assert inverse_spd(np.array(singular))[1] == 0.0
    gradient = np.array([0.3, -0.2, 0.1])
    sd = np.sqrt(np.diag(np.linalg.inv(NORMAL)))
    for share, off in ((0.9, False), (1.1, True)):
        for side in (0, 1):
            bounds = np.tile([-9.0, 9.0], (3, 1))
            bounds[1, side] = (2 * side - 1) * share * 1e-3 * sd[1]
            optimum = assess_optimum(NORMAL, gradient, np.zeros(3), bounds)
            np.testing.assert_allclose(optimum[0], inverse)
            assert optimum[1:] == pytest.approx((determinant, np.sqrt(gradient @ inverse @ gradient), off))


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
    one = Problem(("x",), np.array([[-9e9, 9e9]]), unknown(np.zeros(1)), np.zeros((1, 1)), np.ones(1),
                  lambda _x, t, i: (t[0] + 0.0 * i)[None])  # fmt: skip
    point = descend(one, np.array([1000.0]))
    assert (point.theta.tolist(), point.n_evals) == ([800.0], 3 + 200 * 4)
    point = descend(decay((1.0, -1000.0)), np.array([1.0, -1000.0]), n_evals=3)
    assert (point.objective, point.n_evals, point.theta.tolist()) == (np.inf, 3 + 5, [1.0, -1000.0])
    assert conclude_at(decay((1.0, -1000.0)), point).status == "diverged"
    assert (NonlinearLeastSquares().max_steps, NonlinearLeastSquares().name) == (200, "nls")


@pytest.mark.parametrize(
    ("normal", "gradient", "theta", "bounds", "distance"),
    [
        ([[1.0, 1.0], [1.0, 1.0]], [1.0, 1.0], [0, 0], [[-9, 9]] * 2, 1.0),  # one direction is unseen
        ([[4.0, 1.0], [1.0, 2.0]], [1.0, -0.5], [0, 0], [[-9, 9]] * 2, np.sqrt(4.0 / 7.0)),  # none, and no bound near
        # nor is one with less than 1e-14 of the largest eigenvalue; with more it is followed to the bounds: 2 (9 + 9)
        *(
            ([[1.0, 1.0 - gap], [1.0 - gap, 1.0]], [1.0, -1.0], [0, 0], [[-9, 9]] * 2, d)
            for gap, d in ((1.9e-14, 0.0), (2.1e-14, 6.0))
        ),
        ([[4.0, 0.0], [0.0, 9.0]], [1.0, -3.0], [0, 0], [[-9, 9], [-9, 0]], 0.5),  # pressed against the upper bound
        ([[4.0, 0.0], [0.0, 9.0]], [1.0, 3.0], [0, 0], [[-9, 9], [-9, 0]], np.sqrt(1.25)),
        ([[4.0, 0.0], [0.0, 9.0]], [1.0, 3.0], [0, 0], [[-9, 9], [0, 0]], 0.5),  # held
        ([[4.0, 0.0], [0.0, 9.0]], [1.0, 3.0], [0, 0], [[0, 0], [0, 0]], 0.0),
        ([[4.0, 0.0], [0.0, 9.0]], [np.inf, 3.0], [0, 0], [[-9, 9]] * 2, np.inf),
        # on its bound a parameter is held by a gradient outward or none, and leaves it by any inward
        ([[1.0, 0.5], [0.5, 1.0]], [0.0, 1.0], [0, 0], [[0, 9], [-9, 9]], 1.0),
        ([[1.0, 0.5], [0.5, 1.0]], [0.0, -1.0], [0, 0], [[-9, 0], [-9, 9]], 1.0),
        *(
            ([[4.0, 0.0], [0.0, 9.0]], [g, 3.0], [0, 0], [[-9 * (g > 0) * m, 9], [-9, 9]], d)
            for g, m, d in ((-0.5, 1, np.sqrt(1.0625)), (0.5, 0, 1.0))
        ),
        *(
            ([[4.0, 0.0], [0.0, 9.0]], [g, 3.0], [0, 0], [[-9, 0], [-9, 9]], d)
            for g, d in ((0.5, np.sqrt(1.0625)), (-0.5, 1.0))
        ),
        # beyond both lower, or both upper bounds: 2 (0.1 + 0.3) - (0.04 + 0.09)
        ([[4.0, 0.0], [0.0, 9.0]], [1.0, 3.0], [0, 0], [[-0.1, 9]] * 2, np.sqrt(0.67)),
        ([[4.0, 0.0], [0.0, 9.0]], [-1.0, -3.0], [0, 0], [[-9, 0.1]] * 2, np.sqrt(0.67)),
        # the optimum at (-1, 1) is outside; the corner (-0.5, 0.5) is the nearest to it
        ([[1.0, 0.9], [0.9, 1.0]], [0.1, -0.1], [0, 0], [[-0.5, 0.5]] * 2, np.sqrt(0.15)),
        ([[4.0, 0.0], [0.0, 0.0]], [1.0, 0.0], [0, 0], [[-9, 9]] * 2, 0.5),  # no information at all on the second
    ],
)
def test_distance_to_optimum_within_bounds(normal, gradient, theta, bounds, distance):
    at = Point(np.array(theta, float), 1.0, np.array(gradient), np.array(normal))
    assert distance_to_optimum(at, np.array(bounds, float)) == pytest.approx(distance)


def test_unseen_direction_has_infinite_variance():
    inverse, is_regular = invert_information(np.array([[4.0, 4.0, 1.0], [4.0, 4.0, 1.0], [1.0, 1.0, 25.0]]))
    np.testing.assert_allclose(inverse, [[np.inf, 0, 0], [0, np.inf, 0], [0, 0, 1.0 / (25.0 - 0.25)]], atol=1e-9)
    assert not is_regular
    for share, finite in ((0.95e-6, True), (1.05e-6, False)):  # of the open direction, from which it opens a parameter
        open_way = np.array([np.sqrt(0.5), -np.sqrt(0.5), share / np.sqrt(2.0)])
        cov = invert_information(np.eye(3) - np.outer(open_way, open_way) / (open_way @ open_way))[0]
        assert np.isfinite(np.diag(cov)).tolist() == [False, False, finite]
    for gap, is_identifiable in (
        (2.1e-14, True),
        (1.9e-14, False),
    ):  # a condition (2 - gap) / gap of 1e14 is as good as a zero
        pair = np.array([[1.0, 1.0 - gap], [1.0 - gap, 1.0]])
        assert invert_information(pair)[1] == is_identifiable
        assert Identifiability(("a", "b"), pair).identifiable == is_identifiable


BOX = Problem(("a", "b", "c", "d"), np.array([[-1.0, 3.0], [-np.inf, np.inf], [-np.inf, 5.0], [2.0, 2.0]]),
              Belief(np.array([0.0, 1.0, 4.0, 0.0]), np.diag([1.0, 4.0, np.inf, np.inf])), np.zeros((1, 1)), np.ones(1),
              lambda _x, theta, i: (theta[0] ** 2 + theta[1] * theta[2] + 0.0 * i)[None])  # fmt: skip


def test_swarm_follows_clerc_kennedy():
    problem = replace(decay((1.0, 1.0)), bounds=np.tile([0.5, 4.0], (2, 1)))
    rng = np.random.default_rng(5)
    lower = 0.5
    width = 3.5
    at = lower + width * rng.random((6, 2))
    at[0] = 1.0
    speed = 0.1 * width * (2.0 * rng.random((6, 2)) - 1.0)
    own = at.copy()
    best = problem.objective(at)
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
        now = problem.objective(at)
        own[now < best] = at[now < best]
        best = np.minimum(now, best)
    cloud: list = []
    recorded = replace(problem, observe=lambda x, t, i: (cloud.append(t), problem.observe(x, t, i))[1])
    flown = ParticleSwarm(n_particles=6, n_iterations=12, seed=5).search(recorded)
    np.testing.assert_allclose(cloud[-1][:, :, 0].T, at, rtol=1e-9)
    np.testing.assert_allclose(flown.best, own[np.argmin(best)], rtol=1e-9)
    assert (flown.objective, flown.n_evals) == (pytest.approx(best.min()), 78)
    plain = ParticleSwarm(polish=False)
    assert plain.estimate(problem).n_evals == 30 * 101
    assert (plain.inertia, plain.cognitive, plain.social, plain.seed) == (0.7298, 1.49618, 1.49618, 0)
    flown = ParticleSwarm().search(problem)
    np.testing.assert_array_equal(plain.estimate(problem).belief.mean, flown.best)
    assert ParticleSwarm().estimate(problem).n_evals > 30 * 101
    assert ParticleSwarm().estimate(problem).status == "converged"
    assert ParticleSwarm(n_iterations=1, polish=False).estimate(problem).status == "max_steps"


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
    problem = tank(dt_s=0.4, flights_per_sample=4.0)
    x1 = 1.5 + 0.4 * (0.2 - 0.7 * 1.5)
    x2 = x1 + 0.4 * (0.0 - 0.7 * x1)
    np.testing.assert_allclose(problem.simulate(np.array([0.7]))[:, 0], [1.5, x1, x2])
    half = 1.5 + 0.2 * (0.2 - 0.7 * 1.5)
    fine = half + 0.2 * (0.2 - 0.7 * half)
    np.testing.assert_allclose(problem.half_steps(np.array([1.5]), np.array([0.7]), 0), [fine])
    np.testing.assert_allclose(problem.drift, [0.06])
    assert (problem.sigma.tolist(), problem.prior.mean.tolist(), problem.names) == ([0.2], [0.5], ("rate",))
    assert np.isinf(problem.prior.cov).all()
    assert (problem.start.mean.tolist(), problem.start.cov.tolist()) == ([1.5], [[0.0]])
    plain = tank()
    assert plain.drift.tolist() == [0.0]
    np.testing.assert_allclose(plain.transition(np.array([1.5]), np.array([0.7]), 0), [1.5 + 0.2 - 0.7 * 1.5])
    # both outputs, the second before the first is no matter: by name
    measured = {"twice": np.ones(2), "level": np.zeros(2)}
    both = declared_problem(TANK, ["rate", "gain"], {"inflow": np.zeros(2)}, measured)
    np.testing.assert_allclose(both.simulate(np.array([0.5, 0.9]))[0], [1.35, 3.0])
    np.testing.assert_allclose((both.measured[0], both.sigma), ([0.0, 1.0], [0.2, 0.4]))


def test_step_error_is_its_propagated_change():
    problem = tank(dt_s=0.4)
    estimate = NonlinearLeastSquares().estimate(problem)
    rate = estimate.belief.mean[0]
    coarse = 1.0 - 0.4 * rate
    fine = 1.0 - 0.2 * rate
    outputs = np.array([1.5 * coarse + 0.08]), np.array([(1.5 * fine + 0.04) * fine + 0.04])
    change = (outputs[1] - outputs[0]) / 0.2
    slope = -0.4 * 1.5 / 0.2
    expected = -change / slope * abs(slope)
    np.testing.assert_allclose(estimate.step_error, expected / (estimate.belief.sd * abs(slope)), rtol=1e-5)
    lines = estimate.summary().splitlines()
    error = f"    error of the step    = {abs(estimate.step_error[0]):.2g} standard deviations"
    assert lines.index(error) == lines.index("[[Parameters]]") - 1
    assert replace(estimate, problem=replace(problem, half_steps=None)).step_error is None
    assert replace(estimate, problem=None).step_error is None
    assert replace(estimate, status="diverged").step_error is None
    with pytest.raises(ValueError, match="without its problem"):
        _ = replace(estimate, problem=None).fit
    diverged = replace(estimate, status="diverged").fit
    assert not diverged.slope.any()
