"""Heat exchanger fits against SciPy, in one run: `python -m benchmarks.heat_exchanger [--rounds N] [--write]`.

Claims: 1,000,000 snapshot fits a second and core (30 points a flight); a 3,600-sample log fitted 200 times faster than
by `scipy.optimize.least_squares` over a plain-float Python loop and 5 times faster than by MINPACK over a compiled
simulation; the same answers to 1e-6. Contestants take turns on one core; medians of the rounds, compiling left out.
``--write`` puts the table into docs/benchmark.md.
"""

from __future__ import annotations

from collections.abc import Callable

import ht
import numpy as np
from numba import njit
from scipy.optimize import least_squares

from benchmarks.harness import Texts, race_table, run
from hdt_benchmark.exchanger import ExchangerSamples, fit_lumped_log
from hdt_benchmark.peers import conductance_claim
from hdt_benchmark.timing import Candidate, Claim, race
from hdt_core.physics.effectiveness import crossflow_effectiveness
from hdt_core.physics.heat_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K
from hdt_core.physics.lumped_exchanger import lumped_exchanger, steady_outlets_k

SECONDS, MASS_KG = 3600, 8.0
NOMINAL_H_W_K = 2500.0
MINPACK, LOOP = "SciPy lm over a numba simulation", "SciPy lm over a plain-float loop"


def log() -> ExchangerSamples:
    """One cruise at 1 Hz with four door steps: equations (7)-(8), H 2300 W/K, 8 kg a side, 0.5 K noise."""
    t, rng = np.arange(SECONDS), np.random.default_rng(2)
    hot = 0.9 * (1.0 + 0.02 * np.sin(t / 300.0))
    ram = 1.6 * (1.0 + 0.05 * np.sin(t / 111.0) + 0.15 * ((t // 720) % 2))
    hot_in, cold_in = 390.0 + 3.0 * np.sin(t / 200.0), 250.0 + np.cos(t / 500.0)
    inputs = {"hot_flow_kg_s": hot, "ram_flow_kg_s": ram, "hot_in_k": hot_in, "cold_in_k": cold_in}
    h = {"hx_h_hot_w_k": 2300.0, "hx_h_cold_w_k": 2300.0}
    first = steady_outlets_k(**{k: v[0] for k, v in inputs.items()}, **h)
    states = dict(zip(("hot_volume_k", "cold_volume_k"), first, strict=True))
    masses = {"hx_mass_hot_kg": MASS_KG, "hx_mass_cold_kg": MASS_KG}
    hot_out = lumped_exchanger("tustin").simulate(h | masses, inputs, 1.0, states)["hot_out_k"]
    noisy = hot_out + 0.5 * rng.normal(size=SECONDS)
    return ExchangerSamples(hot, ram, hot_in, noisy, cold_in, np.full(SECONDS, 4.0), np.array([0, SECONDS]))


def march(h, hot_flow, ram_flow, hot_in, cold_in, outlet):
    """Equations (7)-(8) by Tustin's rule, plain floats: what the peers simulate."""
    a, b = h / (hot_flow[0] * CP_HOT_J_KG_K), h / (ram_flow[0] * CP_COLD_J_KG_K)
    span = (hot_in[0] - cold_in[0]) / (1.0 + a + b)
    hot, cold = hot_in[0] - a * span, cold_in[0] + b * span
    q, r = 0.5 * h / (MASS_KG * CP_HOT_J_KG_K), 0.5 * h / (MASS_KG * CP_COLD_J_KG_K)
    for k in range(len(hot_flow)):
        outlet[k] = hot
        a, c = 0.5 * hot_flow[k] / MASS_KG, 0.5 * ram_flow[k] / MASS_KG
        right_hot = (1.0 - a - q) * hot + q * cold + 2.0 * a * hot_in[k]
        right_cold = r * hot + (1.0 - c - r) * cold + 2.0 * c * cold_in[k]
        over = 1.0 / ((1.0 + a + q) * (1.0 + c + r) - q * r)
        hot, cold = (
            ((1.0 + c + r) * right_hot + q * right_cold) * over,
            (r * right_hot + (1.0 + a + q) * right_cold) * over,
        )
    return outlet


def scipy_log(samples: ExchangerSamples, simulate: Callable, columns: list) -> float:
    """Fit ln H by SciPy over a simulation of the log."""

    def residuals(theta):
        return 2.0 * (samples.hot_out_k - np.asarray(simulate(float(np.exp(theta[0])), *columns)))

    return float(least_squares(residuals, [np.log(NOMINAL_H_W_K)], method="lm").x[0])


def log_claim(rounds: int) -> Claim:
    """The paper's equations with their dynamics: ln H of one log."""
    samples = log()
    inputs = samples.hot_flow_kg_s, samples.ram_flow_kg_s, samples.hot_in_k, samples.cold_in_k
    lists, outlet = [*(x.tolist() for x in inputs), [0.0] * SECONDS], np.empty(SECONDS)
    compiled = njit(march)
    runs = {
        "ours, compiled, derivatives carried along": Candidate(
            lambda: repeated(50, lambda: fit_lumped_log(samples, 1.0, MASS_KG, MASS_KG).mean[0]), 50
        ),
        MINPACK: Candidate(lambda: repeated(20, lambda: scipy_log(samples, compiled, [*inputs, outlet])), 20),
        LOOP: Candidate(lambda: repeated(1, lambda: scipy_log(samples, march, lists))),
    }
    return race("equations (7)-(8) at 1 Hz, 3,600 samples", runs, rounds, goals={MINPACK: 5.0, LOOP: 200.0})


def effectiveness_claim(rounds: int) -> Claim:
    """Mason's series against quadrature."""
    ntu, ratio = np.random.default_rng(3).uniform(0.2, 4.0, 20000), np.random.default_rng(4).uniform(0.3, 1.0, 20000)

    def by_ht() -> np.ndarray:
        pairs = zip(ntu[:100], ratio[:100], strict=True)
        return np.array([ht.effectiveness_from_NTU(n, c, subtype="crossflow") for n, c in pairs])

    runs = {
        "ours, Mason's series, NumPy": Candidate(lambda: crossflow_effectiveness(ntu, ntu * ratio), ntu.size),
        "ht, quadrature": Candidate(by_ht, 100),
    }
    return race("cross-flow effectiveness", runs, rounds)


def repeated(n: int, fit: Callable[[], float]) -> np.ndarray:
    """Fit n times over: one is too short to time."""
    return np.array([fit() for _ in range(n)])


def main(rounds: int = 7) -> Texts:
    """All claims."""
    claims = (conductance_claim, log_claim, effectiveness_claim)
    yield "speed of heat exchanger", race_table([claim(rounds) for claim in claims], ("numpy", "numba", "scipy", "ht"))


if __name__ == "__main__":
    run(main)
