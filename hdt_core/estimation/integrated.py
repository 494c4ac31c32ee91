"""Transition and trajectory of a declared model whose states follow from their rates with error control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hdt_core.estimation.column_rates import column_rates
from hdt_core.estimation.compiled import COMPILED
from hdt_core.estimation.problem import Array, Integers, Sample, Transition
from hdt_core.estimation.trajectory import ColumnRates, trajectories
from hdt_core.physics.model import PhysicsModel


def is_integrable(model: PhysicsModel, inputs: Mapping[str, Array]) -> bool:
    """Check whether the states follow from rates alone, with error control, and the inputs are complete."""
    has_rates = model.rates is not None and model.step is None and model.solver == "adaptive"
    return has_rates and all(signal.name in inputs for signal in model.inputs)


@dataclass(frozen=True)
class Integrated:
    """States of a model over a record of inputs.

    Parameters
    ----------
    free : tuple of str
        Names of the n parameters that are estimated; all others keep their nominal values.
    inputs : mapping of name to array (k,)
    dt_s : float
        Time between samples. [s]
    by_sample : function (x, theta, i) giving the states (s, ...) a sample later
        For columns that need too many steps here, stiff ones for instance.
    compiled : bool
        Whether the rates are compiled where their source can be.
    """

    model: PhysicsModel
    free: tuple[str, ...]
    inputs: Mapping[str, Array]
    dt_s: float
    by_sample: Transition
    compiled: bool = COMPILED

    def advance(self, x: Array, theta: Array, i: Sample) -> Array:
        """Return the states (s, ...) a sample after i: a transition of `Problem`."""
        shape = np.broadcast_shapes(np.shape(x)[1:], np.shape(theta)[1:], np.shape(i))
        sample = np.broadcast_to(i, shape).reshape(1, -1)
        held = self._held(sample[0])
        states = self._states(_columns(x, shape), _columns(theta, shape), np.stack([held, held]), sample)
        return np.reshape(states[-1], (-1, *shape))

    def follow(self, theta: Array, n_samples: int) -> Array:
        """Return the states (k, s, p) at k samples for each column of `theta` (n, p): a trajectory of `Problem`."""
        initial = np.array([[state.initial] for state in self.model.states])
        start = np.repeat(initial, theta.shape[1], axis=1)
        inputs = np.ascontiguousarray(self._held(np.arange(n_samples)).T[:, :, None])
        return self._states(start, theta, inputs, np.arange(n_samples - 1)[:, None])

    def _states(self, start: Array, theta: Array, inputs: Array, samples: Integers) -> Array:
        """Return the states (k, s, p) over the inputs (k, i, p or 1) of the samples (k - 1, p or 1) between them."""

        def sample_by_sample(columns: Integers) -> Array:
            states = [start[:, columns]]
            for at in np.broadcast_to(samples, (len(samples), start.shape[1]))[:, columns]:
                states.append(self.by_sample(states[-1], theta[:, columns], at))
            return np.array(states)

        n_columns = start.shape[1]
        arguments = np.empty((len(self._argument_names), n_columns))
        arguments[: len(self._constants)] = self._constants[:, None]
        arguments[self._free_rows] = theta
        return trajectories(self._rates, start, arguments, inputs, self.dt_s, sample_by_sample)

    def _held(self, samples: Integers) -> Array:
        """Return the inputs (i, q) at samples (q,)."""
        return np.array([signal[samples] for signal in self._series]).reshape(len(self._series), len(samples))

    @cached_property
    def _input_names(self) -> tuple[str, ...]:
        """Names in the record; a parameter may be among them."""
        declared = [s.name for s in self.model.inputs] + [p.name for p in self.model.params]
        return tuple(name for name in declared if name in self.inputs)

    @cached_property
    def _constant_names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.model.params if p.name not in self.inputs)

    @cached_property
    def _argument_names(self) -> tuple[str, ...]:
        return self._constant_names + self._input_names

    @cached_property
    def _constants(self) -> Array:
        return np.array([self.model.nominal[name] for name in self._constant_names])

    @cached_property
    def _free_rows(self) -> list[int]:
        return [self._constant_names.index(name) for name in self.free]

    @cached_property
    def _series(self) -> list[Array]:
        return [np.asarray(self.inputs[name], float) for name in self._input_names]

    @cached_property
    def _rates(self) -> ColumnRates:
        assert self.model.rates is not None
        state_names = tuple(s.name for s in self.model.states)
        return column_rates(self.model.rates, state_names, self._argument_names, compiled=self.compiled)


def _columns(values: Array, shape: tuple[int, ...]) -> Array:
    """Lay out values (r, ...) as columns (r, p) of the broadcast shape."""
    return np.ascontiguousarray(np.broadcast_to(_padded(values, shape), (len(values), *shape)).reshape(len(values), -1))


def _padded(values: Array, shape: tuple[int, ...]) -> Array:
    """Add axes behind the first, so that the rest broadcasts with `shape` from the right."""
    rest = np.shape(values)[1:]
    return np.reshape(values, (len(values), *(1,) * (len(shape) - len(rest)), *rest))
