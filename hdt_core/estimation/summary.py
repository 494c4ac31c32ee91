"""An estimate on paper: a report that holds what lmfit's holds, and a drawing of the residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from hdt_core.estimation.estimate import Estimate
    from hdt_core.estimation.fit import Fit

SAID = 0.1  # correlations below this are left out, as by lmfit
MEANING = {
    "adequate": "model and sigma explain the record",
    "lack_of_fit": "residuals larger than sigma allows, or following one another: model or sigma is wrong",
    "sigma_too_large": "residuals smaller than sigma allows: sigma is declared too large",
    "untested": "no degrees of freedom to test the fit with",
}


def fit_report(estimate: Estimate) -> str:
    """Ends, statistics, parameters with three kinds of standard deviation, correlations."""
    fit, problem = estimate.fit, estimate.problem
    lines = [
        "[[Fit]]",
        f"    method               = {estimate.method or '-'}",
        f"    status               = {estimate.status}",
        f"    distance to optimum  = {estimate.distance:.2g} standard deviations",
        f"    model evaluations    = {estimate.n_evals}, and {estimate.n_checks} to question the answer",
        f"    values               = {fit.n_values}",
        f"    free parameters      = {fit.n_free}",
        f"    degrees of freedom   = {fit.degrees}",
        f"    chi-square           = {fit.chi2:.6g}",
        f"    reduced chi-square   = {fit.reduced_chi2:.6g}",
        f"    Akaike criterion     = {fit.aic:.6g}",
        f"    Bayesian criterion   = {fit.bic:.6g}",
        f"    fit                  = {fit.verdict}: {MEANING[fit.verdict]}",
        "[[Parameters]]",
    ]
    starts = np.full(estimate.belief.mean.size, np.nan) if problem is None else problem.origin
    if estimate.step_error is not None:
        shift = np.abs(estimate.step_error).max(initial=0.0)
        lines.insert(-1, f"    error of the step    = {shift:.2g} standard deviations")
    lines += _parameters(estimate, starts) + _correlations(estimate)
    if estimate.weak:
        lines.append(f"[[Left open by the data]]\n    {', '.join(estimate.weak)}")
    if estimate.better is not None:
        point = ", ".join(f"{name} {v:.6g}" for name, v in zip(_names(estimate), estimate.better, strict=True))
        lines.append(f"[[A better optimum]]\n    near {point}")
    return "\n".join(lines)


def draw(fit: Fit, axes: Axes) -> None:
    """Normalised residuals of every output over the samples."""
    for j, column in enumerate(fit.residuals.T):
        axes.plot(column, ".", markersize=3, label=f"output {j + 1}")
    axes.axhspan(-2.0, 2.0, color="0.9", zorder=0)
    axes.axhline(0.0, color="0.5", linewidth=0.8)
    title = f"chi-square {fit.chi2:.4g} of {fit.degrees} degrees of freedom: {fit.verdict}"
    axes.set(xlabel="sample", ylabel="(measured - model) / sigma", title=title)
    axes.legend()


def _names(estimate: Estimate) -> tuple[str, ...]:
    return estimate.identifiability.names


def _parameters(estimate: Estimate, starts: np.ndarray) -> list[str]:
    moving = estimate.innovations is not None
    n = estimate.belief.mean.size
    fit, none = estimate.fit, np.full(n, np.nan)
    scaled, sandwich = (none, none) if moving else (fit.scaled_sd, fit.sandwich_sd)
    width = max((len(name) for name in _names(estimate)), default=0)
    lines = []
    for i, name in enumerate(_names(estimate)):
        mean, sd = float(estimate.belief.mean[i]), float(estimate.belief.sd[i])
        share = f" ({100.0 * sd / abs(mean):.2f} %)" if mean and np.isfinite(sd) else ""
        lines.append(
            f"    {name:<{width}}  {mean:.8g} +/- {sd:.4g}{share}, scaled {scaled[i]:.4g}, sandwich {sandwich[i]:.4g}"
            f" (init {starts[i]:.6g})"
        )
        if estimate.profile is not None:
            low, high = estimate.profile.interval[i]
            lines.append(f"    {'':<{width}}  95 % by profile: {low:.6g} to {high:.6g}")
    return lines


def _correlations(estimate: Estimate) -> list[str]:
    names, cov = _names(estimate), estimate.belief.cov
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = cov / np.outer(estimate.belief.sd, estimate.belief.sd)
    pairs = [(i, j) for i in range(len(names)) for j in range(i) if abs(correlation[i, j]) >= SAID]
    if not pairs:
        return []
    pairs.sort(key=lambda pair: -abs(correlation[pair]))
    said = [f"    C({names[j]}, {names[i]}) = {correlation[i, j]:+.4f}" for i, j in pairs]
    return [f"[[Correlations]] (below {SAID:g} not shown)", *said]
