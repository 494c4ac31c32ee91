"""What a record leaves open and how to close it: the likelihood profile of a parameter, and the next sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdt_core.estimation.estimate import Estimator
from hdt_core.estimation.identifiability import fisher, inverted
from hdt_core.estimation.problem import Array, Problem, Sample


@dataclass(frozen=True, slots=True)
class Candidate:
    """A sensor that could be added: its name, its noise sigma, and the output it would see, as `Problem.observe`."""

    name: str
    sigma: float
    observe: Callable[[Array, Array, Sample], Array]


@dataclass(frozen=True, slots=True)
class Gain:
    """What a candidate sensor brings: information in nats, and the standard deviations with it, (n,)."""

    name: str
    nats: float
    sd: Array


def rank_sensors(problem: Problem, theta: Array, candidates: Sequence[Candidate]) -> list[Gain]:
    r"""Candidates by what they add to what data and prior already tell about `theta` (n,), best first.

    .. math:: \Delta = \tfrac12 \ln\det(\mathcal I + \mathcal I_c) - \tfrac12 \ln\det\mathcal I

    Information the data lack altogether counts from the prior; without one, from a deviation of the bounds' width.
    """
    known = fisher(problem, theta).information + problem.prior.information + np.diag(_floor(problem))
    gains = []
    for candidate in candidates:
        asked = replace(
            problem,
            measured=np.zeros((len(problem.measured), 1)),
            sigma=np.array([candidate.sigma]),
            observe=candidate.observe,
            kernels=None,
        )
        total = known + fisher(asked, theta).information
        nats = 0.5 * (np.linalg.slogdet(total)[1] - np.linalg.slogdet(known)[1])
        gains.append(Gain(candidate.name, float(nats), np.sqrt(np.diag(inverted(total)[0]))))
    return sorted(gains, key=lambda gain: -gain.nats)


def profile(problem: Problem, estimator: Estimator, name: str, values: Array) -> Array:
    """Profile likelihood: the objective with `name` held at each of `values` (p,), all else estimated anew.

    Returns
    -------
    array (p,)
        Twice the negative log posterior; 95 % of a single parameter lies within 3.84 of the minimum.
    """
    index = problem.names.index(name)
    profiled = np.empty(len(values))
    for i, value in enumerate(values):
        bounds = problem.bounds.copy()
        bounds[index] = value
        held = replace(problem, bounds=bounds)
        profiled[i] = held.objective(estimator.estimate(held).belief.mean[None])[0]
    return profiled


def _floor(problem: Problem) -> Array:
    width = problem.bounds[:, 1] - problem.bounds[:, 0]
    silent = np.diag(problem.prior.information) == 0.0
    return np.where(silent | (width == 0.0), 1.0 / np.maximum(width, 1e-150) ** 2, 0.0)
