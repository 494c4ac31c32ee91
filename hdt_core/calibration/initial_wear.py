"""Wear that a unit brings along when it is first seen, and what clean ones look like: empirical Bayes."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl
from polars.dataframe.group_by import GroupBy

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.dsm import Dsm
from hdt_core.records.keys import IN_ORDER, PACK
from hdt_core.records.renewals import REPLACED, log_flags
from hdt_core.robust import spread

FIRST_FLIGHTS = 10


class EntryWear(NamedTuple):
    """A way to enter the records: share of units, ln loss, its spread, and whether the unit is new."""

    share: float
    wear: float
    wear_sd: float
    new: bool


ENTRY = (
    EntryWear(0.50, 0.004, 0.005, True),
    EntryWear(0.20, 0.030, 0.020, False),
    EntryWear(0.18, 0.090, 0.040, False),
    EntryWear(0.12, 0.200, 0.080, False),
)
"""Units at entry: many are young, some are not. Shares are an assumption, wide on purpose."""
SHARE, WEAR_MEAN, WEAR_VAR = np.array([(e.share, e.wear, e.wear_sd**2) for e in ENTRY]).T
IS_NEW = np.array([float(e.new) for e in ENTRY])
LN_OFFSET_SD, LN_OFFSET_SD_SD = float(np.log(0.05)), 0.2
"""Prior of the spread of clean units: 4 % by unit, 3 % by what calibration leaves of its sensors."""
MIN_FLIGHT_SD = 0.005
CLEAN_BAND = 0.06


class InitialWear(NamedTuple):
    """Posterior mean and variance of the ln loss at entry, (n,) each."""

    wear: Array
    wear_var: Array


def entry_posterior(seen: Array, seen_var: Array, level: float, offset_sd: float) -> InitialWear:
    """What a first sight of a unit says of the wear it brought along.

    Parameters
    ----------
    seen, seen_var : array
        ln conductance ratio of the first flights and its variance. (n,)
    level, offset_sd : float
        Of clean units: see `Dsm`.
    """
    var = WEAR_VAR + (offset_sd**2 + seen_var)[:, None]
    short = level - WEAR_MEAN - seen[:, None]
    log = np.log(SHARE) - 0.5 * (short**2 / var + np.log(var))
    weight = np.exp(log - log.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    at = WEAR_MEAN + WEAR_VAR / var * short
    mean = (weight * at).sum(axis=1)
    spread = WEAR_VAR * (1.0 - WEAR_VAR / var) + (at - mean[:, None]) ** 2
    return InitialWear(mean, (weight * spread).sum(axis=1))


def fleet_levels(twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm) -> Dsm:
    """Complete a model with what clean units look like: level, spread by unit, scatter by flight.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights` over the baseline.
    """
    ratio = pl.col("ln_ua_ratio")
    seen = twin_flights.drop_nulls("ln_ua_ratio").sort(IN_ORDER)
    if not seen.height:
        return dsm
    steps = seen.with_columns((ratio.diff().over(PACK) / np.sqrt(2.0)).alias("step"))["step"].drop_nulls().to_numpy()
    scatter = spread(steps) if len(steps) >= 20 else dsm.flight_sd
    sampling = float((seen["ln_ua_ratio_sd"].to_numpy() ** 2).mean())
    flight_sd = float(np.sqrt(max(scatter**2 - sampling, MIN_FLIGHT_SD**2)))
    first = seen.group_by(PACK, maintain_order=True).head(FIRST_FLIGHTS).group_by(PACK, maintain_order=True)
    levels = first.agg(ratio.median(), pl.len())
    renewed = _after_replacement(seen, maintenance).agg(ratio.median(), pl.len())
    both = pl.concat([levels, renewed], how="diagonal")
    value, error = both["ln_ua_ratio"].to_numpy(), 1.25 * scatter / np.sqrt(both["len"].to_numpy())
    new = np.asarray(np.arange(both.height) >= levels.height)
    level, level_sd, offset_sd = _clean_units(value, error**2, new)
    clean = seen.filter(ratio > level - CLEAN_BAND)["ua_expected_w_k"]
    reference = clean.median() if len(clean) else seen["ua_expected_w_k"].median()
    return replace(
        dsm,
        clean_level=level,
        clean_level_sd=level_sd,
        offset_sd=offset_sd,
        flight_sd=flight_sd,
        reference_ua_w_k=float(reference),  # type: ignore[arg-type]
    )


def _after_replacement(seen: pl.DataFrame, maintenance: pl.DataFrame) -> GroupBy:
    """First flights of units whose installation the log tells of: nobody needs to guess their wear."""
    life = pl.Series("life", log_flags(seen, maintenance, "HX")[1] == REPLACED).cast(pl.Int32)
    lives = seen.with_columns(life).with_columns(pl.col("life").cum_sum().over(PACK))
    first = lives.filter(pl.col("life") > 0).group_by(*PACK, "life", maintain_order=True).head(FIRST_FLIGHTS)
    return first.group_by(*PACK, "life", maintain_order=True)


def _clean_units(value: Array, error_var: Array, new: Array) -> tuple[float, float, float]:
    """Mean and sd of the clean level and the spread of clean units, the wear of each integrated out.

    `value`, `error_var` of each unit's first flights and `new`, whether it is known to have been so, (n,).
    """
    if not len(value):
        return 0.0, 0.05, float(np.exp(LN_OFFSET_SD))
    level = float(np.median(value)) + np.linspace(-0.15, 0.25, 81)[None, :, None, None]
    spread = np.exp(LN_OFFSET_SD + LN_OFFSET_SD_SD * np.linspace(-2.5, 2.5, 21))
    known = np.where(new[:, None], IS_NEW, SHARE)
    var = spread[:, None, None, None] ** 2 + error_var[:, None] + WEAR_VAR
    likelihood = (known * np.exp(-0.5 * (level - WEAR_MEAN - value[:, None]) ** 2 / var) / np.sqrt(var)).sum(-1)
    prior = -0.5 * ((np.log(spread) - LN_OFFSET_SD) / LN_OFFSET_SD_SD)[:, None] ** 2
    log = np.log(np.maximum(likelihood, 1e-300)).sum(-1) + prior
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    grid = level.reshape(-1)
    mean = float((weight.sum(0) * grid).sum())
    sd = float(np.sqrt((weight.sum(0) * (grid - mean) ** 2).sum()))
    return mean, sd, float((weight.sum(1) * spread).sum())
