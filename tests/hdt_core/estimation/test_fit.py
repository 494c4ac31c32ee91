"""What an estimate says of its fit: numbers that SciPy has too, and verdicts on records whose fault is known."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares, Problem, unknown

X = np.linspace(0.0, 4.0, 80)


def line(noise=1.0, bend=0.0, seed=1, sigma=0.1):
    measured = 2.0 * X + 1.0 + bend * np.sin(3.0 * X) + noise * sigma * np.random.default_rng(seed).standard_normal(80)
    return Problem(
        names=("slope", "offset"),
        bounds=np.tile([-100.0, 100.0], (2, 1)),
        prior=unknown(np.zeros(2)),
        measured=measured[:, None],
        sigma=np.array([sigma]),
        observe=lambda _x, theta, i: (theta[0] * X[i] + theta[1])[None],
    )


def test_a_sigma_that_fits_leaves_the_bound_of_cramer_and_rao():
    sound = NonlinearLeastSquares().estimate(line())
    np.testing.assert_allclose(sound.belief.sd, sound.identifiability.bound_sd, rtol=1e-9)


def test_beside_a_held_parameter_the_interval_follows_the_record_too():
    """Sigma declared three times too small; the deviation is that of the residuals over the root of the sum of squares.

    Nine of ten intervals hold the truth: 200 records, three times 0.021.
    """
    bounds = np.array([[-100.0, 100.0], [1.0, 1.0]])
    estimates = [NonlinearLeastSquares().estimate(replace(line(3.0, seed=k), bounds=bounds)) for k in range(200)]
    slope, sd = np.array([(e.belief.mean[0], e.belief.sd[0]) for e in estimates]).T
    scatter = [np.linalg.norm(e.fit.residuals) * 0.1 / np.sqrt(79) for e in estimates]
    np.testing.assert_allclose(sd, scatter / np.linalg.norm(X), rtol=1e-6)
    assert {e.belief.sd[1] for e in estimates} == {0.0}
    assert np.mean(np.abs(slope - 2.0) < 1.645 * sd) == pytest.approx(0.9, abs=0.065)


def test_false_alarms_are_as_rare_as_declared():
    verdicts = [NonlinearLeastSquares().estimate(line(seed=seed)).fit.verdict for seed in range(400)]
    assert verdicts.count("adequate") >= 396  # 400 records, 2 in 1,000 each


def test_the_summary_holds_what_lmfit_prints():
    estimate = NonlinearLeastSquares().estimate(line())
    text = estimate.summary()
    for word in ("nls", "converged", "chi-square", "reduced chi-square", "Akaike", "Bayesian", "model evaluations"):
        assert word in text
    assert "slope" in text
    assert "(init 0)" in text
    assert "C(slope, offset) = -0.86" in text  # of the design alone: -mean(x) / rms(x)


def test_an_estimate_travels_with_its_residuals():
    estimate = NonlinearLeastSquares().estimate(line())
    there = pickle.loads(pickle.dumps(estimate))
    np.testing.assert_array_equal(there.fit.residuals, estimate.fit.residuals)
    assert "chi-square" in there.summary()


def test_residuals_of_a_filter_that_follows_are_its_innovations():
    rng = np.random.default_rng(3)
    level = 1.0 + np.cumsum(0.05 * rng.standard_normal(300))

    def followed(drift):
        return ExtendedKalman().estimate(
            Problem(
                names=("level",),
                bounds=np.array([[-20.0, 20.0]]),
                prior=unknown(np.array([1.0])),
                measured=(level + 0.2 * rng.standard_normal(300))[:, None],
                sigma=np.array([0.2]),
                observe=lambda _x, theta, i: theta[:1] + 0.0 * np.asarray(i),
                drift=np.array([drift]),
            )
        )

    right, rigid = followed(0.05), followed(0.001)
    assert (right.status, right.fit.verdict) == ("converged", "adequate")
    assert rigid.fit.verdict == "lack_of_fit"
