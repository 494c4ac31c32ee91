"""Effectiveness of exchangers from transfer units, and back.

A side's effectiveness is its temperature change over the difference of the inlet temperatures, and its transfer units
are UA over its own heat-capacity rate; neither needs to know which side is the smaller.
"""

import numpy as np

from hdt_core.physics.model import Array

SERIES_TOLERANCE = 1e-17
SERIES_UNITS, MAX_TERMS = 25.0, 120
"""The series serves while the smaller number of transfer units is this or less; beyond it the contour does."""
CHECK_EVERY = 4
"""Terms of the series between two checks of convergence: a check costs as much as a term."""
CONTOUR_SHIFT, CONTOUR_STEP, CONTOUR_NODES = 2.5, 0.43, 22
"""Distance from the pole and spacing of the nodes, in widths of the saddle; nodes on each side of the real axis."""
MAX_NEWTON_STEPS = 60


def counterflow_effectiveness(ntu: Array, c_ratio: Array) -> Array:
    r"""Effectiveness of a counterflow exchanger, the upper bound of all. [-]

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
    With P the regularised incomplete gamma function, and :math:`A`, :math:`B` independent Poisson counts of means a, b:

    .. math:: \varepsilon = \frac{1}{b} \sum_{n=0}^\infty P(n+1, a) \, P(n+1, b) = \frac{E[\min(A, B)]}{b}

    The sum is Mason's series, for which a recurrence needs two exponentials in all; the expectation holds for any
    number of transfer units (`contour_sums`).

    The handbook's one-line formula (Incropera et al., equation 11.32) is off by up to 0.020.

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
    r"""Effectiveness on this side and its derivative by ln UA, which moves both numbers of transfer units together.

    Parameters and source as in `crossflow_effectiveness`. The derivative is :math:`P(A - B = 1)`, from the derivative
    of a Poisson expectation by its mean; so it never cancels, however flat the effectiveness has become.
    """
    a, b = np.broadcast_arrays(ntu_this, ntu_other)
    many = np.minimum(np.real(a), np.real(b)) > SERIES_UNITS
    if not np.any(many):
        return _by_series(a, b)
    value, slope = (np.array(x) for x in _by_series(np.where(many, 0.0, a), np.where(many, 0.0, b)))
    far_a = a[many]
    far_b = b[many]
    few = np.where(np.real(far_a) < np.real(far_b), far_a, far_b)
    short, unequal = contour_sums(few, far_a + far_b - few)
    value[many], slope[many] = (few - short) / far_b, few * unequal / far_b
    return value[()], slope[()]


def _by_series(a: Array, b: Array) -> tuple[Array, Array]:
    """Mason's series and the sum of products of Poisson probabilities that is its slope."""
    term_a = np.exp(-a)
    term_b = np.exp(-b)
    p_a = -np.expm1(-a)
    q_b = np.where(b == 0.0, 1.0, -np.expm1(-b) / np.where(b == 0.0, 1.0, b))  # P(n+1, b) / b
    fewest = np.fmin(np.real(a), np.real(b))
    total = np.zeros(a.shape, dtype=np.result_type(a, b, 1.0))
    slope = np.zeros_like(total)
    for n in range(MAX_TERMS):
        term = p_a * q_b
        total += term
        term_a *= a / (n + 1.0)
        slope += term_a * term_b
        if n % CHECK_EVERY == CHECK_EVERY - 1:
            # each value ends by itself, so its digits do not depend on its neighbours; NaN ends at once
            on = (n < fewest) | (np.abs(term) > SERIES_TOLERANCE)
            if not on.any():
                break
            p_a *= on
            term_a *= on
        p_a -= term_a
        term_b /= n + 1.0
        q_b -= term_b
        term_b *= b
    return total[()], slope[()]


