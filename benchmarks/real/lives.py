"""Lives at fleet size, most of them censored: two-sided conformal bounds from a table of `unit, start, end, event`.

The table is any file of that layout (CSV or Parquet; of SCANIA's Component X `vehicle_id, length_of_study_time_step,
in_study_repair` serve). Bounds are learned on nine tenths and asked of the others; coverage is by Kaplan and Meier, for
of a censored life nobody knows whether it ended within. Beside it: tables drawn from known laws, and simulated
operators, each left out.
"""

from pathlib import Path

import numpy as np
import polars as pl
from scipy.stats import CensoredData, ecdf, weibull_min

from benchmarks.real.censored import LifeBounds, life_bounds
from benchmarks.real.normal_behaviour import Array, Flags
from benchmarks.real.recipe import Recipe, Result, Score, scored
from hdt_core.prognosis.base import draw_fleets

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
    return scored(
        f"{file.stem}: coverage of 90 % bounds",
        "0.89-0.91",
        range(SPLITS),
        lambda i: float(np.mean(np.array(shares)[i])),
    )


def of_law(name: str, leave: float | None, units: int = 3000) -> Score:
    """Tables drawn from a Weibull law: chance by the law itself that a further life lies within."""
    shares = []
    for seed in range(TABLES):
        rng = np.random.default_rng(seed)
        life, followed = LAW.rvs(units, random_state=rng), 1500.0 - rng.uniform(0.0, 900.0, units)
        watched = followed if leave is None else np.minimum(followed, rng.exponential(leave, units))
        bounds = life_bounds(np.minimum(life, watched), life <= watched, followed if leave is None else None)
        shares.append(float(LAW.cdf(bounds.high) - LAW.cdf(bounds.low)))
    chances = np.array(shares)
    return scored(f"known law, {name}: coverage", "0.89-0.91", range(TABLES), lambda i: float(chances[i].mean()))


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
    shares_by_fleet = np.array(shares)
    return [
        scored(
            "simulated operators, one left out: coverage",
            "0.89-0.91",
            range(shares_by_fleet.size),
            lambda i: float(shares_by_fleet[i].mean()),
        ),
        scored(
            "the same, the operator held worst",
            "",
            range(shares_by_fleet.size),
            lambda i: float(shares_by_fleet[i].min()),
        ),
    ]


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
