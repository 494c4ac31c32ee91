"""Lives at fleet size, most of them censored: two-sided conformal bounds from a table of `unit, start, end, event`.

The table is any file of that layout (CSV or Parquet; of SCANIA's Component X `vehicle_id, length_of_study_time_step,
in_study_repair` serve). Bounds are learned on nine tenths and asked of the others; coverage is by Kaplan and Meier, for
of a censored life nobody knows whether it ended within. Beside it: tables drawn from known laws, and simulated
operators, each left out.

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

from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import ArrayLike
from scipy.stats import CensoredData, ecdf, weibull_min

from benchmarks.real.recipe import Array, Flags, Recipe, Result, Score, scored
from hdt_core.prognosis.base import draw_fleets

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
    life = np.asarray(length, dtype=float)
    end = np.asarray(ended, dtype=bool)
    if followed is None:
        return _weighed(life, end)
    watched = np.asarray(followed, dtype=float)
    if not life.size or (life > watched).any():
        raise ValueError("no unit, or a life longer than its unit could have been watched")
    return _exact(life, end, watched)


def _exact(life: Array, end: Flags, watched: Array) -> LifeBounds:
    """Order statistics of units that could have been watched for `cut` or longer, chosen without a look at their lives.

    A tenth of them says whether enough lives end by then for an upper end; the others give the bounds, so that the
    choice costs nothing of the guarantee.
    """
    n_units = min(life.size, max(FEWEST, round(SHARE * life.size)))
    cut = float(np.sort(watched)[-n_units])
    lives = np.where(end & (life < cut), life, np.inf)[watched >= cut]
    first_look = np.arange(lives.size) % 10 == 0
    sample = np.sort(lives[~first_look])
    n = sample.size
    missed = 1.0 - LEVEL
    two_sided = np.isfinite(lives[first_look]).mean() >= 1.0 - missed / 2.0
    tail = missed / 2.0 if two_sided else missed
    first = int(np.floor(tail * (n + 1) + 1e-9))
    last = int(np.ceil((1.0 - tail) * (n + 1) - 1e-9)) if two_sided else n + 1
    low = min(float(sample[first - 1]), cut) if first else 0.0
    return LifeBounds(low, float(sample[last - 1]) if last <= n else np.inf)


def _weighed(life: Array, end: Flags) -> LifeBounds:
    """Weighed order statistics of the lives that ended; weights from the other half's censoring (Kaplan and Meier)."""
    if not end.any():
        raise ValueError("no life ended: nothing bounds them")
    half = np.arange(life.size) % 2 == 0
    survival = ecdf(CensoredData.right_censored(life[half], end[half])).sf
    watched = np.append(1.0, survival.probabilities)[np.searchsorted(survival.quantiles, life, side="left")]
    use = ~half & end & (watched > 0.0)
    weight = 1.0 / watched[use]
    order = np.argsort(life[use])
    sample = life[use][order]
    total = float((~half).sum())
    mass = np.cumsum(weight[order]) / (total + 1.0)
    tail = (1.0 - LEVEL) / 2.0
    below = int(np.searchsorted(mass, tail, side="right"))
    above = int(np.searchsorted(mass, 1.0 - tail, side="left"))
    low = float(sample[max(below - 1, 0)]) if below else 0.0
    return LifeBounds(low, float(sample[above]) if above < sample.size else np.inf)


SPLITS, TABLES = 10, 100
LAW = weibull_min(2.0, scale=400.0)
FLEETS, AIRCRAFT, FLIGHTS = 12, 60, 600


def read(file: Path) -> tuple[Array, Flags, Array | None]:
    """Life, whether it ended, and how long it could have been followed; None where units left for other reasons."""
    rows = pl.read_parquet(file) if file.suffix == ".parquet" else pl.read_csv(file)
    if "length_of_study_time_step" in rows.columns:
        rows = rows.select(start=pl.lit(0.0), end="length_of_study_time_step", event="in_study_repair")
    start, end = (rows[c].cast(pl.Float64).to_numpy() for c in ("start", "end"))
    ended = rows["event"].cast(pl.Boolean).to_numpy()
    last = end.max()
    one_end = ended.all() or (end[~ended] >= last - 0.01 * (last - start.min())).all()
    return end - start, ended, last - start if one_end else None


