"""Declared components with states against SciPy's pair: `python -m benchmarks.declared_states [--rounds N] [--write]`.

Claim: a component whose states follow from a few lines of rates is fitted as fast as by `solve_ivp` and `least_squares`
in a user's own hands, and at least five times faster where numba is installed. The peer has the same rates, in plain
floats, the same relative error of 1e-8 a step, and inputs held from sample to sample as here. The best time of a few
rounds counts, of swarm and net that of one, all contestants in turn on one thread; compiling is left out: seconds once
a machine, then a third of a second for each model. `--write` puts the table into docs/benchmark.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from benchmarks.harness import Texts, best_cpu_s, markdown, run
from hdt_benchmark import timing
from hdt_benchmark.spring_mass_damper import DT_S, N_SAMPLES, SPRING_MASS_DAMPER, WRONG_GUESS, force_n
from hdt_core.estimation import Estimate, Problem, estimators, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.integrators import RTOL
from hdt_core.physics.lumped_exchanger import rates_k_s
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal, State, as_tuple

GOALS = {"with numba": 5.0, "without": 1.0}
"""How many times longer SciPy's pair should take than `nls`."""
SLOW = ("pso", "pinn")
"""Methods that one round has to do for."""


def oscillator_rates(*, mu: Array, position: Array, speed: Array) -> tuple[Array, Array]:
    """Van der Pol's oscillator, which limits itself."""
    return speed, mu * (1.0 - position**2) * speed - position


