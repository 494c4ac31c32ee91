"""Speed of estimators and exchanger against named peers that do the same work, contestants taking turns in one run.

Run ``python -m benchmarks.estimators [--rounds N] [--write]``. Each claim prints medians of processor time on one
thread, ratios, and how far the answers are apart; ``--write`` puts the table into docs/benchmark.md. The peers are
written as their users write them: the oscillator's Euler loop in plain floats for SciPy, the filter of filterpy stepped
in a Python loop, pyswarms with a cost that steps all particles at once in NumPy. pyswarms comes with the extra
`benchmark`; where it is absent that claim is skipped.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import ht
import numpy as np

from benchmarks.harness import Texts, race_table, run
from hdt_benchmark.peers import conductance_claim, filter_claim, fit_claim, over
from hdt_benchmark.spring_mass_damper import DT_S, SIGMA_M, force_n, oscillator_problem
from hdt_benchmark.timing import Candidate, Claim, race
from hdt_core.estimation import ParticleSwarm, Problem
from hdt_core.physics.effectiveness import crossflow_effectiveness


def main(rounds: int = 15, records: int = 8) -> Texts:
    """All claims, each over the same records in blocks."""
    claims = [fit_claim(rounds, records), filter_claim(rounds, records)]
    try:
        claims.append(swarm_claim(max(rounds // 3, 3), 2))
    except ImportError:
        print("PSO against pyswarms: skipped, pyswarms is not installed (pip install -e '.[benchmark]')")
    yield "speed of estimators", race_table(claims, ("numpy", "numba", "scipy", "filterpy", "pyswarms"))
    exchanger = [conductance_claim(rounds), effectiveness_claim(rounds)]
    yield "speed of heat exchanger", race_table(exchanger, ("numpy", "scipy", "ht"))


def swarm_claim(rounds: int, records: int) -> Claim:
    """30 particles, 100 iterations, the same coefficients and bounds."""
    import pyswarms  # noqa: F401, PLC0415 (only with the extra)

    logging.disable(logging.INFO)
    problems = [oscillator_problem(seed) for seed in range(records)]
    swarm = ParticleSwarm(polish=False)
    return race(
        "PSO, 30 particles, 100 iterations",
        {
            "ours": over(problems, lambda p: swarm.estimate(p).belief.mean),
            "pyswarms, cost in NumPy": over(problems, lambda p: _pyswarms(p, _numpy_cost)),
            "pyswarms, our compiled cost": over(problems, lambda p: _pyswarms(p, lambda q, t: q.objective(t))),
        },
        rounds,
        goals={"pyswarms, cost in NumPy": 30.0},
    )


def effectiveness_claim(rounds: int) -> Claim:
    """Mason's series against quadrature."""
    ntu = np.random.default_rng(3).uniform(0.2, 4.0, 20000)
    ratio = np.random.default_rng(4).uniform(0.3, 1.0, 20000)

    def by_ht() -> np.ndarray:
        pairs = zip(ntu[:100], ratio[:100], strict=True)
        return np.array([ht.effectiveness_from_NTU(n, c, subtype="crossflow") for n, c in pairs])

    ours = Candidate(lambda: crossflow_effectiveness(ntu, ntu * ratio), ntu.size)
    runs = {"ours, Mason's series, NumPy": ours, "ht, quadrature": Candidate(by_ht, 100)}
    return race("cross-flow effectiveness", runs, rounds)


def _pyswarms(problem: Problem, cost: Callable[[Problem, np.ndarray], np.ndarray]) -> np.ndarray:
    from pyswarms.single import GlobalBestPSO  # noqa: PLC0415 (only with the extra)

    settings = ParticleSwarm()
    options = {"c1": settings.cognitive, "c2": settings.social, "w": settings.inertia}
    np.random.seed(0)  # noqa: NPY002 (pyswarms draws from the global generator)
    peer = GlobalBestPSO(settings.n_particles, 2, options, bounds=(problem.bounds[:, 0], problem.bounds[:, 1]))
    _, best = peer.optimize(lambda thetas: cost(problem, thetas), settings.n_iterations, verbose=False)
    return np.asarray(best)


def _numpy_cost(problem: Problem, thetas: np.ndarray) -> np.ndarray:
    x = np.zeros(len(thetas))
    v = np.zeros(len(thetas))
    total = np.zeros(len(thetas))
    damping, stiffness = thetas.T
    for f, y in zip(force_n(), problem.measured[:, 0], strict=True):
        total += ((x - y) / SIGMA_M) ** 2
        x, v = x + DT_S * v, v + DT_S * (f - damping * v - stiffness * x)
    return total


if __name__ == "__main__":
    run(main)
