"""The night's batched answers are those of a literal `Estimator` that is handed the component's declaration."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.components.pack import HX
from hdt_core.estimation import NonlinearLeastSquares
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.problem import Problem
from hdt_core.robust import huber_weights
from hdt_core.tracking.wear_model import PACES

LEG = ["tail", "pack", "flight_id"]
N_LEGS = 40


@pytest.fixture(scope="module")
def legs(fleet) -> pl.DataFrame:
    """Cruise samples of legs drawn at random, worn and clean packs among them."""
    chosen = fleet.samples.select(LEG).unique(maintain_order=True).sample(N_LEGS, seed=7, shuffle=True)
    return fleet.samples.join(chosen, on=LEG, how="semi").filter(pl.col("phase") == "cruise")


def literal_ln_ratio(leg: pl.DataFrame, model, sd: float, batched: float) -> float:
    """Ln of the conductance left, by nonlinear least squares on the hot outlet through the declared model.

    A sample counts as much as Huber's weight says, of whose scale the stated deviation `sd` is the share: least squares
    with these weights is what the robust answer claims to be.
    """
    rows = cruise_samples(leg).drop_nulls(list(hx.SIGNALS))
    signals = {name: rows[name].to_numpy().astype(float) for name in hx.SIGNALS}
    corrected = hx.without_bias(signals, model.bias_of(rows))
    built = HX.model.calibrated(dict(zip(hx.NAMES, model.exchanger, strict=True)))
    inputs = {s.name: corrected[s.name] for s in built.inputs}
    problem = declared_problem(built, [HX.loss], inputs, {"hx_out_k": corrected["hx_out_k"]})
    off = np.abs(hx.ln_conductance_ratio(signals, model.design, model.bias_of(rows)) - batched)
    weight = np.ones(rows.height)
    for _ in range(20):
        weight = huber_weights(off, sd * np.sqrt(weight.sum()))
    estimate = NonlinearLeastSquares().estimate(side_by_side(problem, weight))
    assert estimate.status == "converged"
    return float(np.log1p(-estimate.belief.mean[0]))


def side_by_side(problem: Problem, weight: np.ndarray) -> Problem:
    """The same question with every sample an output of its own, whose sigma tells how much it counts."""

    def observe(states, theta, _sample):
        return np.moveaxis(problem.observe(states, theta, np.arange(len(weight)))[0], -1, 0)[..., None]

    return replace(problem, measured=problem.measured.T, sigma=problem.sigma / np.sqrt(weight), observe=observe)


def both(samples: pl.DataFrame, model) -> pl.DataFrame:
    """Batched and literal answer to each leg."""
    estimates = estimate_flights(samples, model).select(*LEG, "ln_ua_ratio", "ln_ua_ratio_sd")
    batched = {leg: (value, sd) for *leg, value, sd in estimates.iter_rows() for leg in [tuple(leg)]}
    legs = samples.group_by(LEG, maintain_order=True)
    literal = [(*leg, literal_ln_ratio(rows, model, batched[leg][1], batched[leg][0])) for leg, rows in legs]
    frame = pl.DataFrame(literal, schema=[*LEG, "literal"], orient="row")
    return estimates.join(frame.cast({"pack": pl.Int32}), on=LEG)


def test_single_sample_equals_literal_answer(legs, model):
    """Of a single sample least squares leaves nothing over, so the closed form is its answer."""
    rows = both(legs.group_by(LEG, maintain_order=True).head(1), model)
    assert rows.height == N_LEGS
    np.testing.assert_allclose(rows["ln_ua_ratio"], rows["literal"], atol=1e-6)


def test_robust_form_nears_literal_answer(legs, model):
    rows = both(legs, model)
    apart = (rows["ln_ua_ratio"] - rows["literal"]).abs() / rows["ln_ua_ratio_sd"]
    assert rows.height == N_LEGS
    assert apart.max() < 0.1


def test_declared_drift_matches_paces():
    """An estimator of one's own is told one number, the nightly filter three ways to wear: of about the same size."""
    rate = np.sqrt(sum(pace.share * (pace.rate**2 + pace.rate_sd**2) for pace in PACES))
    assert HX.model.param("hx_fouling").drift == pytest.approx(rate, rel=0.25)
