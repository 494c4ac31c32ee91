"""Speed of the estimators against named peers that do the same work, contestants taking turns in one run.

Run ``python -m benchmarks.estimators [--rounds N] [--write]``. Each claim prints medians of processor time on one
thread, ratios, and how far the answers are apart; ``--write`` puts the table into docs/benchmark.md. The peers are
written as their users write them: the oscillator's Euler loop in plain floats for SciPy, the filter of filterpy stepped
in a Python loop, pyswarms with a cost that steps all particles at once in NumPy. pyswarms comes with the extra
`benchmark`; where it is absent that claim is skipped.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.optimize import least_squares

from benchmarks.race import Claim, Contestant, race, table, write
from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares, ParticleSwarm, Problem, unknown
from hdt_core.estimation.oscillator import DT_S, SIGMA_M, force_n, oscillator_problem

Fit = Callable[[Problem], np.ndarray]


def main(rounds: int = 15, records: int = 8) -> list[Claim]:
    """All claims, each over the same records in blocks."""
    claims = [fit_claim(rounds, records), filter_claim(rounds, records)]
    try:
        claims.append(swarm_claim(max(rounds // 3, 3), 2))
    except ImportError:
        print("PSO against pyswarms: skipped, pyswarms is not installed (pip install -e '.[benchmark]')")
    return claims


def fit_claim(rounds: int, records: int) -> Claim:
    """Least squares on the oscillator: same start, same bounds, no prior.

    SciPy's own stop leaves a few 1e-7: how far apart the optima are shows in the last line, tolerances tightened.
    """
    problems = [p.with_prior(unknown(p.prior.mean)) for p in (oscillator_problem(seed) for seed in range(records))]
    return race(
        "NLS fit, 1,001 samples",
        {
            "ours": _over(problems, lambda p: NonlinearLeastSquares().estimate(p).belief.mean),
            "SciPy trf with bounds, plain-float loop": _over(problems, lambda p: _scipy_fit(p, "trf")),
            "SciPy lm without bounds, plain-float loop": _over(problems, lambda p: _scipy_fit(p, "lm")),
            "SciPy trf, tolerances of 1e-14": _over(problems, lambda p: _scipy_fit(p, "trf", tolerance=1e-14)),
        },
        rounds,
        goals=dict.fromkeys(
            ("SciPy trf with bounds, plain-float loop", "SciPy lm without bounds, plain-float loop"), 130.0
        ),
    )


def filter_claim(rounds: int, records: int) -> Claim:
    """One pass of the extended Kalman filter over states and parameters, no smoother on either side."""
    problems, ours = [oscillator_problem(seed) for seed in range(records)], ExtendedKalman(smoother_passes=0)
    peer = "filterpy in a Python loop"
    return race(
        "EKF, one pass, 1,001 samples",
        {"ours": _over(problems, lambda p: ours.estimate(p).belief.mean), peer: _over(problems, _filterpy)},
        rounds,
        goals={peer: 100.0},
    )


def swarm_claim(rounds: int, records: int) -> Claim:
    """30 particles, 100 iterations, the same coefficients and bounds."""
    import pyswarms  # noqa: F401, PLC0415 (only with the extra)

    logging.disable(logging.INFO)
    problems, swarm = [oscillator_problem(seed) for seed in range(records)], ParticleSwarm(polish=False)
    return race(
        "PSO, 30 particles, 100 iterations",
        {
            "ours": _over(problems, lambda p: swarm.estimate(p).belief.mean),
            "pyswarms, cost in NumPy": _over(problems, lambda p: _pyswarms(p, _numpy_cost)),
            "pyswarms, our compiled cost": _over(problems, lambda p: _pyswarms(p, lambda q, t: q.objective(t))),
        },
        rounds,
        goals={"pyswarms, cost in NumPy": 30.0},
    )


def _over(problems: list[Problem], fit: Fit) -> Contestant:
    return Contestant(lambda: np.array([fit(problem) for problem in problems]), len(problems))


def _scipy_fit(problem: Problem, method: str, tolerance: float = 1e-8) -> np.ndarray:
    force, measured = force_n().tolist(), problem.measured[:, 0].tolist()

    def residual(theta: np.ndarray) -> np.ndarray:
        damping, stiffness = float(theta[0]), float(theta[1])
        x = v = 0.0
        out = []
        for f, y in zip(force, measured, strict=True):
            out.append((x - y) / SIGMA_M)
            x, v = x + DT_S * v, v + DT_S * (f - damping * v - stiffness * x)
        return np.array(out)

    limits = {} if method == "lm" else {"bounds": problem.bounds.T}
    stop = {"xtol": tolerance, "ftol": tolerance, "gtol": tolerance}
    return np.asarray(least_squares(residual, problem.origin, method=method, **limits, **stop).x)


def _filterpy(problem: Problem) -> np.ndarray:
    force, measured = force_n(), problem.measured
    peer = ExtendedKalmanFilter(dim_x=4, dim_z=1)
    peer.x = np.concatenate([np.zeros(2), problem.prior.mean])
    peer.P = np.zeros((4, 4))
    peer.P[2:, 2:] = problem.prior.cov
    peer.R = np.array([[SIGMA_M**2]])
    peer.Q = np.zeros((4, 4))
    h = np.array([[1.0, 0.0, 0.0, 0.0]])
    for i in range(len(measured)):
        peer.update(measured[i], lambda _x: h, lambda x: x[:1])
        x, v, c, k = peer.x
        if i + 1 < len(measured):
            peer.F = np.array(
                [[1, DT_S, 0, 0], [-DT_S * k, 1 - DT_S * c, -DT_S * v, -DT_S * x], [0, 0, 1, 0], [0, 0, 0, 1]]
            )
            peer.x = np.array([x + DT_S * v, v + DT_S * (force[i] - c * v - k * x), c, k])
            peer.P = peer.F @ peer.P @ peer.F.T + peer.Q
    return np.asarray(peer.x[2:])


def _pyswarms(problem: Problem, cost: Callable[[Problem, np.ndarray], np.ndarray]) -> np.ndarray:
    from pyswarms.single import GlobalBestPSO  # noqa: PLC0415 (only with the extra)

    settings = ParticleSwarm()
    options = {"c1": settings.cognitive, "c2": settings.social, "w": settings.inertia}
    np.random.seed(0)  # noqa: NPY002 (pyswarms draws from the global generator)
    peer = GlobalBestPSO(settings.n_particles, 2, options, bounds=(problem.bounds[:, 0], problem.bounds[:, 1]))
    _, best = peer.optimize(lambda thetas: cost(problem, thetas), settings.n_iterations, verbose=False)
    return np.asarray(best)


def _numpy_cost(problem: Problem, thetas: np.ndarray) -> np.ndarray:
    x, v, total = np.zeros(len(thetas)), np.zeros(len(thetas)), np.zeros(len(thetas))
    damping, stiffness = thetas.T
    for f, y in zip(force_n(), problem.measured[:, 0], strict=True):
        total += ((x - y) / SIGMA_M) ** 2
        x, v = x + DT_S * v, v + DT_S * (f - damping * v - stiffness * x)
    return total


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--write", action="store_true", help="update docs/benchmark.md")
    given = parser.parse_args()
    report = table(main(given.rounds), ("numpy", "numba", "scipy", "filterpy", "pyswarms"))
    print(report)
    if given.write:
        write("speed of estimators", report)
