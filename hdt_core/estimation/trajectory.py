"""States of a declared model along a whole record: steps as long as their error allows, samples read between them.

All parameter sets of a batch are columns of one array and take the same steps, so differences between them are
derivatives of the solver's own steps. One source serves NumPy and numba; only what both know is used.

References
----------
.. [1] E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential Equations I, 1993, sections II.4 to II.6.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any

import numpy as np

from hdt_core.estimation.problem import Array, Integers
from hdt_core.physics.integrators import MANY_STEPS, RTOL

ColumnRates = Callable[[Array, Array, Array], None]
"""Of states (s, p) and arguments (q, p), parameters before inputs: writes the rates (s, p) into the last array."""
Method = tuple[Array, Array, Array, Array]
"""Weights of the stages (6, 6), of the step (6,), of its error (7,), and of the powers between its ends (7, 4)."""
SMALLEST = 1e-14  # tolerance of a state that is zero, in its unit
SAFETY = 0.9  # of the step that would just meet the tolerance
MOST_CUT, MOST_GROWTH, LEAST_RATIO = 0.1, 5.0, 1e-10  # from a step to the next
HARD = 0.1  # of the worst column's error: what a column that is hard for the method has
NEVER = 1e30  # error over tolerance of a step that left the finite
ROUNDING = 1e-9  # of a step: a sample that is nearer to its end is at its end


def trajectories(
    rates: ColumnRates,
    start: Array,
    arguments: Array,
    inputs: Array,
    dt_s: float,
    sample_by_sample: Callable[[Integers], Array],
) -> Array:
    """Return the states (k, s, p) at k samples from `start` (s, p); NaN where a column has none.

    Parameters
    ----------
    rates : function of states and arguments that writes the rates
    arguments : array (q, p)
        Parameters, then room for the inputs, which are written into it.
    inputs : array (k, i, p) or (k, i, 1)
        Held constant from each sample to the next.
    sample_by_sample : function of the numbers of columns (h,) giving their states (k, s, h)
        What solves columns whose steps would be too many, stiff ones for instance.
    """
    states = np.full((len(inputs), *start.shape), np.nan)
    states[0] = start
    held_until = _held_until(inputs)
    columns = np.flatnonzero(np.isfinite(start).all(axis=0))
    while columns.size:
        held = inputs if inputs.shape[-1] == 1 else inputs.take(columns, axis=-1)
        with np.errstate(all="ignore"):
            found, reached, ratios = _follow(
                rates, start.take(columns, axis=1), arguments.take(columns, axis=1), held, held_until, dt_s
            )
        if reached == len(inputs) - 1:
            states[:, :, columns] = found
            break
        worst = np.nan_to_num(ratios, nan=NEVER, posinf=NEVER).max(axis=0)
        is_hard = worst > HARD * worst.max()
        states[:, :, columns[is_hard]] = sample_by_sample(columns[is_hard])
        columns = columns[~is_hard]
    return states


def _held_until(inputs: Array) -> Integers:
    """Return for each sample (k,) the sample at which its inputs change next, or the last."""
    last = len(inputs) - 1
    changes = np.flatnonzero((inputs[1:] != inputs[:-1]).any(axis=(1, 2))) + 1
    ends = np.append(changes, last)
    return np.asarray(ends[np.searchsorted(changes, np.arange(last + 1), side="right")])


def _follow(
    rates: ColumnRates, start: Array, arguments: Array, inputs: Array, held_until: Integers, dt_s: float
) -> tuple[Array, int, Array]:
    """Follow by machine code where the rates are; return states (k, s, p), the last sample reached, ratios (s, p)."""
    function = follow if isinstance(rates, FunctionType) else _compiled_follow()
    states, reached, ratios = function(rates, start, arguments, inputs, held_until, dt_s, _dormand_prince())
    return states.reshape(-1, *start.shape), reached, ratios.reshape(start.shape)


def follow(
    rates: ColumnRates,
    start: Array,
    arguments: Array,
    inputs: Array,
    held_until: Integers,
    dt_s: float,
    method: Method,
) -> tuple[Array, int, Array]:
    """Take steps of a Runge-Kutta pair, the same for all columns.

    Returns
    -------
    states : array (k, s * p)
    reached : int
        Last sample with states; an earlier one than k - 1 where the next takes more than `MANY_STEPS` steps.
    ratios : array (s * p,)
        Error over tolerance of the step tried last.
    """
    of_stage, of_step, of_error, between = method
    n_samples, n_inputs, _ = inputs.shape
    shape = start.shape
    x = start.copy().reshape(start.size)
    states = np.empty((n_samples, x.size))
    states[0] = x
    slopes = np.empty((7, x.size))
    largest = np.abs(x)
    ratios = np.zeros(x.size)
    proposed_s = dt_s
    reached = 0
    while reached < n_samples - 1:
        first = reached
        last = held_until[first]
        elapsed_s = 0.0
        n_tried = 0
        for i in range(n_inputs):
            arguments[i - n_inputs] = inputs[first, i]
        rates(x.reshape(shape), arguments, slopes[0].reshape(shape))
        while reached < last:
            n_tried += 1
            if n_tried > MANY_STEPS:
                return states, reached, ratios
            step_s = min(proposed_s, (last - first) * dt_s - elapsed_s)
            for j in range(1, 6):
                middle = x + step_s * (of_stage[j, :j].copy() @ slopes[:j])
                rates(middle.reshape(shape), arguments, slopes[j].reshape(shape))
            later = x + step_s * (of_step @ slopes[:6])
            rates(later.reshape(shape), arguments, slopes[6].reshape(shape))
            size = np.maximum(largest, np.abs(later))
            ratios = np.abs(step_s * (of_error @ slopes)) / (RTOL * size + SMALLEST)
            worst = float(ratios.max())
            worst = worst if worst < NEVER else NEVER  # the step left the finite
            next_s = step_s * min(max(SAFETY * max(worst, LEAST_RATIO) ** -0.2, MOST_CUT), MOST_GROWTH)
            if worst > 1.0:
                proposed_s = next_s
                continue
            proposed_s = max(proposed_s, next_s) if step_s < proposed_s else next_s
            while reached < last and (reached + 1 - first) * dt_s - elapsed_s <= step_s * (1.0 + ROUNDING):
                reached += 1
                n_tried = 0
                share = min(((reached - first) * dt_s - elapsed_s) / step_s, 1.0)
                powers = np.array([share, share**2, share**3, share**4])
                states[reached] = x + step_s * ((between @ powers) @ slopes)
            x = later
            largest = size
            slopes[0] = slopes[6]
            elapsed_s += step_s
    return states, reached, ratios


@cache
def _dormand_prince() -> Method:
    """Return the weights of Dormand and Prince's pair of orders 5 and 4, as SciPy has them."""
    from scipy.integrate import RK45  # noqa: PLC0415 (loads for half a second, which models without states save)

    of_stage = np.zeros((6, 6))
    of_stage[:, : RK45.A.shape[1]] = RK45.A
    return of_stage, RK45.B.copy(), RK45.E.copy(), RK45.P.copy()


@cache
def _compiled_follow() -> Any:
    """Compile for any compiled rates, once a machine: they are called by their address."""
    from numba import njit, types  # noqa: PLC0415 (loads for half a second)

    method = types.Tuple([types.float64[:, ::1], types.float64[::1], types.float64[::1], types.float64[:, ::1]])
    table = types.float64[:, ::1]
    arguments = (types.FunctionType(column_signature()), table, table, types.float64[:, :, ::1], types.int64[::1])
    return njit((*arguments, types.float64, method), cache=True, fastmath={"contract"})(follow)


@cache
def column_signature() -> Any:
    """Return numba's type of `ColumnRates`."""
    from numba import types  # noqa: PLC0415 (loads for half a second)

    table = types.float64[:, ::1]
    return types.void(table, table, table)
