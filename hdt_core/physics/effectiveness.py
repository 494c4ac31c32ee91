"""How well an exchanger exchanges: effectiveness from transfer units, and back.

A side's effectiveness is its temperature change over the difference of the inlet temperatures, and its transfer units
are UA over its own heat-capacity rate; neither needs to know which side is the smaller.
"""

import numpy as np

from hdt_core.physics.model import Array

SERIES_TOLERANCE = 1e-16
MAX_TERMS = 400
MAX_NEWTON_STEPS = 60


def counterflow_effectiveness(ntu: Array, c_ratio: Array) -> Array:
    r"""Effectiveness of a counterflow exchanger: the best there is. [-]

    Parameters
    ----------
    ntu : array
        UA over the smaller heat-capacity rate. [-], >= 0
    c_ratio : array
        Smaller over larger heat-capacity rate. [-], 0 to 1

    Notes
    -----
    .. math:: \varepsilon = \frac{1 - e^{-N(1-C_r)}}{1 - C_r e^{-N(1-C_r)}}, \quad N / (1 + N) \text{ where } C_r = 1

    References
    ----------
    .. [1] W. M. Kays and A. L. London, Compact Heat Exchangers, 3rd ed., 1984, table 2-2.

    Examples
    --------
    >>> round(float(counterflow_effectiveness(np.float64(2.0), np.float64(0.5))), 6)
    0.7746
    >>> round(float(counterflow_effectiveness(np.float64(2.0), np.float64(1.0))), 6)
    0.666667
    """
    exponent = ntu * (1.0 - c_ratio)
    # (1 - e^-x) / x, which is 1 where the two heat-capacity rates are equal
    mean_decay = np.where(exponent == 0.0, 1.0, -np.expm1(-exponent) / np.where(exponent == 0.0, 1.0, exponent))
    return ntu * mean_decay / (np.exp(-exponent) + ntu * mean_decay)


def crossflow_effectiveness(ntu_this: Array, ntu_other: Array) -> Array:
    r"""Effectiveness, on this side, of a cross-flow exchanger with both streams unmixed. [-]

    Parameters
    ----------
    ntu_this, ntu_other : array
        UA over the heat-capacity rate of this and of the other side. [-], >= 0

    Returns
    -------
    array
        Temperature change of this side over the difference of the inlet temperatures. With `ntu_this` the larger it is
        the textbook's effectiveness, and ``ntu_other / ntu_this`` its ratio of heat-capacity rates.

    Notes
    -----
    Mason's series, exact; P is the regularised incomplete gamma function, which a recurrence gives for two exponentials
    in all:

    .. math:: \varepsilon = \frac{1}{b} \sum_{n=0}^\infty P(n+1, a) \, P(n+1, b)

    The handbook's one-line formula (`crossflow_effectiveness_approximate`) is off by up to 0.020.

    References
    ----------
    .. [1] J. L. Mason, Heat transfer in crossflow, Proc. 2nd U.S. National Congress of Applied Mechanics, 801, 1955.
    .. [2] R. K. Shah and D. P. Sekulic, Fundamentals of Heat Exchanger Design, 2003, table 3.6.

    Examples
    --------
    >>> round(float(crossflow_effectiveness(np.float64(1.5), np.float64(1.05))), 9)
    0.617790718
    """
    return crossflow_effectiveness_and_slope(ntu_this, ntu_other)[0]


def crossflow_effectiveness_and_slope(ntu_this: Array, ntu_other: Array) -> tuple[Array, Array]:
    """Effectiveness on this side and its derivative by ln UA, which moves both numbers of transfer units together.

    Parameters and source as in `crossflow_effectiveness`. The derivative of P(n+1, x) by x is x^n e^-x / n!.
    """
    a, b = np.broadcast_arrays(ntu_this, ntu_other)
    term_a, term_b = np.exp(-a), np.exp(-b)
    p_a = -np.expm1(-a)
    q_b = np.where(b == 0.0, 1.0, -np.expm1(-b) / np.where(b == 0.0, 1.0, b))  # P(n+1, b) / b
    fewest = np.fmax.reduce(np.fmin(np.real(a), np.real(b)), axis=None, initial=0.0)
    total = np.zeros(np.broadcast(a, b).shape, dtype=np.result_type(a, b, 1.0))
    slope = np.zeros_like(total)
    for n in range(MAX_TERMS):
        added = p_a * q_b
        total = total + added
        # d/dlnUA of P(n+1, a) is a t_a; of P(n+1, b) / b it is t_b - P(n+1, b) / b
        slope = slope + a * term_a * q_b + p_a * (term_b - q_b)
        if n >= fewest and not np.any(np.abs(added) > SERIES_TOLERANCE):  # a NaN has nothing to wait for
            break
        q_b = q_b - term_b / (n + 1.0)
        term_a, term_b = term_a * a / (n + 1.0), term_b * b / (n + 1.0)
        p_a = p_a - term_a
    return total, slope


