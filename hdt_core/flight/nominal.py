"""Level two of the nominal-leg filter: wear, ice and whatever else leaves the manifold of a sound fleet.

For calibration only, and with hindsight: monitoring must go on seeing the sick.
"""

import numpy as np
import polars as pl
from scipy.stats import chi2
from sklearn.covariance import MinCovDet

from hdt_core.flight.phases import LEG_KEY

UNIT = ("operator", "tail", "pack")
SMOOTHED_FLIGHTS = 7
WORN_INDEX = 0.09  # drop of the conductance index, about the fraction of conductance lost
CLEAN_QUANTILE = 0.9  # of a unit's smoothed level: its clean state, which noise and a few strays don't lift
UNIT_SD = 0.05  # of clean units about each other: conductance as made, and constant sensor errors
UNREST = 6.5  # standard errors that a few samples in a row may leave the leg's own level
STRAY_INDEX, STRAY_SD = 0.07, 4.5  # of one leg against its neighbours
MCD_QUANTILE, MCD_MIN_LEGS = 0.9995, 200
MCD_SUPPORT = 0.75  # what comes here has passed all rules: a quarter of it may still be sick


def judge_conductance(levels: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    """Wear, unrest and strays, from the first-pass index.

    Parameters
    ----------
    levels : DataFrame
        `LEG_KEY`, `flight_number`, `departed_at`, `index_level`, `index_unrest`, `index_n`.
    maintenance : DataFrame
        Replaced exchangers (`component` HX) begin a new unit.

    Returns
    -------
    DataFrame
        `LEG_KEY`, `worn`, `unrest`, `stray` (bool), `index_off`, the leg against the running median of its
        neighbours, and `index_n`, the samples it rests on.

    Notes
    -----
    A unit's clean level is the upper decile of its smoothed level, but no lower than the clean fleet less two
    standard deviations between units: an exchanger that came worn has never shown its clean level.
    """
    unit = [*UNIT, "unit"]
    known = number_units(levels, maintenance).sort(*UNIT, "flight_number")
    running = pl.col("index_level").rolling_median(SMOOTHED_FLIGHTS, center=True, min_samples=2)
    level = known.with_columns(running.over(unit).alias("smooth"))
    clean = level.group_by(unit).agg(pl.col("smooth").quantile(CLEAN_QUANTILE).alias("clean"))
    away = level.join(clean, on=unit, how="left").with_columns(
        (pl.max_horizontal("clean", _fleet_floor(clean)) - pl.col("smooth")).alias("drop"),
        (pl.col("index_level") - pl.col("smooth")).alias("index_off"),
    )
    off = pl.col("index_off").abs()
    flags = {
        "worn": pl.col("drop") > WORN_INDEX,
        "unrest": pl.col("index_unrest") > UNREST,
        "stray": off > pl.max_horizontal(pl.lit(STRAY_INDEX), STRAY_SD * 1.4826 * off.median()),
    }
    return away.select(
        *LEG_KEY, "index_n", "index_off", *(flag.fill_null(False).alias(name) for name, flag in flags.items())
    )


def _fleet_floor(clean: pl.DataFrame) -> pl.Expr:
    """Lowest level to which a clean unit may be believed; null in a fleet without levels."""
    return pl.lit(clean["clean"].median(), pl.Float64) - 2.0 * UNIT_SD


def number_units(flights: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    """Add `unit`: how often the pack's exchanger was replaced before the flight, by the log. A wash keeps the unit."""
    renewed = maintenance.filter((pl.col("component") == "HX") & (pl.col("action") == "REPLACED")).select(
        *UNIT[:2], pl.col("pack").cast(pl.Int32), pl.col("done_on").cast(pl.Datetime("us", "UTC")).alias("departed_at")
    )
    counted = renewed.sort("departed_at").with_columns(
        (pl.col("pack").cum_count().over(UNIT)).cast(pl.Int64).alias("unit")
    )
    placed = flights.sort("departed_at").join_asof(counted, on="departed_at", by=list(UNIT), check_sortedness=False)
    return placed.with_columns(pl.col("unit").fill_null(0))


def reject_outliers(residuals: pl.DataFrame, columns: list[str]) -> pl.Series:
    """Legs whose residual vector the nominal fleet does not produce: FAST-MCD, fitted once, each leg scored.

    Parameters
    ----------
    residuals : DataFrame
        One row a leg; `columns` hold residuals with the unit's own level removed. Nulls count as zero.

    Returns
    -------
    Series of bool
        True where the squared robust distance is above the chi-square quantile. All False in a fleet of fewer than
        200 legs: too few for a robust covariance.

    References
    ----------
    .. [1] P. J. Rousseeuw, K. Van Driessen, A fast algorithm for the minimum covariance determinant estimator,
       Technometrics 41(3), 1999.
    """
    x = residuals.select(pl.col(columns).fill_null(0.0)).to_numpy()
    none = pl.Series("outlier", np.zeros(x.shape[0], dtype=bool))
    if x.shape[0] < MCD_MIN_LEGS:
        return none
    # a residual that is nothing for most legs (not recorded, door at its stop) has no scatter to be far from
    moving = (x == 0.0).mean(axis=0) < 0.5
    if not moving.any():
        return none
    scatter = MinCovDet(support_fraction=MCD_SUPPORT, random_state=0).fit(x[:, moving])
    far = scatter.mahalanobis(x[:, moving]) > chi2.ppf(MCD_QUANTILE, int(moving.sum()))
    return pl.Series("outlier", far)
