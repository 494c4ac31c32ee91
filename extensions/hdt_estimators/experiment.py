"""Plan an experiment: the most informative further sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdt_core.estimation.fit import fisher, invert_information
from hdt_core.estimation.problem import Array, Problem, Sample


@dataclass(frozen=True, slots=True)
class Candidate:
    """A sensor that could be added: its name, its noise sigma, and its output, as `Problem.observe`."""

    name: str
    sigma: float
    observe: Callable[[Array, Array, Sample], Array]


@dataclass(frozen=True, slots=True)
class Gain:
    """Gain of a candidate sensor: information in nats, and the standard deviations with it, (n,)."""

    name: str
    nats: float
    sd: Array


def rank_sensors(problem: Problem, theta: Array, candidates: Sequence[Candidate]) -> list[Gain]:
    r"""Rank candidates by their information about `theta` (n,) beside data and prior, best first.

    .. math:: \Delta = \tfrac12 \ln\det(\mathcal I + \mathcal I_c) - \tfrac12 \ln\det\mathcal I

    Information the data lack altogether counts from the prior; without one, from a deviation of the bounds' width.
    """
    information = fisher(problem, theta).information + problem.prior.information + np.diag(_floor(problem))
    gains = []
    for candidate in candidates:
        with_candidate = replace(
            problem,
            measured=np.zeros((len(problem.measured), 1)),
            sigma=np.array([candidate.sigma]),
            observe=candidate.observe,
            kernels=None,
        )
        total = information + fisher(with_candidate, theta).information
        nats = 0.5 * (np.linalg.slogdet(total)[1] - np.linalg.slogdet(information)[1])
        gains.append(Gain(candidate.name, float(nats), np.sqrt(np.diag(invert_information(total)[0]))))
    return sorted(gains, key=lambda gain: -gain.nats)


def _floor(problem: Problem) -> Array:
    width = problem.bounds[:, 1] - problem.bounds[:, 0]
    is_flat = np.diag(problem.prior.information) == 0.0
    return np.where(is_flat | (width == 0.0), 1.0 / np.maximum(width, 1e-150) ** 2, 0.0)
