"""Integrate states over one sample with constant inputs: with error control, or by a fixed step of RK4 or Euler.

All parameter sets of a batch take the same steps, so differences between them are derivatives of the solver's own
steps (internal numerical differentiation), not of its step control.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rates = Callable[[Array], Array]
Solver = Literal["adaptive", "rk4", "euler"]
RTOL = 1e-8  # of every state's size, per step
MANY_STEPS = 200  # in one sample: from here the rates are stiff for an explicit method


def advance_states(rates: Rates, x: Array, dt_s: float, solver: Solver) -> Array:
    """Return the states (s, ...) after `dt_s`.

    Parameters
    ----------
    rates : function of the states (s, ...) giving their rates, of the same shape
    solver : str
        `adaptive`: Dormand and Prince's steps for an error of 1e-8, SciPy's implicit Radau where they would be too
        many; `rk4`: one step of Runge and Kutta; `euler`: one step of Euler.

    Notes
    -----
    A column without finite rates becomes NaN and does not shorten the steps of the others.

    Examples
    --------
    >>> print(advance_states(lambda x: -x, np.array([1.0]), 0.5, "adaptive").round(7))
    [0.6065307]
    """
    if solver == "euler":
        return x + dt_s * rates(x)
    if solver == "rk4":
        k1 = rates(x)
        k2 = rates(x + 0.5 * dt_s * k1)
        k3 = rates(x + 0.5 * dt_s * k2)
        return x + dt_s / 6.0 * (k1 + 2.0 * (k2 + k3) + rates(x + dt_s * k3))
    return _adaptive(rates, x, dt_s)


def _adaptive(rates: Rates, x: Array, dt_s: float) -> Array:
    """Take steps of Dormand and Prince, the same for all columns; stiff columns go to an implicit method."""
    start = x
    elapsed_s = 0.0
    step = dt_s
    with np.errstate(all="ignore"):
        slope = rates(x)
        for _ in range(MANY_STEPS):
            later, slope_later, ratios = _trial_step(rates, x, slope, step)
            worst = float(ratios.max())
            if worst <= 1.0:
                x = later
                slope = slope_later
                elapsed_s = elapsed_s + step
                if elapsed_s >= dt_s * (1.0 - 1e-12):
                    return x
            step = min(step * float(np.clip(0.9 * max(worst, 1e-10) ** -0.2, 0.1, 5.0)), dt_s - elapsed_s)
        hard = ratios > 0.1 * worst
        stiff = _stiff(rates, start, dt_s, hard)
        if hard.all() or not np.isfinite(np.where(hard, np.nan, start)).any():
            return stiff
        return np.where(hard, stiff, _adaptive(rates, np.where(hard, np.nan, start), dt_s))


def _trial_step(rates: Rates, x: Array, slope: Array, step: float) -> tuple[Array, Array, Array]:
    """Take one step; return states, rates and each column's error over its tolerance, 0 where not finite before it."""
    from scipy.integrate import RK45  # loads for half a second, which models without rates save

    stages = [slope]
    for row in RK45.A[1:]:
        stages.append(rates(x + step * _weighted_sum(row, stages)))
    later = x + step * _weighted_sum(RK45.B, stages)
    stages.append(rates(later))
    error = np.abs(step * _weighted_sum(RK45.E, stages))
    size = np.maximum(np.abs(x), np.abs(later))
    start_finite = np.isfinite(x).all(axis=0) & np.isfinite(slope).all(axis=0)
    finite = np.isfinite(error).all(axis=0) & np.isfinite(size).all(axis=0)
    finite_size = np.where(finite, size, 0.0)
    floor = finite_size.reshape(len(x), -1).max(axis=1).reshape(-1, *(1,) * (x.ndim - 1))
    tolerance = RTOL * np.maximum(finite_size, 1e-3 * floor) + 1e-14
    # 1e30, too long a step, where the step left the finite
    ratio = np.where(finite, error / tolerance, np.where(start_finite, 1e30, 0.0)).max(axis=0)
    return later, stages[-1], ratio


def _weighted_sum(weights: Array, stages: list[Array]) -> Array:
    total: Array = weights[0] * stages[0]
    for weight, stage in zip(weights[1:], stages[1:], strict=False):
        total = total + weight * stage
    return total


def _stiff(rates: Rates, x: Array, dt_s: float, hard: NDArray[np.bool_]) -> Array:
    """Integrate the columns `hard` by SciPy's Radau as one block system; NaN where it fails."""
    from scipy.integrate import solve_ivp
    from scipy.sparse import eye_array, kron

    states = np.full(x.shape, np.nan)
    first = x[:, hard]

    def flat(_t: float, y: Array) -> Array:
        whole = x.copy()
        whole[:, hard] = y.reshape(first.shape)
        return rates(whole)[:, hard].ravel()

    blocks = kron(np.ones((len(x), len(x))), eye_array(first.shape[1]))
    tolerance = RTOL * np.maximum(np.abs(first).ravel(), 1e-6)
    try:
        solution = solve_ivp(
            flat, (0.0, dt_s), first.ravel(), method="Radau", rtol=RTOL, atol=tolerance, jac_sparsity=blocks
        )
    except (ValueError, ArithmeticError, RuntimeError):  # rates not finite on the way
        return states
    if solution.success:
        states[:, hard] = solution.y[:, -1].reshape(first.shape)
    return states