def crossflow_effectiveness_approximate(ntu: Array, c_ratio: Array) -> Array:
    r"""Effectiveness of a cross-flow exchanger, both streams unmixed, by the handbook's formula. [-]

    Parameters
    ----------
    ntu : array
        UA over the smaller heat-capacity rate. [-], >= 0
    c_ratio : array
        Smaller over larger heat-capacity rate. [-], 0 < c_ratio <= 1

    Notes
    -----
    .. math:: \varepsilon = 1 - \exp\left[\frac{N^{0.22}}{C_r} \left(e^{-C_r N^{0.78}} - 1\right)\right]

    Within 0.012 of the exact series for N up to 3, and 0.020 up to 10. Kept to compare with what others computed.

    References
    ----------
    .. [1] F. P. Incropera et al., Fundamentals of Heat and Mass Transfer, 6th ed., 2007, equation 11.32.

    Examples
    --------
    >>> round(float(crossflow_effectiveness_approximate(np.float64(1.5), np.float64(0.7))), 4)
    0.6187
    """
    return -np.expm1(ntu**0.22 / c_ratio * np.expm1(-c_ratio * ntu**0.78))


def crossflow_ntu(effectiveness: Array, ntu_ratio: Array) -> Array:
    r"""Transfer units of this side that give this effectiveness: `crossflow_effectiveness` turned round. [-]

    Parameters
    ----------
    effectiveness : array
        Temperature change of this side over the difference of the inlet temperatures. [-]
    ntu_ratio : array
        This side's heat-capacity rate over the other side's, which is `ntu_other` over `ntu_this`. [-], >= 0

    Returns
    -------
    array
        NaN where no exchanger can do it: below 0, or at 1 or the balance of heat and above.

    Notes
    -----
    Newton's method on the effectiveness, from the transfer units of the counterflow exchanger that does the same. That
    start lies below the root, for no exchanger beats counterflow, and the curve is concave: every step stays below
    and comes nearer, so it cannot fail. It stops when a step is under 1e-12 of the value.

    Examples
    --------
    >>> round(float(crossflow_ntu(np.float64(0.617790718454414), np.float64(0.7))), 9)
    1.5
    """
    eps, ratio = (np.asarray(x, dtype=float) for x in np.broadcast_arrays(effectiveness, ntu_ratio))
    possible = (eps >= 0.0) & (eps * np.maximum(ratio, 1.0) < 1.0) & (ratio >= 0.0)
    wanted = np.where(possible, eps, 0.0)
    ntu = _counterflow_ntu(wanted, np.where(possible, ratio, 1.0))
    for _ in range(MAX_NEWTON_STEPS):
        found, slope = crossflow_effectiveness_and_slope(ntu, ntu * np.where(possible, ratio, 1.0))
        # in ln N the slope by ln UA is exact; a step in N keeps the approach monotone
        step = np.where(ntu > 0.0, (wanted - found) * ntu / np.where(slope > 0.0, slope, 1.0), 0.0)
        ntu = ntu + step
        if np.all(np.abs(step) <= 1e-12 * ntu):
            break
    return np.where(possible, ntu, np.nan)


def _counterflow_ntu(eps: Array, ratio: Array) -> Array:
    """Transfer units of this side of a counterflow exchanger: ln[(1 - R e) / (1 - e)] / (1 - R)."""
    gap = eps * (1.0 - ratio) / (1.0 - eps)
    return eps / (1.0 - eps) * np.where(gap == 0.0, 1.0, np.log1p(gap) / np.where(gap == 0.0, 1.0, gap))
