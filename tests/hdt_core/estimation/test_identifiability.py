"""What data can tell, on the compressor of equations (2)-(4), whose answer is known in closed form."""

import numpy as np
import pytest
from compressor_problem import AREA_M2, BETA_RAD, DIAMETER_M, compressor

from hdt_core.estimation import Belief, NonlinearLeastSquares
from hdt_core.estimation.identifiability import Identifiability, fisher, invert_information


def test_only_the_product_is_identifiable():
    problem = compressor()
    information = fisher(problem, np.array([AREA_M2, DIAMETER_M, BETA_RAD]))
    assert not information.identifiable
    assert np.linalg.matrix_rank(information.scaled_information, tol=1e-6) == 1
    assert np.isinf(information.bound_sd).all()
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


@pytest.mark.parametrize(("gap", "is_observable"), [(2.1e-14, True), (1.9e-14, False)])
def test_direction_is_observable_up_to_a_condition_of_1e14(gap, is_observable):
    # eigenvalues of [[1, c], [c, 1]] are 1 + c and 1 - c: a condition of 2 / gap
    information = np.array([[1.0, 1.0 - gap], [1.0 - gap, 1.0]])
    cov, observable = invert_information(information)
    assert observable is is_observable
    assert np.isfinite(cov).all() == is_observable
    assert Identifiability(("a", "b"), information).identifiable is is_observable
