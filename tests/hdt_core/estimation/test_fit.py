"""What an estimate says of its fit: numbers that SciPy has too, and verdicts on records whose fault is known."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

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


def test_scaled_deviations_are_those_of_scipy():
    problem = line(noise=2.5)
    estimate = NonlinearLeastSquares().estimate(problem)
    best, cov = curve_fit(lambda x, a, b: a * x + b, X, problem.measured[:, 0], sigma=np.full(80, 0.1))
    np.testing.assert_allclose(estimate.belief.mean, best, rtol=1e-6)
    np.testing.assert_allclose(estimate.fit.scaled_sd, np.sqrt(np.diag(cov)), rtol=1e-6)


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


def test_statistics_are_those_of_the_textbook():
    problem = line()
    fit = NonlinearLeastSquares().estimate(problem).fit
    left = (problem.measured[:, 0] - np.polyval(np.polyfit(X, problem.measured[:, 0], 1), X)) / 0.1
    np.testing.assert_allclose(fit.residuals[:, 0], left, atol=1e-9)
    assert fit.chi2 == pytest.approx(left @ left)
    assert (fit.degrees, fit.n_values, fit.n_free) == (78, 80, 2)
    # Akaike and Schwarz as lmfit defines them
    assert fit.aic == pytest.approx(80 * np.log(left @ left / 80) + 4)
    assert fit.bic == pytest.approx(80 * np.log(left @ left / 80) + 2 * np.log(80))
    design = np.column_stack([X, np.ones(80)])
    bread = np.linalg.inv(design.T @ design)
    white = bread @ (design.T * (0.1 * left) ** 2) @ design @ bread * 80 / 78
    np.testing.assert_allclose(fit.sandwich_sd, np.sqrt(np.diag(white)), rtol=1e-6)


@pytest.mark.parametrize(
    ("problem", "verdict"),
    [
        (line(), "adequate"),
        (line(noise=3.0), "lack_of_fit"),
        (line(bend=0.5), "lack_of_fit"),
        (line(noise=0.3, bend=0.05), "lack_of_fit"),  # smaller than sigma, but in waves
        (line(noise=0.2), "sigma_too_large"),
        (replace(line(), measured=np.where(np.arange(80)[:, None] < 2, line().measured, np.nan)), "untested"),
    ],
    ids=["right", "sigma too small", "term missing", "waves", "sigma too large", "no degrees of freedom"],
)
def test_the_verdict_names_the_fault(problem, verdict):
    assert NonlinearLeastSquares().estimate(problem).fit.verdict == verdict


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


def test_a_held_parameter_is_known_and_counts_as_none():
    problem = replace(line(), bounds=np.array([[-100.0, 100.0], [1.0, 1.0]]))
    fit = NonlinearLeastSquares().estimate(problem).fit
    assert fit.n_free == 1
    assert fit.scaled_sd[1] == fit.sandwich_sd[1] == 0.0


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


def test_residuals_are_drawn():
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots()
    NonlinearLeastSquares().estimate(line(noise=3.0)).plot(axes)
    assert "lack_of_fit" in axes.get_title()
    assert len(axes.lines[0].get_xdata()) == 80
    plt.close(figure)
