"""A declared model with a state: its steps, and the error of the step, against sums written out."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import NonlinearLeastSquares, Problem
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.model import Param, PhysicsModel, Signal, State

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


def test_a_declared_state_is_stepped_and_stepped_twice_as_finely():
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
    both = declared_problem(
        TANK, ["rate", "gain"], {"inflow": np.zeros(2)}, {"twice": np.ones(2), "level": np.zeros(2)}
    )
    np.testing.assert_allclose(both.simulate(np.array([0.5, 0.9]))[0], [1.35, 3.0])
    np.testing.assert_allclose((both.measured[0], both.sigma), ([0.0, 1.0], [0.2, 0.4]))


def test_the_error_of_the_step_is_its_change_through_least_squares():
    problem = tank(dt_s=0.4)
    estimate = NonlinearLeastSquares().estimate(problem)
    rate = estimate.belief.mean[0]
    coarse, fine = (1.0 - 0.4 * rate), (1.0 - 0.2 * rate)
    outputs = np.array([1.5 * coarse + 0.08]), np.array([(1.5 * fine + 0.04) * fine + 0.04])
    change, slope = (outputs[1] - outputs[0]) / 0.2, -0.4 * 1.5 / 0.2
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
