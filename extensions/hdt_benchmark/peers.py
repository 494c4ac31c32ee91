"""Comparisons of this installation with named peers on the same work.

The peers are written as their users write them: the oscillator's Euler loop in plain floats for SciPy, the filter of
filterpy stepped in a Python loop, SciPy's root search a sample a call.
"""

from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.optimize import brentq, least_squares

from hdt_benchmark.spring_mass_damper import DT_S, SIGMA_M, force_n, oscillator_problem
from hdt_benchmark.timing import Candidate, Claim, race
from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares, Problem, unknown
from hdt_core.physics.effectiveness import crossflow_effectiveness
from hdt_core.physics.heat_exchanger import capacity_rates, measured_conductance_w_k, outlets_k

Fit = Callable[[Problem], np.ndarray]
PACKAGES = ("numpy", "numba", "scipy", "filterpy")
SAMPLES, PEER_SAMPLES = 100_000, 200
REPEATS = 20
"""Times that ours is repeated a round: once lasts less than the caches take to fill after a peer."""


def installed(rounds: int = 5, records: int = 2) -> list[Claim]:
    """Run short comparisons: a fit, a filter, the conductances of a fleet's samples."""
    return [fit_claim(rounds, records), filter_claim(rounds, records), conductance_claim(rounds)]


def fit_claim(rounds: int, records: int) -> Claim:
    """Compare least squares on the oscillator: same start, same bounds, no prior.

    SciPy's own stop leaves a few 1e-7: how far apart the optima are shows in the last line, tolerances tightened.
    """
    problems = [p.with_prior(unknown(p.prior.mean)) for p in (oscillator_problem(seed) for seed in range(records))]
    return race(
        "NLS fit, 1,001 samples",
        {
            "ours": over(problems * REPEATS, lambda p: NonlinearLeastSquares().estimate(p).belief.mean),
            "SciPy trf with bounds, plain-float loop": over(problems, lambda p: _scipy_fit(p, "trf")),
            "SciPy lm without bounds, plain-float loop": over(problems, lambda p: _scipy_fit(p, "lm")),
            "SciPy trf, tolerances of 1e-14": over(problems, lambda p: _scipy_fit(p, "trf", tolerance=1e-14)),
        },
        rounds,
        goals={"SciPy trf with bounds, plain-float loop": 130.0, "SciPy lm without bounds, plain-float loop": 100.0},
    )


def filter_claim(rounds: int, records: int) -> Claim:
    """Compare one pass of the extended Kalman filter over states and parameters, no smoother on either side."""
    problems = [oscillator_problem(seed) for seed in range(records)]
    ours = ExtendedKalman(smoother_passes=0)
    peer = "filterpy in a Python loop"
    return race(
        "EKF, one pass, 1,001 samples",
        {"ours": over(problems * REPEATS, lambda p: ours.estimate(p).belief.mean), peer: over(problems, _filterpy)},
        rounds,
        goals={peer: 100.0},
    )


def conductance_claim(rounds: int, n: int = SAMPLES) -> Claim:
    """Compare UA of steady samples from flows and temperatures, as every night computes it: losses of 0 to 40 %."""
    rng = np.random.default_rng(1)
    flows = 0.9 * rng.lognormal(0.0, 0.06, n), 1.6 * rng.lognormal(0.0, 0.2, n)
    hot_in_k = 390.0 + 5.0 * rng.normal(size=n)
    cold_in_k = 250.0 + 3.0 * rng.normal(size=n)
    hot_out_k = outlets_k(*flows, hot_in_k, cold_in_k, np.linspace(1500.0, 900.0, n))[0] + 0.5 * rng.normal(size=n)
    samples = np.array([*flows, hot_in_k, hot_out_k, cold_in_k])
    runs = {
        "ours, batched": Candidate(lambda: measured_conductance_w_k(*samples), n),
        "SciPy brentq, a sample a call": Candidate(
            lambda: np.array([_scipy_conductance_w_k(sample) for sample in samples[:, :PEER_SAMPLES].T]),
            PEER_SAMPLES,
        ),
    }
    return race("cross-flow UA of a sample", runs, rounds)


def over(problems: list[Problem], fit: Fit) -> Candidate:
    """Fit all records in turn."""
    return Candidate(lambda: np.array([fit(problem) for problem in problems]), len(problems))


def _scipy_fit(problem: Problem, method: str, tolerance: float = 1e-8) -> np.ndarray:
    force = force_n().tolist()
    measured = problem.measured[:, 0].tolist()

    def residual(theta: np.ndarray) -> np.ndarray:
        damping = float(theta[0])
        stiffness = float(theta[1])
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
    force = force_n()
    measured = problem.measured
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


def _scipy_conductance_w_k(sample: np.ndarray) -> float:
    rate_w_k, ratio = capacity_rates(*sample)
    _, _, hot_in_k, hot_out_k, cold_in_k = sample
    effectiveness = (hot_in_k - hot_out_k) / (hot_in_k - cold_in_k)
    ntu = brentq(lambda n: crossflow_effectiveness(n, n * ratio) - effectiveness, 1e-6, 60.0, xtol=1e-12)
    return float(ntu * rate_w_k)
