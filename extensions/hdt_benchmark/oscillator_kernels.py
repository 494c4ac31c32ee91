"""The spring-mass-damper of equation (1), compiled: forward Euler from rest, damping and stiffness unknown.

The equations are those of `hdt_benchmark.spring_mass_damper`; a test holds both to the same answer.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from hdt_core.estimation.compiled import (
    FIRST_DAMPING,
    MOST_DAMPING,
    compiled,
    damped_step,
    is_exhausted,
    is_settled,
    next_damping,
)
from hdt_core.estimation.problem import Array, Kernels


@compiled
def positions(thetas: Array, force_n: Array, dt_s: float, mass_kg: float) -> Array:
    """Positions (p, k) [m] of p oscillators with (damping [N s/m], stiffness [N/m]) in the rows of `thetas` (p,
    2)."""
    n = len(thetas)
    k = force_n.size
    out = np.zeros((k, n))
    x = np.zeros(n)
    v = np.zeros(n)
    h = dt_s / mass_kg
    keep = 1.0 - h * thetas[:, 0]
    pull = h * thetas[:, 1]
    for i in range(k - 1):
        force = force_n[i]
        for p in range(n):
            later = keep[p] * v[p] + (h * force - pull[p] * x[p])
            x[p] += dt_s * v[p]
            v[p] = later
            out[i + 1, p] = x[p]
    return out.T


@compiled
def sums_of_squares(thetas: Array, force_n: Array, dt_s: float, mass_kg: float, measured_m: Array) -> Array:
    """Sums of squares (p,) [m2] of simulated minus measured positions (k,), missing values left out."""
    n = len(thetas)
    k = force_n.size
    total = np.zeros(n)
    x = np.zeros(n)
    v = np.zeros(n)
    h = dt_s / mass_kg
    keep = 1.0 - h * thetas[:, 0]
    pull = h * thetas[:, 1]
    for i in range(k):
        force = force_n[i]
        position = measured_m[i]
        there = 0.0 if np.isnan(position) else 1.0
        position = 0.0 if np.isnan(position) else position
        for p in range(n):
            error = x[p] - position
            total[p] += there * error * error
            later = keep[p] * v[p] + (h * force - pull[p] * x[p])
            x[p] += dt_s * v[p]
            v[p] = later
    return total


@compiled
def slopes(theta: Array, force_n: Array, dt_s: float, mass_kg: float) -> Array:
    r"""Derivatives of the positions by damping and stiffness, (k, 1, 2), by the sensitivity equation.

    The oscillator's response to the force :math:`-x` is :math:`\partial x/\partial k`. Damping acts on the velocity,
    which is the difference of positions by the time step, so its derivative is the same difference of
    :math:`\partial x/\partial k`: the velocity of the second oscillator, exactly, as long as both start from rest.
    """
    out = np.zeros((force_n.size, 1, 2))
    h = dt_s / mass_kg
    keep = 1.0 - h * theta[0]
    pull = h * theta[1]
    x = v = xk = vk = 0.0
    for i in range(force_n.size):
        out[i, 0, 0] = vk
        out[i, 0, 1] = xk
        xk, vk = xk + dt_s * vk, keep * vk - (pull * xk + h * x)
        x, v = x + dt_s * v, keep * v + (h * force_n[i] - pull * x)
    return out


@compiled
def linearised(
    theta: Array, force_n: Array, dt_s: float, mass_kg: float, measured_m: Array, normal: Array, gradient: Array
) -> float:
    """Sum of squares [m2] at `theta`, and into `normal` (2, 2) and `gradient` (2,) its J^T J and J^T r, in one pass.

    The velocity is eliminated, as in `euler_position_m`: a position then waits for one multiplication, not for two.
    """
    h = dt_s / mass_kg
    once = 2.0 - h * theta[0]
    twice = 1.0 - h * theta[0] + h * dt_s * theta[1]
    push = h * dt_s
    per_s = 1.0 / dt_s
    x = next_x = xk = next_xk = 0.0
    cost = cc = ck = kk = gc = gk = 0.0
    for i in range(force_n.size):
        position = measured_m[i]
        if not np.isnan(position):
            error = x - position
            vk = (next_xk - xk) * per_s
            cost += error * error
            cc += vk * vk
            ck += vk * xk
            kk += xk * xk
            gc += vk * error
            gk += xk * error
        xk, next_xk = next_xk, once * next_xk - (twice * xk + push * x)
        x, next_x = next_x, once * next_x + (push * force_n[i] - twice * x)
    normal[0, 0], normal[0, 1], normal[1, 0], normal[1, 1] = cc, ck, ck, kk
    gradient[0], gradient[1] = gc, gk
    return cost


@compiled
def least_squares(
    force_n: Array, dt_s: float, mass_kg: float, measured_m: Array, sigma_m: float, n_values: int,
    origin: Array, lower: Array, upper: Array, prior_mean: Array, prior_information: Array, max_steps: int,
) -> tuple[Array, float, Array, Array, int]:  # fmt: skip
    """Levenberg and Marquardt as in `hdt_core.estimation.descent`: same steps, same stop; every trial brings its
    derivatives."""
    theta = origin.copy()
    weight = 1.0 / sigma_m**2
    normal = np.zeros((2, 2))
    gradient = np.zeros(2)
    next_normal = np.zeros((2, 2))
    next_gradient = np.zeros(2)
    cost = _posterior(
        theta, force_n, dt_s, mass_kg, measured_m, weight, prior_mean, prior_information, normal, gradient
    )
    size = np.full(2, 1e-300)
    damping = FIRST_DAMPING
    growth = 2.0
    n_evals = 1
    for _ in range(max_steps):
        for i in range(2):
            size[i] = max(size[i], np.sqrt(normal[i, i]))
        step, promised = damped_step(normal, gradient, size, damping, theta, lower, upper)
        trial = theta + step
        if is_settled(promised, cost, n_values):
            theta = trial
            break
        trial_cost = _posterior(
            trial, force_n, dt_s, mass_kg, measured_m, weight, prior_mean, prior_information, next_normal, next_gradient
        )
        n_evals += 1
        won = cost - trial_cost
        damping, growth = next_damping(damping, growth, won, promised)
        if won > 0.0:
            theta = trial
            cost = trial_cost
            normal, next_normal = next_normal, normal
            gradient, next_gradient = next_gradient, gradient
        if is_exhausted(promised, won, cost) or damping > MOST_DAMPING:
            break
    return theta, cost, gradient, normal, n_evals


@compiled
def _posterior(
    theta: Array, force_n: Array, dt_s: float, mass_kg: float, measured_m: Array, weight: float,
    prior_mean: Array, prior_information: Array, normal: Array, gradient: Array,
) -> float:  # fmt: skip
    cost = weight * linearised(theta, force_n, dt_s, mass_kg, measured_m, normal, gradient)
    for i in range(2):
        gradient[i] *= weight
        for j in range(2):
            away = theta[j] - prior_mean[j]
            normal[i, j] = weight * normal[i, j] + prior_information[i, j]
            gradient[i] += prior_information[i, j] * away
            cost += (theta[i] - prior_mean[i]) * prior_information[i, j] * away
    return cost


def oscillator_kernels(force_n: Array, measured_m: Array, sigma_m: float, dt_s: float, mass_kg: float) -> Kernels:
    """Compiled functions of a spring-mass-damper's record, for `Problem.kernels`.

    Parameters
    ----------
    force_n : array (k,)
    measured_m : array (k, 1) or (k,)
        Measured position [m], NaN where missing.
    """
    from hdt_benchmark.oscillator_kalman import kalman

    force = np.ascontiguousarray(force_n, float)
    measured = np.ascontiguousarray(np.ravel(measured_m), float)
    n_values = max(int(np.count_nonzero(~np.isnan(measured))), 1)
    return Kernels(
        simulate=lambda thetas: positions(thetas, force, dt_s, mass_kg)[:, :, None],
        chi2=lambda thetas: sums_of_squares(thetas, force, dt_s, mass_kg, measured) / sigma_m**2,
        sensitivity=lambda theta: slopes(theta, force, dt_s, mass_kg),
        least_squares=partial(least_squares, force, dt_s, mass_kg, measured, sigma_m, n_values),
        kalman=partial(kalman, force, dt_s, mass_kg, measured, sigma_m),
    )
