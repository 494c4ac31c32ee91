"""Benchmark problem of section 3.2.2: one noisy record of the spring-mass-damper and one wrong initial guess."""

from __future__ import annotations

import numpy as np

from hdt_benchmark.oscillator_kernels import oscillator_kernels
from hdt_benchmark.spring_mass_damper import SPRING_MASS_DAMPER, euler_position_m
from hdt_core.estimation.compiled import COMPILED
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.problem import Array, Belief, Problem

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
    mass, quick = SPRING_MASS_DAMPER.nominal["mass_kg"], compiled and COMPILED
    return declared_problem(
        SPRING_MASS_DAMPER,
        ("damping_n_s_m", "stiffness_n_m"),
        {"force_n": force_n()},
        {"measured_m": measured},
        prior=WRONG_GUESS,
        dt_s=DT_S,
        kernels=oscillator_kernels(force_n(), measured, SIGMA_M, DT_S, mass) if quick else None,
    )
