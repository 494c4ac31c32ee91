"""Methods on physics that lacks a force: `python -m benchmarks.missing_force [--seeds N] [--write]`.

The spring-mass-damper of section 3.2 carries a cubic spring of 6 N/m3 that the model does not have; the amplitude of
the drive sets how much of it the record shows. Truth: damping 0.5 N s/m, stiffness 2 N/m at rest.
"""

import numpy as np

from benchmarks.harness import Texts, markdown, run
from hdt_benchmark.oscillator_kernels import oscillator_kernels
from hdt_benchmark.spring_mass_damper import DT_S, SIGMA_M, SPRING_MASS_DAMPER, TRUTH, WRONG_GUESS, force_n
from hdt_core.estimation import Estimate, estimators
from hdt_core.estimation.compiled import COMPILED
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.problem import Problem
from hdt_core.physics.model import Array
from hdt_core.robust import Z_90

METHODS = ("nls", "pso", "ekf", "ukf", "pinn")
CASES = ((1.5, 6.0), (2.0, 6.0), (1.0, 6.0), (1.0, 0.0))
"""Amplitude of the drive [N], cubic stiffness [N/m3]; the last is the complete physics of the paper."""


def position_m(amplitude: float, cubic_n_m3: float) -> Array:
    """Simulate the position from rest by forward Euler. (1001,) [m]"""
    force, x, v = amplitude * force_n(), 0.0, 0.0
    position = np.empty(force.size)
    for i, push in enumerate(force):
        position[i] = x
        x, v = x + DT_S * v, v + DT_S * (push - TRUTH[0] * v - TRUTH[1] * x - cubic_n_m3 * x**3)
    return position


def record_of(amplitude: float, cubic_n_m3: float, seed: int) -> Problem:
    """Build the problem of one noisy record; its model has no cubic force."""
    force, noise = amplitude * force_n(), SIGMA_M * np.random.default_rng(seed).standard_normal(force_n().size)
    measured, mass_kg = position_m(amplitude, cubic_n_m3) + noise, SPRING_MASS_DAMPER.nominal["mass_kg"]
    return declared_problem(
        SPRING_MASS_DAMPER,
        ("damping_n_s_m", "stiffness_n_m"),
        {"force_n": force},
        {"measured_m": measured},
        prior=WRONG_GUESS,
        dt_s=DT_S,
        kernels=oscillator_kernels(force, measured, SIGMA_M, DT_S, mass_kg) if COMPILED else None,
    )


def row(method: str, amplitude: float, cubic_n_m3: float, seeds: int) -> list[str]:
    """Estimate every record by one method; format mean, deviation, coverage, verdicts."""
    estimator = estimators()[method]
    estimates = [estimator.estimate(record_of(amplitude, cubic_n_m3, seed)) for seed in range(seeds)]
    settled = [e for e in estimates if e.status == "converged"]
    return [
        f"{amplitude:g} N, {cubic_n_m3:g} N/m3",
        method,
        *(_parameter(estimates, i) for i in range(2)),
        *(_errors(settled, i) for i in range(2)),
        f"{len(settled)}",
        f"{sum(e.fit.verdict == 'lack_of_fit' for e in estimates)}",
        f"{sum('x1^3 in the rate of x2' in e.method for e in estimates)}",
    ]


def merge_equal(rows: list[list[str]]) -> list[list[str]]:
    """One row for methods that give the same figures in the same case."""
    methods: dict[tuple[str, ...], list[str]] = {}
    for case, method, *figures in rows:
        methods.setdefault((case, *figures), []).append(method)
    return [[case, ", ".join(names), *figures] for (case, *figures), names in methods.items()]


def _parameter(estimates: list[Estimate], i: int) -> str:
    return f"{np.mean([e.belief.mean[i] for e in estimates]):.3f} ± {np.mean([e.belief.sd[i] for e in estimates]):.3f}"


def _errors(estimates: list[Estimate], i: int) -> str:
    """Format coverage of the 90 % interval, and the largest error in deviations, of estimates that converged."""
    z = np.array([abs(e.belief.mean[i] - TRUTH[i]) / e.belief.sd[i] for e in estimates])
    return f"{(z < Z_90).mean():.2f}, {z.max():.1f}" if z.size else "-"


def main(seeds: int = 20) -> Texts:
    """Return the table."""
    head = ["drive, cubic stiffness", "method", "damping", "stiffness", "damping: coverage, worst [sd]",
            "stiffness: coverage, worst [sd]", "`converged`", "`lack_of_fit`", "force named"]  # fmt: skip
    rows = [row(method, *case, seeds) for case in CASES for method in METHODS]
    yield "missing force", markdown([head, *merge_equal(rows)])


if __name__ == "__main__":
    run(main)
