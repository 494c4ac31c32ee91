"""Rules of level two on the conductance index: wear, ice, strays, and outliers of the joint residuals.

For calibration only, with later flights too; monitoring keeps all legs.
"""

from dataclasses import dataclass
from itertools import compress

import numpy as np
import polars as pl
from scipy.stats import chi2
from sklearn.covariance import MinCovDet

from hdt_core.flight.cross_checks import SMOOTHED_FLIGHTS
from hdt_core.records.keys import LEG, PACK
from hdt_core.records.unit_index import number_units
from hdt_core.robust import MAD_TO_SD

UNIT = [*PACK, "unit"]
WORN_INDEX = 0.09  # drop of the conductance index, about the fraction of conductance lost
CLEAN_QUANTILE = 0.9  # of a unit's smoothed level: its clean state, robust to noise and a few strays
UNIT_SD = 0.05  # of clean units about each other: conductance as made, and constant sensor errors
UNREST = 6.5  # standard errors that a few samples in a row may leave the leg's own level
STRAY_INDEX, STRAY_SD = 0.07, 4.5  # of one leg against its neighbours
MCD_QUANTILE, MCD_MIN_LEGS = 0.9995, 200
MCD_SUPPORT = 0.75  # of legs that passed all rules, a quarter may still be sick


@dataclass(frozen=True, slots=True)
class IndexLevel:
    """Statistics of the index over a fleet.

    Attributes
    ----------
    clean : float, optional
        Clean level of the median unit; None in a fleet without levels.
    stray : float, optional
        Median deviation of a leg from its neighbours.
    """

    clean: float | None = None
    stray: float | None = None


def learn_level(levels: pl.DataFrame, maintenance: pl.DataFrame) -> IndexLevel:
    """Learn the statistics from levels as of `judge_conductance`."""
    smooth = _smooth(levels, maintenance)
    # medians of floats, None without any
    return IndexLevel(_clean(smooth)["clean"].median(), smooth["index_off"].abs().median())  # type: ignore[arg-type]


def judge_conductance(levels: pl.DataFrame, maintenance: pl.DataFrame, fleet: IndexLevel) -> pl.DataFrame:
    """Flag wear, unrest and strays by the index.

    Parameters
    ----------
    levels : DataFrame
        `LEG`, `flight_number`, `departed_at`, `index_level`, `index_unrest`, `index_n`; all flights of each tail.
    maintenance : DataFrame
        Replaced exchangers (`component` HX) begin a new unit.
    fleet : IndexLevel
        Of `learn_level`.

    Returns
    -------
    DataFrame
        `LEG`, `worn`, `unrest`, `stray` (bool), `index_off`, the leg's deviation from the running
        median of its neighbours, and `index_n`, its number of samples.

    Notes
    -----
    A unit's clean level is the upper decile of its smoothed level, but no lower than the clean fleet less two
    standard deviations between units: an exchanger fitted worn never shows its clean level.
    """
    smooth = _smooth(levels, maintenance)
    floor = pl.lit(None if fleet.clean is None else fleet.clean - 2.0 * UNIT_SD, pl.Float64)
    away = smooth.join(_clean(smooth), on=UNIT, how="left", validate="m:1").with_columns(
        (pl.max_horizontal("clean", floor) - pl.col("smooth")).alias("drop")
    )
    flags = {
        "worn": pl.col("drop") > WORN_INDEX,
        "unrest": pl.col("index_unrest") > UNREST,
        "stray": pl.col("index_off").abs() > max(STRAY_INDEX, STRAY_SD * MAD_TO_SD * (fleet.stray or 0.0)),
    }
    return away.select(
        *LEG, "index_n", "index_off", *(flag.fill_null(False).alias(name) for name, flag in flags.items())
    )


def _smooth(levels: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    """Add the running median of each unit, and each leg's deviation from it."""
    units = number_units(levels, maintenance).sort(*PACK, "flight_number")
    running = pl.col("index_level").rolling_median(SMOOTHED_FLIGHTS, center=True, min_samples=2)
    smooth = units.with_columns(running.over(UNIT).alias("smooth"))
    return smooth.with_columns((pl.col("index_level") - pl.col("smooth")).alias("index_off"))


def _clean(smooth: pl.DataFrame) -> pl.DataFrame:
    return smooth.group_by(UNIT).agg(pl.col("smooth").quantile(CLEAN_QUANTILE).alias("clean"))


@dataclass(frozen=True, slots=True)
class Scatter:
    """Joint scatter of the residuals of nominal legs: `columns`, mean and inverse covariance."""

    columns: tuple[str, ...]
    mean: tuple[float, ...]
    precision: tuple[tuple[float, ...], ...]

    def flag_outliers(self, residuals: pl.DataFrame) -> pl.Series:
        """Flag rows with a squared robust distance above the chi-square quantile. Nulls count as zero."""
        off = residuals.select(pl.col(self.columns).fill_null(0.0)).to_numpy() - np.array(self.mean)
        distance = ((off @ np.array(self.precision)) * off).sum(axis=1)
        return pl.Series("outlier", distance > chi2.ppf(MCD_QUANTILE, len(self.columns)))


def learn_scatter(residuals: pl.DataFrame, columns: list[str]) -> Scatter | None:
    """Estimate the scatter of a nominal fleet by FAST-MCD; None for fewer than 200 legs.

    Parameters
    ----------
    residuals : DataFrame
        One row a leg; `columns` hold residuals with the unit's own level removed. Nulls count as zero.

    References
    ----------
    .. [1] P. J. Rousseeuw, K. Van Driessen, A fast algorithm for the minimum covariance determinant estimator,
       Technometrics 41(3), 1999.
    """
    x = residuals.select(pl.col(columns).fill_null(0.0)).to_numpy()
    # a residual that is zero for most legs (not recorded, door at its stop) has no scatter
    moves = (x == 0.0).mean(axis=0) < 0.5 if len(x) else np.zeros(len(columns), dtype=bool)
    if len(x) < MCD_MIN_LEGS or not moves.any():
        return None
    covariance = MinCovDet(support_fraction=MCD_SUPPORT, random_state=0).fit(x[:, moves])
    precision = tuple(map(tuple, covariance.get_precision().tolist()))
    return Scatter(tuple(compress(columns, moves)), tuple(covariance.location_.tolist()), precision)
