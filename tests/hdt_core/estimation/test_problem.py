"""The question itself: beliefs, missing values, one flight after another; a batch answers as each problem alone."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import Belief, ExtendedKalman, NonlinearLeastSquares, Problem, unknown
from hdt_core.estimation.batch import Batch
from hdt_core.estimation.descent import gauss_newton
from hdt_core.estimation.estimate import estimate_each
from hdt_estimators import ParticleFilter

SLOPE = np.random.default_rng(5).uniform(0.5, 2.0, 40)


def line(measured=None, prior=None, **more):
    truth = 1.2 * SLOPE + 0.4
    noise = 0.1 * np.random.default_rng(6).standard_normal(40)
    return Problem(
        names=("gain", "offset"),
        bounds=np.tile([-50.0, 50.0], (2, 1)),
        prior=unknown(np.zeros(2)) if prior is None else prior,
        measured=(truth + noise)[:, None] if measured is None else measured,
        sigma=np.array([0.1]),
        observe=lambda _x, theta, i: (theta[0] * SLOPE[i] + theta[1])[None],
        **more,
    )


SWARM = np.random.default_rng(0).normal(size=(4, 2))


def test_swarm_simulates_as_single_points():
    many = line().simulate(SWARM)
    assert many.shape == (4, 40, 1)
    np.testing.assert_array_equal(many, [line().simulate(row) for row in SWARM])


def test_swarm_sums_squares_as_single_points():
    np.testing.assert_allclose(line().chi2(SWARM), [np.sum(line().residual(row) ** 2) for row in SWARM])


def test_half_record_is_others_prior():
    whole = line()
    halves = np.tile(whole.measured, (2, 1, 1))
    halves[0, 20:] = halves[1, :20] = np.nan
    estimator = NonlinearLeastSquares()
    first = estimator.estimate(replace(whole, measured=halves[0]))
    second = estimator.estimate(replace(whole, measured=halves[1]).with_prior(first.belief))
    together = estimator.estimate(whole)
    np.testing.assert_allclose(second.belief.mean, together.belief.mean, atol=1e-9)
    np.testing.assert_allclose(second.belief.cov, together.belief.cov, atol=1e-9)


def walk(seed):
    """A level that walks, told by noisy values: drift of the parameter, no states."""
    rng = np.random.default_rng(seed)
    level = 1.0 + np.cumsum(0.05 * rng.standard_normal(200))
    problem = Problem(
        names=("level",),
        bounds=np.array([[-20.0, 20.0]]),
        prior=Belief(np.array([1.0]), np.array([[0.25]])),
        measured=(level + 0.2 * rng.standard_normal(200))[:, None],
        sigma=np.array([0.2]),
        observe=lambda _x, theta, i: theta[:1] + 0.0 * np.asarray(i),
        drift=np.array([0.05]),
    )
    return level, problem


@pytest.mark.parametrize("estimator", [ExtendedKalman(), ParticleFilter(n_particles=1500)], ids=lambda e: e.name)
def test_filter_follows_drifting_parameter(estimator):
    level, problem = walk(3)
    estimate = estimator.estimate(problem)
    rms = np.sqrt(np.mean((estimate.path[20:, 0] - level[20:]) ** 2))
    # steady state of the random walk: variance P with P^2 / (P + R) = Q, after the sample P R / (P + R)
    q = 0.05**2
    r = 0.2**2
    before = 0.5 * (q + np.sqrt(q * q + 4.0 * q * r))
    after = np.sqrt(before * r / (before + r))
    assert rms < 1.4 * after
    assert estimate.path_sd[-1, 0] == pytest.approx(after, rel=0.02 if estimator.name == "ekf" else 0.25)


@pytest.mark.parametrize(
    "estimator", [ParticleFilter(n_particles=2000), ExtendedKalman(smoother_passes=0)], ids=lambda e: e.name
)
def test_recovers_pole_under_process_noise(estimator):
    rng = np.random.default_rng(9)
    x = 0.0
    measured = []
    for _ in range(150):
        measured.append(x + 0.3 * rng.standard_normal())
        x = 0.8 * x + 0.5 * rng.standard_normal()
    problem = Problem(
        names=("pole",),
        bounds=np.array([[0.0, 0.99]]),
        prior=Belief(np.array([0.5]), np.array([[0.09]])),
        measured=np.array(measured)[:, None],
        sigma=np.array([0.3]),
        observe=lambda x, _theta, _i: x,
        transition=lambda x, theta, _i: theta[0] * x,
        start=Belief(np.zeros(1), np.array([[0.01]])),
        process_sd=np.array([0.5]),
    )
    estimate = estimator.estimate(problem)
    assert abs(estimate.belief.mean[0] - 0.8) < 4.0 * estimate.belief.sd[0]
    assert estimate.belief.sd[0] < 0.15


TIME = np.tile(np.linspace(0.0, 3.0, 12), 7)
GROUP = np.repeat(np.arange(7), 12)
NOISE = 0.02 * np.random.default_rng(3).standard_normal((84, 1))


def decays(**more) -> Batch:
    """Seven decays: two plain; a value missing; a misfit; none at all; a rate at its bound; hardly a decay."""
    level = np.repeat([2.0, 1.0, 1.5, 1.0, 0.0, 3.0, 1.0], 12)
    rate = np.repeat([1.0, 2.0, 0.7, 1.0, 0.0, 9.0, 0.01], 12)
    measured = (level * np.exp(-rate * TIME))[:, None] + NOISE
    measured[25] = np.nan
    measured[36:48, 0] += 0.5 * np.cos(9.0 * TIME[36:48])
    fields = {"names": ("level", "rate"), "bounds": np.array([[-9.0, 9.0], [-0.5, 5.0]]),
              "prior": unknown(np.array([1.0, 1.0])), "measured": measured, "sigma": np.array([0.02]), "group": GROUP,
              "observe": lambda _x, theta, i: (theta[0] * np.exp(-theta[1] * TIME[i]))[None]}  # fmt: skip
    return Batch(**(fields | more))


@pytest.mark.parametrize(
    ("more", "open_ones"),
    [
        ({}, [4, 5]),
        ({"prior": Belief(np.ones(2), np.diag([0.04, np.inf]))}, [4, 5]),
        ({"bounds": np.array([[-9.0, 9.0], [1.0, 1.0]])}, []),
    ],
)
def test_batch_equals_single_problems(more, open_ones):
    batch = decays(**more)
    together = estimate_each(NonlinearLeastSquares(), batch)
    assert (batch.n_problems, len(together)) == (7, 7)
    for b, estimate in enumerate(together):
        rows = b == GROUP
        alone = replace(
            batch.single(b), measured=batch.measured[rows],
            observe=lambda _x, theta, i, t=TIME[rows]: (theta[0] * np.exp(-theta[1] * t[i]))[None],
        )  # fmt: skip
        single = NonlinearLeastSquares().estimate(alone)
        assert (estimate.status, estimate.n_evals, estimate.weak) == (single.status, single.n_evals, single.weak)
        np.testing.assert_allclose(estimate.belief.mean, single.belief.mean, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(estimate.belief.sd, single.belief.sd, rtol=1e-6)
        np.testing.assert_allclose(estimate.fit.residuals, single.fit.residuals, atol=1e-6)
        assert (estimate.better is None) == (single.better is None)
    assert [b for b, e in enumerate(together) if e.status == "weakly_identifiable"] == open_ones


def test_failed_model_diverges_alone():
    batch = decays(
        observe=lambda _x, theta, i: np.where(GROUP[i] == 2, np.nan, theta[0] * np.exp(-theta[1] * TIME[i]))[None]
    )
    statuses = [e.status for e in estimate_each(NonlinearLeastSquares(), batch)]
    assert [b for b, status in enumerate(statuses) if status == "diverged"] == [2]
    assert statuses[:2] == ["converged"] * 2


@pytest.mark.parametrize(
    ("change", "message"),
    [({"transition": lambda x, _t, _i: x}, "without states"), ({"group": GROUP[:-1]}, "every sample")],
)
def test_contradictory_batch_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        decays(**change)


def test_sequence_starts_from_last_converged():
    """Of a method that takes no batch."""
    starts: list = []

    class Recorder:
        name = "x"

        def estimate(self, problem: Problem):
            starts.append(problem.origin.tolist())
            return ExtendedKalman().estimate(problem)

    estimates = estimate_each(Recorder(), decays(prior=Belief(np.ones(2), np.diag([np.inf, 0.25]))))
    previous = [1.0, 1.0]
    for start, estimate in zip(starts, estimates, strict=True):
        assert start == pytest.approx(previous)
        if estimate.status == "converged":
            previous = [estimate.belief.mean[0], 1.0]  # a prior stays what it is
    assert starts[1] != starts[0]


@pytest.mark.parametrize(("number", "centre"), [(0, 0.1), (1, 5.0)])
def test_reweighted_steps_are_hubers_location(number, centre):
    """Of each group: the weighted mean, whose weights fall beyond 1.345 deviations from the last centre."""
    y = np.array([0.0, 0.1, -0.2, 0.3, 9.0, 5.0, 5.1, 4.8, -3.0, 5.2])
    group = np.repeat([0, 1], 5)
    sd = 0.3
    batch = Batch(("centre",), np.array([[-99.0, 99.0]]), unknown(np.zeros(1)), y[:, None], np.array([sd]),
                    lambda _x, theta, i: (theta[0] + 0.0 * i)[None], group=group)  # fmt: skip
    weights = lambda residual: 1.0 / np.maximum(1.0, np.abs(residual) / 1.345)  # noqa: E731
    theta, cov = gauss_newton(batch, np.array([[0.1], [5.0]]), 3, weights)
    own = y[group == number]
    for _ in range(3):
        weight = 1.0 / np.maximum(1.0, np.abs(own - centre) / (1.345 * sd))
        centre = (weight * own).sum() / weight.sum()
    np.testing.assert_allclose(theta[number, 0], centre, rtol=1e-9)
    np.testing.assert_allclose(cov[number, 0, 0], sd**2 / weight.sum(), rtol=1e-6)
