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

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import CensoredData, ecdf

Array = NDArray[np.float64]

LEVEL = 0.9
FEWEST = 200
"""Units that bounds rest on at least, where there are so many: an order statistic is then within .005 of its level."""
SHARE = 0.4
"""And of all units no fewer than this share."""


class LifeBounds(NamedTuple):
    """Ends of an interval that holds a further unit's life with a chance of `LEVEL`, in the unit of the lives.

    `high` is infinite where the record is too short to bound it, and `low` is then a bound from below alone.
    """

    low: float
    high: float


def life_bounds(length: ArrayLike, ended: ArrayLike, followed: ArrayLike | None = None) -> LifeBounds:
    """Bounds of the life of one more unit that is like these.

    Parameters
    ----------
    length : array, shape (n,)
        Life, or how long a unit was watched without its end.
    ended : array of bool, shape (n,)
        Whether the life ended.
    followed : array, shape (n,), optional
        How long each unit could have been watched, ended or not: the end of the record less its start. Not given where
        units left for other reasons: the bounds then hold up to the error of the weights, else in finite samples.

    Raises
    ------
    ValueError
        No unit, or a life longer than it could have been watched.

    Examples
    --------
    >>> flights = np.arange(1.0, 401.0)
    >>> life_bounds(flights, np.ones(400, bool), np.full(400, 500.0))
    LifeBounds(low=20.0, high=382.0)
    """
    life, end = np.asarray(length, dtype=float), np.asarray(ended, dtype=bool)
    if followed is None:
        return _weighed(life, end)
    watched = np.asarray(followed, dtype=float)
    if not life.size or (life > watched).any():
        raise ValueError("no unit, or a life longer than its unit could have been watched")
    return _exact(life, end, watched)


def _exact(life: Array, end: NDArray[np.bool_], watched: Array) -> LifeBounds:
    """Order statistics of units that could have been watched for `cut` or longer, chosen without a look at their lives.

    A tenth of them says whether enough lives end by then for an upper end; the others give the bounds, so that the
    choice costs nothing of the guarantee.
    """
    n_units = min(life.size, max(FEWEST, round(SHARE * life.size)))
    cut = float(np.sort(watched)[-n_units])
    lives = np.where(end & (life < cut), life, np.inf)[watched >= cut]
    first_look = np.arange(lives.size) % 10 == 0
    sample = np.sort(lives[~first_look])
    n, missed = sample.size, 1.0 - LEVEL
    two_sided = np.isfinite(lives[first_look]).mean() >= 1.0 - missed / 2.0
    tail = missed / 2.0 if two_sided else missed
    first = int(np.floor(tail * (n + 1) + 1e-9))
    last = int(np.ceil((1.0 - tail) * (n + 1) - 1e-9)) if two_sided else n + 1
    low = min(float(sample[first - 1]), cut) if first else 0.0
    return LifeBounds(low, float(sample[last - 1]) if last <= n else np.inf)


def _weighed(life: Array, end: NDArray[np.bool_]) -> LifeBounds:
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
    tail = (1.0 - LEVEL) / 2.0
    below = int(np.searchsorted(mass, tail, side="right"))
    above = int(np.searchsorted(mass, 1.0 - tail, side="left"))
    low = float(sample[max(below - 1, 0)]) if below else 0.0
    return LifeBounds(low, float(sample[above]) if above < sample.size else np.inf)
