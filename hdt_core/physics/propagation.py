"""A linear system of two states, one step later: x' = A x with A = [[p, q], [r, s]], held over the step.

Each function returns the four entries of the matrix that the state is multiplied by, row by row.
"""

import numpy as np

from hdt_core.physics.model import Array

Factors = tuple[Array, Array, Array, Array]


def exact_factors(p: Array, q: Array, r: Array, s: Array, dt_s: float) -> Factors:
    """exp([[p, q], [r, s]] dt): the eigenvalues are real and below 0, so only decaying exponentials appear."""
    half_spread = np.sqrt(0.25 * (p - s) ** 2 + q * r)
    slow, fast = np.exp((0.5 * (p + s) + half_spread) * dt_s), np.exp((0.5 * (p + s) - half_spread) * dt_s)
    mean = 0.5 * (slow + fast)
    lean = np.where(
        half_spread == 0.0, dt_s * mean, 0.5 * (slow - fast) / np.where(half_spread == 0.0, 1.0, half_spread)
    )
    return mean + 0.5 * (p - s) * lean, q * lean, r * lean, mean - 0.5 * (p - s) * lean


def tustin_factors(p: Array, q: Array, r: Array, s: Array, dt_s: float) -> Factors:
    """(I - A dt/2)^-1 (I + A dt/2): stable at any step, but it rings where the step exceeds the time constants."""
    p, q, r, s = (0.5 * dt_s * x for x in (p, q, r, s))
    det = (1.0 - p) * (1.0 - s) - q * r
    return ((1.0 - s) * (1.0 + p) + q * r) / det, 2.0 * q / det, 2.0 * r / det, ((1.0 - p) * (1.0 + s) + q * r) / det


def euler_factors(p: Array, q: Array, r: Array, s: Array, dt_s: float) -> Factors:
    """I + A dt: stable only where the step is well below the fastest time constant."""
    return 1.0 + p * dt_s, q * dt_s, r * dt_s, 1.0 + s * dt_s
