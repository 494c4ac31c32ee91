"""Numba where it is installed, plain Python where it is not; and what it compiles for every least squares: the step of
Levenberg and Marquardt, and the assessment of an optimum."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from importlib.util import find_spec
from types import FunctionType
from typing import Any, TypeVar, cast

import numpy as np

from hdt_core.estimation.problem import Array

F = TypeVar("F", bound=Callable[..., object])

COMPILED = find_spec("numba") is not None
"""Numba accelerates; nothing depends on it."""
FIRST_DAMPING = 1e-3
MOST_DAMPING = 1e20
NEGLIGIBLE_SHARE = 1e-8  # of the residual variance: the last step taken moved 1e-4 standard deviations
NEGLIGIBLE = 1e-22  # the same for records without noise, in squared sigmas
AT_BOUND_SD = 1e-3  # standard deviations from a bound within which a parameter rests on it


def compiled(function: F) -> F:
    """Compile on the first call and keep the machine code on disk; leave the function as it is without numba.

    Of fast arithmetic only the fused multiply-add is allowed, which rounds once where the formula rounds twice. Code
    kept on disk is renewed when the function's own file changes, not when a file it calls into does: save both.
    """
    return cast("F", _Compiled(function)) if COMPILED else function


class _Compiled:
    """A function and, from its first call on, its machine code: Numba loads for a quarter of a second."""

    def __init__(self, function: Callable[..., object]) -> None:
        self.py_func = function

    def __call__(self, *args: object) -> object:
        return self.machine_code(*args)

    @cached_property
    def machine_code(self) -> Any:
        from numba import njit  # noqa: PLC0415 (see above)

        names = self.py_func.__code__.co_names
        space = self.py_func.__globals__
        callees = {n: space[n].machine_code for n in names if isinstance(space.get(n), _Compiled)}
        return njit(cache=True, fastmath={"contract"})(linked(self.py_func, **callees))


def linked(function: F, **callees: object) -> F:
    """Copy a function with other callees: compiled code can call only compiled code."""
    return cast("F", FunctionType(function.__code__, function.__globals__ | callees, function.__name__))


@compiled
def damped_step(
    normal: Array, gradient: Array, size: Array, damping: float, theta: Array, lower: Array, upper: Array
) -> tuple[Array, float]:
    r"""Compute the step that reduces the linearised sum of squares inside the bounds, and the predicted reduction.

    .. math:: (J^T J + \mu D^2) p = -J^T r

    A parameter on its bound whose gradient points outward stays there; steps beyond a bound end on it.

    Parameters
    ----------
    normal : array (n, n)
        J^T J, prior information included.
    gradient : array (n,)
        J^T r, prior included.
    size : array (n,)
        D: the largest column norms met so far, positive.
    damping : float
        mu, relative to the scaled diagonal, which is one.
    theta, lower, upper : array (n,)

    Returns
    -------
    step : array (n,)
    predicted_reduction : float
        Reduction of r^T r by the step, inside the bounds, under the linear model; may be negative.

    References
    ----------
    .. [1] J. J. Moré, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630, 1978.
    """
    n = theta.size
    root = np.zeros((n, n))
    step = np.zeros(n)
    for i in range(n):
        outward = (theta[i] <= lower[i] and gradient[i] > 0.0) or (theta[i] >= upper[i] and gradient[i] < 0.0)
        step[i] = 0.0 if outward or lower[i] == upper[i] else -gradient[i] / size[i]
    free = step != 0.0
    for j in range(n):  # Cholesky of the scaled system, held rows and columns replaced by the unit's
        for i in range(j, n):
            total = normal[i, j] / (size[i] * size[j]) if free[i] and free[j] else 0.0
            if i == j:
                total = total + damping if free[i] else 1.0
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = np.sqrt(max(total, 1e-30)) if i == j else total / root[j, j]
    for i in range(n):
        for k in range(i):
            step[i] -= root[i, k] * step[k]
        step[i] /= root[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            step[i] -= root[k, i] * step[k]
        step[i] /= root[i, i]
    predicted_reduction = 0.0
    for i in range(n):
        step[i] = min(max(theta[i] + step[i] / size[i], lower[i]), upper[i]) - theta[i] if free[i] else 0.0
    for i in range(n):
        predicted_reduction -= 2.0 * gradient[i] * step[i]
        for k in range(n):
            predicted_reduction -= step[i] * normal[i, k] * step[k]
    return step, predicted_reduction


@compiled
def next_damping(damping: float, growth: float, reduction: float, predicted_reduction: float) -> tuple[float, float]:
    """Update damping and its growth factor after a step, by its `reduction` over the predicted one (Nielsen 1999)."""
    if reduction > 0.0 and predicted_reduction > 0.0:
        gain = min(reduction / predicted_reduction, 1.0)
        return max(damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-15), 2.0
    return damping * growth, 2.0 * growth


@compiled
def is_settled(predicted_reduction: float, cost: float, n_values: int) -> bool:
    """Check whether the step is the last and may be taken untried: its predicted reduction is negligible."""
    return abs(predicted_reduction) <= max(NEGLIGIBLE_SHARE * cost / n_values, NEGLIGIBLE)


@compiled
def is_exhausted(predicted_reduction: float, reduction: float, cost: float) -> bool:
    """Check whether the predicted reduction is below rounding, after a step that reduced nothing."""
    return reduction <= 0.0 and abs(predicted_reduction) <= 1e-12 * cost


@compiled
def inverse_spd(information: Array) -> tuple[Array, float]:  # noqa: PLR0912 (compiled: loops, not calls)
    """Invert a symmetric matrix (n, n); return also the determinant of the matrix scaled to unit diagonal.

    The determinant, between 0 and 1, bounds the smallest eigenvalue of the scaled matrix from below by a third of
    itself; where it is not positive the inverse is void.
    """
    n = len(information)
    root = np.zeros((n, n))
    inverse = np.zeros((n, n))
    size = np.zeros(n)
    determinant = 1.0
    for i in range(n):
        if not information[i, i] > 0.0:
            return inverse, 0.0
        size[i] = np.sqrt(information[i, i])
    for j in range(n):
        for i in range(j, n):
            total = information[i, j] / (size[i] * size[j])
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i == j:
                determinant *= total
                if not total > 0.0:
                    return inverse, 0.0
            root[i, j] = np.sqrt(total) if i == j else total / root[j, j]
    for c in range(n):
        column = np.zeros(n)
        for i in range(n):
            column[i] = 1.0 if i == c else 0.0
            for k in range(i):
                column[i] -= root[i, k] * column[k]
            column[i] /= root[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                column[i] -= root[k, i] * column[k]
            column[i] /= root[i, i]
        for i in range(n):
            inverse[i, c] = column[i] / (size[i] * size[c])
    return inverse, determinant


@compiled
def assess_optimum(normal: Array, gradient: Array, theta: Array, bounds: Array) -> tuple[Array, float, float, bool]:
    """Compute the inverse of `normal` (n, n) and its scaled determinant, the distance to the optimum in standard
    deviations (Newton's decrement), and whether no parameter rests on a bound."""
    inverse, determinant = inverse_spd(normal)
    square = 0.0
    is_inside = determinant > 0.0
    for i in range(theta.size):
        margin = AT_BOUND_SD * np.sqrt(inverse[i, i])
        is_inside = is_inside and bounds[i, 0] + margin < theta[i] < bounds[i, 1] - margin
        for j in range(theta.size):
            square += gradient[i] * inverse[i, j] * gradient[j]
    return inverse, determinant, np.sqrt(max(square, 0.0)), is_inside
