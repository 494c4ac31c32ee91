"""Estimate the exchanger's design by the method that it names, on the cruise points of all packs.

What the packs do not share - their sensors' biases, and the level of health at each flight - is the panel's
(`calibration.exchanger`), and the rows count as they do there; given these, the design is the declared model's. The
standard deviations are the panel's too, for they hold with biases and levels unknown.
"""

from dataclasses import replace

import numpy as np

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Points
from hdt_core.calibration.component_fit import WITHOUT_ESTIMATE, declared_estimator
from hdt_core.components import Component
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.panel import Panel, PanelFit, forward_differences
from hdt_core.estimation.problem import Belief, Problem, Sample
from hdt_core.physics.model import Array, PhysicsModel, Signal


def design_by_method(points: Points, panel: Panel, fit: PanelFit, part: Component) -> Estimate:
    """Estimate the design of `exchanger.NAMES` by the part's own method.

    Parameters
    ----------
    points : Points
        Level medians that the panel holds.
    panel, fit : Panel, PanelFit
        Of `exchanger.exchanger_panel`, and its end.
    part : Component
        The heat exchanger, with its estimator.

    Returns
    -------
    Estimate
        With the panel's covariance. Where the method ends without an estimate, the panel's, whose `method` says so.
    """
    method = declared_estimator(part)
    estimate = method.estimate(design_problem(points, panel, fit, part))
    if estimate.status in WITHOUT_ESTIMATE or not np.isfinite(estimate.belief.mean).all():
        return replace(fit.estimate, method=f"{part.estimator} without an estimate, finished by nls")
    belief = Belief(estimate.belief.mean, fit.estimate.belief.cov)
    return replace(estimate, belief=belief, method=estimate.method or method.name)


def design_problem(points: Points, panel: Panel, fit: PanelFit, part: Component) -> Problem:
    """Build the problem of the outlets, each row over its own standard deviation."""
    clean = hx.without_bias(points.signals, fit.units[points.pack].T)
    model = with_known_health(part.model, part.loss)
    inputs = {s.name: clean[s.name] for s in part.model.inputs} | {part.loss: -np.expm1(fit.level)}
    slope_k = _outlet_per_ln_conductance(model, inputs, part.loss, fit)
    sd_k = {"hx_out_k": np.abs(slope_k) / np.sqrt(fit.weights[0])}
    if panel.others:
        heated_k = clean["ram_out_k"] - clean["tat_k"]  # by its ln the ram flow of the heat balance
        sd_k["ram_out_k"] = np.abs(heated_k) / np.sqrt(fit.weights[1])
    sd = np.stack([np.where(np.isfinite(v) & (v > 0.0), v, np.nan) for v in sd_k.values()])
    measured = {name: np.where(np.isfinite(v), clean[name], np.nan) for name, v in zip(sd_k, sd, strict=True)}
    problem = declared_problem(model, panel.names, inputs, measured, prior=_prior(panel, fit))
    scale = np.where(np.isfinite(sd), sd, 1.0)

    def observe(x: Array, theta: Array, i: Sample) -> Array:
        outlets_k = problem.observe(x, theta, i)
        own = scale[:, i]
        return outlets_k / own.reshape(len(own), *(1,) * (outlets_k.ndim - own.ndim), *own.shape[1:])

    return replace(problem, measured=problem.measured / scale.T, sigma=np.ones(len(scale)), observe=observe)


def with_known_health(model: PhysicsModel, loss: str) -> PhysicsModel:
    """Return the model with its loss as an input, which every row has its own of."""
    params = tuple(p for p in model.params if p.name != loss)
    return replace(model, inputs=(*model.inputs, Signal(loss, "-")), params=params)


def _outlet_per_ln_conductance(model: PhysicsModel, inputs: dict[str, Array], loss: str, fit: PanelFit) -> Array:
    """Compute the hot outlet's derivative by the ln conductance at the panel's design. (n,) [K]"""
    design = dict(zip(hx.NAMES, fit.estimate.belief.mean, strict=True))

    def outlet_k(level: Array) -> Array:
        return model.predict(design, inputs | {loss: -np.expm1(level)})["hx_out_k"]

    with np.errstate(all="ignore"):  # a shut door has no outlet
        return (outlet_k(fit.level + hx.STEP) - outlet_k(fit.level)) / hx.STEP


def _prior(panel: Panel, fit: PanelFit) -> Belief:
    """Join the declared prior with the panel's terms on the design alone, linear about its end."""
    prior = panel.prior
    design = fit.estimate.belief.mean
    terms = panel.prior_terms(design)
    slope = forward_differences(panel.prior_terms, design, terms, panel.step, panel.bounds[:, 1])
    cov = np.asarray(np.linalg.inv(prior.information + slope.T @ slope), float)
    pull = prior.information @ prior.mean + slope.T @ (slope @ design - terms)
    return Belief(cov @ pull, cov)