def share_within(life: Array, ended: Flags, bounds: LifeBounds) -> float:
    """Share of lives within the bounds."""
    alive = ecdf(CensoredData.right_censored(life, ~ended)).sf
    below, above = 1.0 - alive.evaluate(np.array([np.nextafter(bounds.low, -np.inf), min(bounds.high, 1e300)]))
    return float(above - below) if np.isfinite(bounds.high) else float(1.0 - below)


def of_table(file: Path) -> Score:
    """Ten random splits of a table."""
    life, ended, followed = read(file)
    shares = []
    for seed in range(SPLITS):
        is_test = np.random.default_rng(seed).random(life.size) < 0.1
        followed_by = None if followed is None else followed[~is_test]
        bounds = life_bounds(life[~is_test], ended[~is_test], followed_by)
        shares.append(share_within(life[is_test], ended[is_test], bounds))
    return scored(f"{file.stem}: coverage of 90 % bounds", "0.89-0.91", range(SPLITS), np.array(shares))


def of_law(name: str, leave: float | None, units: int = 3000) -> Score:
    """Tables drawn from a Weibull law: chance by the law itself that a further life lies within."""
    shares = []
    for seed in range(TABLES):
        rng = np.random.default_rng(seed)
        life = LAW.rvs(units, random_state=rng)
        followed = 1500.0 - rng.uniform(0.0, 900.0, units)
        watched = followed if leave is None else np.minimum(followed, rng.exponential(leave, units))
        bounds = life_bounds(np.minimum(life, watched), life <= watched, followed if leave is None else None)
        shares.append(float(LAW.cdf(bounds.high) - LAW.cdf(bounds.low)))
    return scored(f"known law, {name}: coverage", "0.89-0.91", range(TABLES), np.array(shares))


def of_operators() -> list[Score]:
    """Simulated operators with habits of their own, each left out: bounds from all others."""
    fleets = [lives for lives, _ in draw_fleets(77, FLEETS, AIRCRAFT, FLIGHTS)]
    lifetimes = [
        lives.message[lives.age_known].astype(float) for lives in fleets if lives.age_known.sum() > AIRCRAFT // 2
    ]
    fleets_of_lives = [(life, life < FLIGHTS) for life in lifetimes]
    shares = []
    for k, (life, ended) in enumerate(fleets_of_lives):
        others = [pair for j, pair in enumerate(fleets_of_lives) if j != k]
        length, end = (np.concatenate([pair[n] for pair in others]) for n in (0, 1))
        bounds = life_bounds(length, end, np.full(length.size, float(FLIGHTS)))
        shares.append(share_within(life, ended, bounds))
    within = np.array(shares)
    fleet = range(len(shares))
    mean = scored("simulated operators, one left out: coverage", "0.89-0.91", fleet, within)
    return [mean, scored("the same, the operator held worst", "", fleet, lambda i: float(within[i].min()))]


def run(folder: Path) -> Result:
    """Every table of the folder, known laws and simulated operators."""
    tables = [of_table(f) for f in sorted([*folder.glob("*.csv"), *folder.glob("*.parquet")])]
    laws = [of_law("one end of the record (exact)", None), of_law("units that leave (weighted)", 900.0)]
    words = "" if tables else "No table was there: what stands here needs none."
    return Result([*tables, *laws, *of_operators()], words=words)


RECIPE = Recipe(
    name="lives",
    title="Lives at fleet size, censored",
    folder="lives",
    wants="",
    source="any table of `unit, start, end, event`; SCANIA Component X (doi 10.5878/jvb5-d390) has 23,550 vehicles",
    licence="SCANIA's: CC BY 4.0, by its page",
    anchor="the guarantee itself: .90, in finite samples where the record ends at one time for all",
    run=run,
)
