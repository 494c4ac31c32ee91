"""Build an estimation problem from a declared physics model and its record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hdt_core.estimation.compiled import COMPILED
from hdt_core.estimation.integrated import Integrated, is_integrable
from hdt_core.estimation.problem import Array, Belief, Kernels, Problem, Sample
from hdt_core.physics.model import PhysicsModel


def declared_problem(
    model: PhysicsModel,
    free: Sequence[str],
    inputs: Mapping[str, Array],
    measured: Mapping[str, Array],
    *,
    prior: Belief | None = None,
    dt_s: float = 1.0,
    flights_per_sample: float = 0.0,
    kernels: Kernels | None = None,
    compiled: bool = COMPILED,
) -> Problem:
    """Estimate the parameters `free` of `model` from a record; all others keep their nominal values.

    Parameters
    ----------
    free : sequence of str
        Names of n parameters, for instance those of one role.
    inputs : mapping of name to array (k,)
    measured : mapping of output name to array (k,)
        NaN where missing; outputs without a record, or without a sensor's sigma, are not compared.
    prior : Belief, optional
        Nominal values with infinite variance by default.
    dt_s : float
        Time between samples [s], for models with states.
    flights_per_sample : float
        How many flights pass from one sample to the next, for the declared drift: none within a flight's record, one
        where every sample is a flight.
    compiled : bool
        Whether the rates of states are compiled, where their source is arithmetic that numba takes.
    """
    params = [next(p for p in model.params if p.name == name) for name in free]
    sensors = [(j, s) for j, s in enumerate(model.outputs) if s.name in measured and s.sigma is not None]
    unsure = np.diag(np.full(len(params), np.inf))

    def values(x: Array, theta: Array, i: Sample) -> tuple[dict[str, Array], dict[str, Array], dict[str, Array]]:
        states = {s.name: x[j] for j, s in enumerate(model.states)}
        signals = {name: np.asarray(signal)[i] for name, signal in inputs.items()}
        return {name: theta[j] for j, name in enumerate(free)}, signals, states

    def observe(x: Array, theta: Array, i: Sample) -> Array:
        theta_by_name, signals, states = values(x, theta, i)
        outputs = list(model.predict(theta_by_name, signals, states).values())
        return np.stack(np.broadcast_arrays(*(outputs[j] for j, _ in sensors)))

    def transition(x: Array, theta: Array, i: Sample) -> Array:
        theta_by_name, signals, states = values(x, theta, i)
        return np.stack(np.broadcast_arrays(*model.advance(theta_by_name, signals, states, dt_s).values()))

    def half_steps(x: Array, theta: Array, i: Sample) -> Array:
        theta_by_name, signals, states = values(x, theta, i)
        halfway = model.advance(theta_by_name, signals, states, 0.5 * dt_s)
        return np.stack(np.broadcast_arrays(*model.advance(theta_by_name, signals, halfway, 0.5 * dt_s).values()))

    n_states = len(model.states)
    quick = None
    if is_integrable(model, inputs):
        quick = Integrated(model, tuple(free), inputs, dt_s, transition, compiled)
    by_sample = transition if model.states else None
    return Problem(
        names=tuple(free),
        bounds=np.array([p.bounds for p in params], float),
        prior=Belief(np.array([p.nominal for p in params]), unsure) if prior is None else prior,
        measured=np.column_stack([np.asarray(measured[s.name], float) for _, s in sensors]),
        sigma=np.array([s.sigma for _, s in sensors], float),
        observe=observe,
        transition=by_sample if quick is None else quick.advance,
        half_steps=half_steps if model.states else None,
        trajectory=None if quick is None else quick.follow,
        start=Belief(np.array([s.initial for s in model.states]), np.zeros((n_states, n_states))),
        drift=np.sqrt(flights_per_sample) * np.array([p.drift for p in params]),
        kernels=kernels,
    )