def contour_sums(few: Array, many: Array) -> tuple[Array, Array]:
    r"""Shortfall of effectiveness at many transfer units: 0 < few <= many, and few above about ten.

    Returns
    -------
    array, array
        :math:`E[(A - B)^+]` and :math:`P(B - A = 1)` for Poisson counts A of mean `few` and B of mean `many`.

    Notes
    -----
    Both are coefficients of the generating function of A - B, integrals round a circle :math:`z = e^{w + i\theta}`:

    .. math:: \frac{1}{2\pi} \int e^{a(z - 1) + b(1/z - 1)} \left\{\frac{z}{(z - 1)^2}, \; z\right\} d\theta

    The circle goes through the saddle, at least some widths of it off the pole at 1; there the trapezoid rule is good
    to the last digits with a number of nodes that does not depend on a and b. The two halves of the circle are taken
    together, in real terms: so a complex step in a or b passes through.

    References
    ----------
    .. [1] L. N. Trefethen and J. A. C. Weideman, The exponentially convergent trapezoidal rule, SIAM Rev. 56, 2014.
    """
    width = (2.0 * np.sqrt(np.real(few) * np.real(many))) ** -0.5
    w = np.maximum(0.5 * np.log(np.real(many) / np.real(few)), CONTOUR_SHIFT * width)
    away = np.sinh(w)
    scale = np.exp(w)
    both = few + many
    difference = many - few
    short = 0.0 * both
    unequal = 0.0 * both
    for k in range(CONTOUR_NODES + 1):
        theta = CONTOUR_STEP * k * width
        level = np.cos(theta)
        across = np.sin(theta)
        # real and imaginary part of cosh(w + i theta) - 1, without the difference of two ones
        u = 2.0 * np.sinh(0.5 * w) ** 2 * level - 2.0 * np.sin(0.5 * theta) ** 2
        v = away * across
        height = np.exp(both * u - difference * away * level) * (1.0 if k == 0 else 2.0)
        turn = both * v - difference * np.cosh(w) * across
        short = short + height * (np.cos(turn) * u + np.sin(turn) * v) / (u**2 + v**2)
        unequal = unequal + height * np.cos(turn + theta)
    spacing = CONTOUR_STEP * width / (2.0 * np.pi)
    return 0.5 * short * spacing, unequal * scale * spacing


def crossflow_ntu(effectiveness: Array, ntu_ratio: Array) -> Array:
    r"""Transfer units of this side that give this effectiveness: the inverse of `crossflow_effectiveness`. [-]

    Parameters
    ----------
    effectiveness : array
        Temperature change of this side over the difference of the inlet temperatures. [-]
    ntu_ratio : array
        This side's heat-capacity rate over the other side's, which is `ntu_other` over `ntu_this`. [-], >= 0

    Returns
    -------
    array
        NaN where no exchanger has it: below 0, or at or above 1 or the limit by the heat balance.

    Notes
    -----
    Newton's method in the transfer units of the equivalent counterflow exchanger, nearly linear in these: three steps
    suffice at 1 transfer unit and a few at a million. Its error is quadratic in the step, so it stops at a step whose
    square is under 1e-13 of the value's.

    Rounding of the effectiveness leaves :math:`2^{-53} \varepsilon / s` of the answer, s the slope by ln UA: 4e-13
    at a million transfer units of balanced streams; but of streams of ratio 0.5 already 1e-12 at 73, and everything at
    350, where the effectiveness is 1 to the last digit.

    Examples
    --------
    >>> round(float(crossflow_ntu(np.float64(0.617790718454414), np.float64(0.7))), 9)
    1.5
    """
    eps, ratio = (np.asarray(x, dtype=float) for x in np.broadcast_arrays(effectiveness, ntu_ratio))
    possible = (eps >= 0.0) & (eps * np.maximum(ratio, 1.0) < 1.0) & (ratio >= 0.0)
    eps = np.where(possible, eps, 0.0)
    ratio = np.where(possible, ratio, 1.0)
    with np.errstate(all="ignore"):
        target = _counterflow_ntu(eps, ratio)
    possible &= np.isfinite(target)
    target = np.where(possible, target, 0.0)
    ntu = target * _over_counterflow(target, np.sqrt(ratio))
    on = np.ones(ntu.shape, bool)
    for _ in range(MAX_NEWTON_STEPS):
        eps_now, slope = crossflow_effectiveness_and_slope(ntu, ntu * ratio)
        with np.errstate(all="ignore"):  # an effectiveness that rounds to its ceiling has no counterflow equal
            by_ntu = slope / ntu / ((1.0 - eps_now) * (1.0 - ratio * eps_now))
            step = (target - _counterflow_ntu(eps_now, ratio)) / by_ntu
            near = np.fmax(1e-13, 2.0**-53 * eps / slope) * ntu**2
        step = on * np.clip(np.where(np.isfinite(step), step, 0.0), -0.5 * ntu, 4.0 * ntu)
        ntu = ntu + step
        on &= step**2 > near
        if not on.any():
            break
    return np.where(possible, ntu, np.nan)


def _counterflow_ntu(eps: Array, ratio: Array) -> Array:
    """Transfer units of this side of a counterflow exchanger: ln[(1 - R e) / (1 - e)] / (1 - R)."""
    gap = eps * (1.0 - ratio) / (1.0 - eps)
    return eps / (1.0 - eps) * np.where(gap == 0.0, 1.0, np.log1p(gap) / np.where(gap == 0.0, 1.0, gap))


def _over_counterflow(ntu: Array, root: Array) -> Array:
    """Transfer units over those of the equivalent counterflow exchanger, within a sixth; `root` of the ratio.

    The three terms hold where units are few (R N^2 / 6, the first term in which the two differ), where they are
    many and balanced (N / pi), and where they are many and not.
    """
    mean = ntu * root
    unbalance = np.abs(1.0 - root) * np.fmax(1.0, root) * root
    return 1.0 + mean**2 / (6.0 + np.pi * mean + 0.5 * unbalance * ntu**2)
