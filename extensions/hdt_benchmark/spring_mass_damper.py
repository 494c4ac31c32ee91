"""The spring-mass-damper of section 3.2, the paper's benchmark of estimators: a noisy record, a wrong initial guess."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from hdt_benchmark.oscillator_kernels import oscillator_kernels
from hdt_core.estimation.compiled import COMPILED
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.problem import Belief, Problem
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal, State


def rates(
    *,
    force_n: Array,
    damping_n_s_m: Array,
    stiffness_n_m: Array,
    mass_kg: Array,
    position_m: Array,
    velocity_m_s: Array,
) -> tuple[Array, Array]:
    """Equation (1) with the force the text adds: velocity [m/s] and acceleration [m/s2].

    Notes
    -----
    .. math:: m \\ddot x + b \\dot x + k x = F

    The paper prints no force, and calls the damping b, a and c in turn.
    """
    return velocity_m_s, (force_n - damping_n_s_m * velocity_m_s - stiffness_n_m * position_m) / mass_kg


def position(
    *,
    force_n: Array,
    damping_n_s_m: Array,
    stiffness_n_m: Array,
    mass_kg: Array,
    position_m: Array,
    velocity_m_s: Array,
) -> Array:
    """What is measured. [m]"""
    return position_m


def euler_position_m(
    force_n: Array, dt_s: float, damping_n_s_m: float, stiffness_n_m: float, mass_kg: float = 1.0
) -> Array:
    """Position over time from rest, by forward Euler as in the paper, as one pass of a filter. [m]

    Parameters
    ----------
    force_n : (n_samples,) array
        Force held over each step. [N]

    Notes
    -----
    Two Euler steps eliminate the velocity: ``x[k+2] - (2 - c h) x[k+1] + (1 - c h + k h^2) x[k] = h^2 F[k] / m``
    with c and k over the mass and h the step; equal to the loop to rounding.

    Examples
    --------
    >>> [round(float(x), 10) for x in euler_position_m(np.ones(4), 0.01, 0.5, 2.0)]
    [0.0, 0.0, 0.0001, 0.0002995]
    """
    c = damping_n_s_m / mass_kg
    k = stiffness_n_m / mass_kg
    recursion = [1.0, -(2.0 - c * dt_s), 1.0 - c * dt_s + k * dt_s**2]
    return np.asarray(lfilter([0.0, 0.0, dt_s**2 / mass_kg], recursion, force_n))


SPRING_MASS_DAMPER = PhysicsModel(
    name="spring_mass_damper",
    inputs=(Signal("force_n", "N"),),
    params=(
        Param("mass_kg", "kg", 1.0, (0.1, 10.0), "design"),
        Param("damping_n_s_m", "N s/m", 0.5, (0.0, 10.0), "design"),
        Param("stiffness_n_m", "N/m", 2.0, (0.0, 50.0), "design"),
    ),
    states=(State("position_m", "m", 0.0), State("velocity_m_s", "m/s", 0.0)),
    outputs=(Signal("measured_m", "m", sigma=0.05),),
    equations=position,
    rates=rates,
    solver="euler",  # the paper's
)
"""As in section 3.2.2: a step of 0.01 s by Euler, from rest, 0.5 Hz of amplitude 1 N, noise 0.05 m."""


DT_S, N_SAMPLES, SIGMA_M = 0.01, 1001, 0.05
TRUTH = np.array([0.5, 2.0])
"""Damping [N s/m] and stiffness [N/m]."""
WRONG_GUESS = Belief(np.array([0.2, 1.0]), np.diag([0.3, 1.0]) ** 2)
"""Initial guess of every estimator, wrong by one of its standard deviations."""


def force_n() -> Array:
    """Compute the force: a sine of 0.5 Hz and amplitude 1 N over ten seconds. (1001,)"""
    force: Array = np.sin(2.0 * np.pi * 0.5 * DT_S * np.arange(N_SAMPLES))
    return force


def true_position_m() -> Array:
    """Compute the noise-free position, by forward Euler from rest. (1001,) [m]"""
    return euler_position_m(force_n(), DT_S, *TRUTH)


def oscillator_problem(seed: int, *, compiled: bool = True) -> Problem:
    """Build the problem of a record with the noise of `seed`; its kernels are compiled where numba is installed."""
    measured = true_position_m() + SIGMA_M * np.random.default_rng(seed).standard_normal(N_SAMPLES)
    mass = SPRING_MASS_DAMPER.nominal["mass_kg"]
    quick = compiled and COMPILED
    return declared_problem(
        SPRING_MASS_DAMPER,
        ("damping_n_s_m", "stiffness_n_m"),
        {"force_n": force_n()},
        {"measured_m": measured},
        prior=WRONG_GUESS,
        dt_s=DT_S,
        kernels=oscillator_kernels(force_n(), measured, SIGMA_M, DT_S, mass) if quick else None,
    )
