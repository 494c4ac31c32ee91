"""Two-sided bounds of a life from a table of lives, many of them censored, with a stated guarantee.

Where a record ends at one time for all, how long each unit could have been followed is known, and does not depend on
its life. Units that could have been followed for c or longer are a fair sample of min(life, c): order statistics of
theirs are exact in finite samples (split conformal prediction without covariates [1, 2]). Where units leave for other
reasons, lives that ended are weighed by the inverse of the chance of still being watched [3]; the guarantee then holds
up to the error of those weights.

References
----------
.. [1] V. Vovk, A. Gammerman, G. Shafer, Algorithmic learning in a random world, 2005.
.. [2] E. J. Candes, L. Lei, Z. Ren, Conformalized survival analysis, JRSS B 85, 2023.
.. [3] R. J. Tibshirani et al., Conformal prediction under covariate shift, NeurIPS 2019.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import CensoredData, ecdf

Array = NDArray[np.float64]

FEWEST = 200
"""Units that bounds rest on at least, where there are so many: an order statistic is then within .005 of its level."""
SHARE = 0.4
"""And of all units no fewer than this share."""


@dataclass(frozen=True, slots=True)
class LifeBounds:
    """Ends of an interval that holds a further unit's life.

    Attributes
    ----------
    low, high : float
        Same unit as the lives; `high` is infinite where the record is too short to bound it, and `low` is then a bound
        from below alone.
    least, most : float
        The chance that the interval holds the life lies between these; `most` for lives without ties, where `high` is
        finite.
    n : int
        Units they rest on.
    exact : bool
        Whether that holds in finite samples; else up to the error of the weights.
    """

    low: float
    high: float
    least: float
    most: float
    n: int
    exact: bool


def life_bounds(
    length: ArrayLike, ended: ArrayLike, followed: ArrayLike | None = None, level: float = 0.9, age: float = 0.0
) -> LifeBounds:
    """Bounds of the life of one more unit that is like these, given that it reached an age.

    Parameters
    ----------
    length : array, shape (n,)
        Life, or how long a unit was watched without its end.
    ended : array of bool, shape (n,)
        Whether the life ended.
    followed : array, shape (n,), optional
        How long each unit could have been watched, ended or not: the end of the record less its start. Not given where
        units left for other reasons.
    level : float
        Chance that the interval is to hold.
    age : float
        The further unit is known to have reached it.

    Raises
    ------
    ValueError
        No unit, or a life longer than it could have been watched.

    Examples
    --------
    >>> flights = np.arange(1.0, 401.0)
    >>> life_bounds(flights, np.ones(400, bool), np.full(400, 500.0))
    LifeBounds(low=20.0, high=382.0, least=0.9, most=0.9002770083102493, n=360, exact=True)
    """
    life, end = np.asarray(length, dtype=float), np.asarray(ended, dtype=bool)
    if followed is None:
        old = life > age
        return _weighed(life[old], end[old], level)
    watched = np.asarray(followed, dtype=float)
    if not life.size or (life > watched).any():
        raise ValueError("no unit, or a life longer than its unit could have been watched")
    return _exact(life, end, watched, level, age)


def _exact(life: Array, end: NDArray[np.bool_], watched: Array, level: float, age: float) -> LifeBounds:
    """Order statistics of units that could have been watched for `cut` or longer, chosen without a look at their lives.

    A tenth of them says whether enough lives end by then for an upper end; the others give the bounds, so that the
    choice costs nothing of the guarantee.
    """
    n_units = min(life.size, max(FEWEST, round(SHARE * life.size)))
    cut = float(np.sort(watched)[-n_units])
    lives = np.where(end & (life < cut), life, np.inf)[(watched >= cut) & (life > age)]
    first_look = np.arange(lives.size) % 10 == 0
    sample = np.sort(lives[~first_look])
    n, missed = sample.size, 1.0 - level
    two_sided = np.isfinite(lives[first_look]).mean() >= 1.0 - missed / 2.0
    tail = missed / 2.0 if two_sided else missed
    first = int(np.floor(tail * (n + 1) + 1e-9))
    last = int(np.ceil((1.0 - tail) * (n + 1) - 1e-9)) if two_sided else n + 1
    low = min(float(sample[first - 1]), cut) if first else age
    high = float(sample[last - 1]) if last <= n else np.inf
    is_bounded = np.isfinite(high) if two_sided else low < cut
    return LifeBounds(low, high, level, (last - first) / (n + 1) if is_bounded else 1.0, n, True)


def _weighed(life: Array, end: NDArray[np.bool_], level: float) -> LifeBounds:
    """Weighed order statistics of the lives that ended; weights from the other half's censoring (Kaplan and Meier)."""
    if not end.any():
        raise ValueError("no life ended: nothing bounds them")
    half = np.arange(life.size) % 2 == 0
    survival = ecdf(CensoredData.right_censored(life[half], end[half])).sf
    watched = np.append(1.0, survival.probabilities)[np.searchsorted(survival.quantiles, life, side="left")]
    use = ~half & end & (watched > 0.0)
    weight = 1.0 / watched[use]
    order = np.argsort(life[use])
    sample, total = life[use][order], float((~half).sum())
    mass = np.cumsum(weight[order]) / (total + 1.0)
    tail = (1.0 - level) / 2.0
    below = int(np.searchsorted(mass, tail, side="right"))
    above = int(np.searchsorted(mass, 1.0 - tail, side="left"))
    low = float(sample[max(below - 1, 0)]) if below else 0.0
    high = float(sample[above]) if above < sample.size else np.inf
    return LifeBounds(low, high, level, 1.0, int(total), False)
