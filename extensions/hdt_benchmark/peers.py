"""Comparisons of this installation with named peers on the same work.

The peers are written as their users write them: the oscillator's Euler loop in plain floats for SciPy, the filter of
filterpy stepped in a Python loop, SciPy's Levenberg-Marquardt a flight a call.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.optimize import least_squares

from hdt_benchmark.exchanger import ExchangerSamples, fit_conductance_scale
from hdt_benchmark.oscillator import DT_S, SIGMA_M, force_n, oscillator_problem
from hdt_benchmark.timing import Candidate, Claim, race
from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares, Problem, unknown
from hdt_core.physics.effectiveness import crossflow_effectiveness
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER, capacity_rates, clean_conductance_w_k, outlets_k

Fit = Callable[[Problem], np.ndarray]
PACKAGES = ("numpy", "numba", "scipy", "filterpy")
POINTS, FLIGHTS, PEER_FLIGHTS = 30, 20000, 40
SCIPY = "SciPy lm, vectorised model, a flight a call"


def installed(rounds: int = 5, records: int = 2, n_flights: int = 4000) -> list[Claim]:
    """Run short comparisons: a fit, a filter, a fleet of exchangers."""
    return [fit_claim(rounds, records), filter_claim(rounds, records), conductance_claim(rounds, n_flights)]


def fit_claim(rounds: int, records: int) -> Claim:
    """Compare least squares on the oscillator: same start, same bounds, no prior.

    SciPy's own stop leaves a few 1e-7: how far apart the optima are shows in the last line, tolerances tightened.
    """
    problems = [p.with_prior(unknown(p.prior.mean)) for p in (oscillator_problem(seed) for seed in range(records))]
    return race(
        "NLS fit, 1,001 samples",
        {
            "ours": over(problems, lambda p: NonlinearLeastSquares().estimate(p).belief.mean),
            "SciPy trf with bounds, plain-float loop": over(problems, lambda p: _scipy_fit(p, "trf")),
            "SciPy lm without bounds, plain-float loop": over(problems, lambda p: _scipy_fit(p, "lm")),
            "SciPy trf, tolerances of 1e-14": over(problems, lambda p: _scipy_fit(p, "trf", tolerance=1e-14)),
        },
        rounds,
        goals={"SciPy trf with bounds, plain-float loop": 130.0, "SciPy lm without bounds, plain-float loop": 100.0},
    )


def filter_claim(rounds: int, records: int) -> Claim:
    """Compare one pass of the extended Kalman filter over states and parameters, no smoother on either side."""
    problems, ours = [oscillator_problem(seed) for seed in range(records)], ExtendedKalman(smoother_passes=0)
    peer = "filterpy in a Python loop"
    return race(
        "EKF, one pass, 1,001 samples",
        {"ours": over(problems, lambda p: ours.estimate(p).belief.mean), peer: over(problems, _filterpy)},
        rounds,
        goals={peer: 100.0},
    )


def conductance_claim(rounds: int, n_flights: int = FLIGHTS) -> Claim:
    """Compare the health of a fleet: ln UA over clean UA, exact cross-flow effectiveness."""
    samples, clean = snapshots(n_flights, POINTS)
    runs = {
        "ours, batched": Candidate(lambda: fit_conductance_scale(samples, clean).mean, n_flights),
        SCIPY: Candidate(lambda: _scipy_conductance(samples, clean, PEER_FLIGHTS), PEER_FLIGHTS),
    }
    return race("cross-flow UA, 30 points a flight", runs, rounds, per_second=1e6)


def over(problems: list[Problem], fit: Fit) -> Candidate:
    """Fit all records in turn."""
    return Candidate(lambda: np.array([fit(problem) for problem in problems]), len(problems))


def snapshots(n_flights: int, points: int) -> tuple[ExchangerSamples, np.ndarray]:
    """Simulate a fleet's cruise snapshots: cross-flow truth, losses of 0 to 40 %, 0.5 K noise."""
    rng = np.random.default_rng(1)
    n = n_flights * points

    def spread(mean: float, between: float, within: float) -> np.ndarray:
        return np.repeat(mean * (1.0 + between * rng.normal(size=n_flights)), points) * (
            1.0 + within * rng.normal(size=n)
        )

    hot, ram = spread(0.9, 0.06, 0.01), np.maximum(spread(1.6, 0.2, 0.05), 0.4)
    hot_in, cold_in = spread(390.0, 0.01, 0.004), spread(250.0, 0.01, 0.002)
    design: dict[str, Any] = {p.name: p.nominal for p in HEAT_EXCHANGER.free("design")}
    clean = clean_conductance_w_k(hot, ram, **design)
    loss = np.repeat(np.linspace(0.0, 0.4, n_flights), points)
    hot_out = outlets_k(hot, ram, hot_in, cold_in, (1.0 - loss) * clean)[0] + 0.5 * rng.normal(size=n)
    starts = np.arange(n_flights + 1) * points
    return ExchangerSamples(hot, ram, hot_in, hot_out, cold_in, np.full(n, 4.0), starts), clean


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


def _misses_k(
    theta: np.ndarray, clean_ntu: np.ndarray, ratio: np.ndarray, span_k: np.ndarray, cooled_k: np.ndarray
) -> np.ndarray:
    """Compute twice the excess of the modelled cooling at each sample; theta is ln UA over clean UA. [K]"""
    ntu = np.exp(theta[0]) * clean_ntu
    return np.asarray(2.0 * (span_k * crossflow_effectiveness(ntu, ntu * ratio) - cooled_k))


def _scipy_conductance(samples: ExchangerSamples, clean: np.ndarray, n_flights: int) -> np.ndarray:
    """ln UA over clean UA, a flight at a time, MINPACK's Levenberg-Marquardt over the vectorised model."""
    estimates = []
    for f in range(n_flights):
        at = slice(samples.starts[f], samples.starts[f + 1])
        hot_flow, ram_flow, hot_in, hot_out, cold_in, _ = (column[at] for column in samples.columns())
        rate, ratio = capacity_rates(hot_flow, ram_flow, hot_in, hot_out, cold_in)
        arguments = clean[at] / rate, ratio, hot_in - cold_in, hot_in - hot_out
        estimates.append(least_squares(_misses_k, [0.0], args=arguments, method="lm", xtol=1e-10, ftol=1e-12).x[0])
    return np.array(estimates)