VAN_DER_POL = PhysicsModel(
    name="van der Pol",
    inputs=(),
    outputs=(Signal("seen", "-", sigma=0.05),),
    params=(Param("mu", "-", 1.0, (0.1, 5.0), "design"),),
    equations=lambda mu, position, speed: position,
    states=(State("position", "-", 2.0), State("speed", "-", 0.0)),
    rates=oscillator_rates,
)
EXCHANGER = PhysicsModel(
    name="exchanger, equations (7)-(8)",
    inputs=tuple(Signal(name, unit) for name, unit in (
        ("hot_flow_kg_s", "kg/s"), ("ram_flow_kg_s", "kg/s"), ("hot_in_k", "K"), ("cold_in_k", "K")
    )),
    outputs=(Signal("hot_out_k", "K", sigma=0.5), Signal("ram_out_k", "K", sigma=0.5)),
    params=(
        Param("hx_h_hot_w_k", "W/K", 2000.0, (100.0, 1e5), "design"),
        Param("hx_h_cold_w_k", "W/K", 2000.0, (100.0, 1e5), "design"),
        Param("hx_mass_hot_kg", "kg", 8.0, (0.1, 50.0), "design"),
        Param("hx_mass_cold_kg", "kg", 8.0, (0.1, 50.0), "design"),
    ),
    equations=lambda hot_volume_k, cold_volume_k, **_: (hot_volume_k, cold_volume_k),
    states=(State("hot_volume_k", "K", 320.0), State("cold_volume_k", "K", 290.0)),
    rates=rates_k_s,
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A declared model, what is unknown of it, where the search begins, and the record's inputs."""

    model: PhysicsModel
    truth: Mapping[str, float]
    start: Array
    inputs: Mapping[str, Array]
    n_samples: int
    dt_s: float

    def measured(self) -> dict[str, Array]:
        """Simulate the outputs with noise (k,) by the model's own integrator."""
        clean = self.model.simulate(self.truth, self.inputs, self.dt_s, n_samples=self.n_samples)
        noise = np.random.default_rng(0)
        sigmas = {s.name: s.sigma or 0.0 for s in self.model.outputs}
        return {name: clean[name] + sigma * noise.standard_normal(self.n_samples) for name, sigma in sigmas.items()}

    def problem(self, *, compiled: bool) -> Problem:
        """Build the problem of the record, without a prior."""
        prior = unknown(self.start)
        free = tuple(self.truth)
        return declared_problem(
            self.model, free, self.inputs, self.measured(), prior=prior, dt_s=self.dt_s, compiled=compiled
        )


def cases() -> dict[str, Case]:
    """Return the three models, by a short name."""
    rng = np.random.default_rng(1)
    low_high = ((0.5, 1.2), (0.6, 2.4), (370.0, 430.0), (225.0, 280.0))
    names = [signal.name for signal in EXCHANGER.inputs]
    flight = {name: rng.uniform(*ends, 200) for name, ends in zip(names, low_high, strict=True)}
    coefficients = {"hx_h_hot_w_k": 1500.0, "hx_h_cold_w_k": 3000.0}
    damper = replace(SPRING_MASS_DAMPER, name="spring-mass-damper", solver="adaptive")
    spring = {"damping_n_s_m": 0.5, "stiffness_n_m": 2.0}
    return {
        "van_der_pol": Case(VAN_DER_POL, {"mu": 1.7}, np.array([1.0]), {}, 200, 0.1),
        "exchanger": Case(EXCHANGER, coefficients, np.array([2000.0, 2000.0]), flight, 200, 1.0),
        "damper": Case(damper, spring, WRONG_GUESS.mean, {"force_n": force_n()}, N_SAMPLES, DT_S),
    }


def scipy_pair(case: Case, problem: Problem) -> Array:
    """Fit by `solve_ivp`, over stretches of constant inputs, and `least_squares`. (n,)"""
    model = case.model
    assert model.rates is not None
    stretches = range(case.n_samples - 1) if case.inputs else range(1)
    n_steps = 1 if case.inputs else case.n_samples - 1
    time_s = case.dt_s * np.arange(n_steps + 1)

    def residual(theta: Array) -> Array:
        constants = model.nominal | dict(zip(case.truth, theta.tolist(), strict=True))
        x = [[state.initial] for state in model.states]
        for k in stretches:
            known = constants | {name: float(signal[k]) for name, signal in case.inputs.items()}
            rates = partial(_rates, model, known)
            start = [values[-1] for values in x]
            later = solve_ivp(rates, (0.0, time_s[-1]), start, t_eval=time_s[1:], rtol=RTOL, atol=RTOL).y
            x = [values + more.tolist() for values, more in zip(x, later, strict=True)]
        states = dict(zip((state.name for state in model.states), np.array(x), strict=True))
        outputs = as_tuple(model.equations(**constants, **case.inputs, **states))
        return np.asarray((np.column_stack(outputs) - problem.measured) / problem.sigma).ravel()

    return np.asarray(least_squares(residual, problem.origin, bounds=problem.bounds.T, x_scale="jac").x)


def _rates(model: PhysicsModel, known: dict[str, float], _time_s: float, x: Array) -> tuple[float, ...]:
    assert model.rates is not None
    first, second = model.states
    position, speed = x.tolist()
    return model.rates(**known, **{first.name: position, second.name: speed})  # type: ignore[no-any-return]


def main(
    rounds: int = 3,
    models: tuple[str, ...] = ("van_der_pol", "exchanger", "damper"),
    methods: tuple[str, ...] = ("nls", "ekf", "ukf", "pso", "pinn"),
) -> Texts:
    """Fit each model by each method with numba and without, and by SciPy's pair, in turn."""
    head = ["model", "who", "with numba, CPU [ms]", "ratio", "without, CPU [ms]", "ratio", "status", "off SciPy's [sd]"]
    rows = [head]
    with threadpool_limits(1):
        for name in models:
            rows += _rows(cases()[name], methods, rounds)
    goals = ", ".join(f"{goal:g} x {form}" for form, goal in GOALS.items())
    note = f"Goals of `nls`: {goals}. {timing.machine(('numpy', 'numba', 'scipy'))}"
    yield "speed of declared states", f"{markdown(rows)}\n\n{note}"


def _rows(case: Case, methods: tuple[str, ...], rounds: int) -> list[list[str]]:
    problems = {form: case.problem(compiled=form == "with numba") for form in GOALS}
    answers: dict[tuple[str, str], Estimate] = {}
    fitted: list[Array] = []
    quick: dict[str, Callable[[], object]] = {"SciPy": lambda: fitted.append(scipy_pair(case, problems["without"]))}
    slow: dict[str, Callable[[], object]] = {}
    for method in methods:
        for form, problem in problems.items():
            contestants = slow if method in SLOW else quick
            contestants[f"{method} {form}"] = partial(_estimate, answers, (method, form), problem)
    estimators()["nls"].estimate(problems["with numba"])  # compiles
    seconds = best_cpu_s(quick, rounds) | best_cpu_s(slow, 1)
    lines = [
        [case.model.name, "`solve_ivp`, `least_squares`", "-", "-", f"{1e3 * seconds['SciPy']:.3g}", "-", "-", "-"]
    ]
    for method in methods:
        cells = ["", method]
        for form in GOALS:
            own_s = seconds[f"{method} {form}"]
            cells += [f"{1e3 * own_s:.3g}", timing.times(seconds["SciPy"] / own_s)]
        estimate = answers[method, "with numba"]
        off = np.abs(estimate.belief.mean - fitted[-1]) / answers[methods[0], "with numba"].belief.sd
        lines.append([*cells, f"`{estimate.status}`", f"{off.max():.1g}"])
    return lines


def _estimate(answers: dict[tuple[str, str], Estimate], key: tuple[str, str], problem: Problem) -> None:
    answers[key] = estimators()[key[0]].estimate(problem)


if __name__ == "__main__":
    run(main)
