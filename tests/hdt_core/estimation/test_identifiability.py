"""What data can tell, on the compressor of equations (2)-(4), whose answer is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import Belief, NonlinearLeastSquares, Problem, estimators, unknown
from hdt_core.estimation.experiment import Candidate, profile, rank_sensors
from hdt_core.estimation.identifiability import Identifiability, fisher, invert_information

SPEED_RAD_S = np.linspace(2000.0, 3800.0, 40)
DENSITY_KG_M3 = np.linspace(0.4, 0.6, 40)
AREA_M2, DIAMETER_M, BETA_RAD = 0.0098, 0.11, np.deg2rad(36.0)


def flow_kg_s(theta, i):
    """Equations (2)-(4): density, inlet area and axial velocity."""
    return DENSITY_KG_M3[i] * theta[0] * 0.5 * theta[1] * SPEED_RAD_S[i] * np.tan(theta[2])


def compressor(prior=None):
    truth = np.array([AREA_M2, DIAMETER_M, BETA_RAD])
    flow = flow_kg_s(truth, np.arange(40))
    return Problem(
        names=("area_m2", "diameter_m", "beta_rad"),
        bounds=np.array([[0.005, 0.02], [0.05, 0.2], [0.2, 1.0]]),
        prior=unknown(np.array([0.012, 0.126, 0.47])) if prior is None else prior,
        measured=(flow + 0.02 * np.random.default_rng(1).standard_normal(40) * flow)[:, None],
        sigma=np.array([0.02 * flow.mean()]),
        observe=lambda _x, theta, i: flow_kg_s(theta, i)[None],
    )


def test_only_the_product_is_identifiable():
    problem = compressor()
    seen = fisher(problem, np.array([AREA_M2, DIAMETER_M, BETA_RAD]))
    assert not seen.identifiable
    assert np.linalg.matrix_rank(seen.scaled, tol=1e-6) == 1
    assert np.isinf(seen.bound_sd).all()
    estimate = NonlinearLeastSquares().estimate(problem)
    assert estimate.status == "not_identifiable"
    product = estimate.belief.mean[0] * estimate.belief.mean[1] * np.tan(estimate.belief.mean[2])
    assert product == pytest.approx(AREA_M2 * DIAMETER_M * np.tan(BETA_RAD), rel=0.02)


def test_a_prior_that_closes_the_open_directions_makes_it_an_estimate():
    sd = np.array([0.001, 0.01, np.deg2rad(2.0)])
    estimate = NonlinearLeastSquares().estimate(compressor(Belief(np.array([0.0098, 0.11, 0.63]), np.diag(sd**2))))
    assert estimate.status == "converged"
    assert not estimate.identifiability.identifiable  # what the data alone say does not change
    assert (estimate.belief.sd < sd).all()


def test_profile_is_flat_along_what_cannot_be_told():
    problem = compressor()
    best = problem.objective(NonlinearLeastSquares().estimate(problem).belief.mean[None])[0]
    flat = profile(problem, NonlinearLeastSquares(), "area_m2", np.array([0.008, 0.01, 0.012]))
    np.testing.assert_allclose(flat, best, atol=1e-4)


def test_profile_of_a_told_parameter_is_its_likelihood():
    slope = np.linspace(0.5, 2.0, 30)
    problem = Problem(
        names=("gain", "offset"),
        bounds=np.tile([-100.0, 100.0], (2, 1)),
        prior=unknown(np.zeros(2)),
        measured=(2.0 * slope + 1.0 + 0.1 * np.random.default_rng(0).standard_normal(30))[:, None],
        sigma=np.array([0.1]),
        observe=lambda _x, theta, i: (theta[0] * slope[i] + theta[1])[None],
    )
    estimate = NonlinearLeastSquares().estimate(problem)
    gain, sd = estimate.belief.mean[0], estimate.belief.sd[0]
    best = problem.objective(estimate.belief.mean[None])[0]
    steps = np.array([-2.0, -1.0, 1.0, 2.0])
    rise = profile(problem, NonlinearLeastSquares(), "gain", gain + steps * sd) - best
    np.testing.assert_allclose(rise, steps**2, rtol=1e-6)


def test_the_sensor_that_breaks_the_tie_is_ranked_first():
    problem = compressor()
    at = np.array([AREA_M2, DIAMETER_M, BETA_RAD])
    candidates = [
        Candidate("a second flow meter", 0.005, lambda _x, theta, i: flow_kg_s(theta, i)[None]),
        Candidate("inlet velocity", 1.0, lambda _x, t, i: (0.5 * t[1] * SPEED_RAD_S[i] * np.tan(t[2]))[None]),
    ]
    gains = rank_sensors(problem, at, candidates)
    assert [g.name for g in gains] == ["inlet velocity", "a second flow meter"]
    assert gains[0].nats > gains[1].nats > 0.0
    # velocity gives the area: to the flow's and its own relative error, over forty samples
    assert gains[0].sd[0] / AREA_M2 < 0.01
    assert gains[1].sd[0] / AREA_M2 > 0.1


def test_information_adds_over_samples():
    problem = compressor()
    at = np.array([AREA_M2, DIAMETER_M, BETA_RAD])
    parts = []
    for half in (slice(0, 20), slice(20, 40)):
        measured = np.full((40, 1), np.nan)
        measured[half] = problem.measured[half]
        parts.append(fisher(replace(problem, measured=measured), at).information)
    np.testing.assert_allclose(parts[0] + parts[1], fisher(problem, at).information, rtol=1e-9)


@pytest.mark.parametrize("estimator", estimators().values(), ids=lambda e: e.name)
def test_every_estimator_reports_the_unidentifiable_product(estimator):
    if estimator.name == "particle":
        estimator = replace(estimator, n_particles=100)
    assert estimator.estimate(compressor()).status == "not_identifiable"


@pytest.mark.parametrize(("gap", "is_observable"), [(2.1e-14, True), (1.9e-14, False)])
def test_direction_is_observable_up_to_a_condition_of_1e14(gap, is_observable):
    # eigenvalues of [[1, c], [c, 1]] are 1 + c and 1 - c: a condition of 2 / gap
    information = np.array([[1.0, 1.0 - gap], [1.0 - gap, 1.0]])
    cov, observable = invert_information(information)
    assert observable is is_observable
    assert np.isfinite(cov).all() == is_observable
    assert Identifiability(("a", "b"), information).identifiable is is_observable
