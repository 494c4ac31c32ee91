"""Wear of units within the baseline: at entry, with the distribution of clean units (empirical Bayes), and its drift.

A model that takes wear as normal hides it. The clean level is anchored in each pack's first flights and the baseline
ends at a milestone, so wear that came later cannot move it; wear before the milestone is reported by the audit.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.dsm import Dsm
from hdt_core.records.keys import FLIGHT, IN_ORDER, PACK
from hdt_core.records.unit_index import REPLACEMENT, log_flags, number_units
from hdt_core.robust import spread

FIRST_FLIGHTS = 10
MIN_FLIGHTS = 20
DRIFT_SD, LEAST_DRIFT = 3.0, 0.01
"""A drift is reported where it is both significant and at least one per cent in a hundred flights."""


class EntryWear(NamedTuple):
    """A class of units at entry: share of units, ln loss, its sd, and whether the unit is new."""

    share: float
    wear: float
    wear_sd: float
    is_new: bool


ENTRY = (
    EntryWear(0.50, 0.004, 0.005, True),
    EntryWear(0.20, 0.030, 0.020, False),
    EntryWear(0.18, 0.090, 0.040, False),
    EntryWear(0.12, 0.200, 0.080, False),
)
"""Units at entry: many are young, some are not. Shares are an assumption, wide on purpose."""


def entry_sd(entries: Sequence[EntryWear]) -> float:
    """Standard deviation of the wear of a unit at entry, over its classes. ln [-]"""
    share, wear, wear_sd = np.array([(e.share, e.wear, e.wear_sd) for e in entries]).T
    return float(np.sqrt(share @ (wear_sd**2 + wear**2) - (share @ wear) ** 2))


SHARE, WEAR_MEAN, WEAR_VAR = np.array([(e.share, e.wear, e.wear_sd**2) for e in ENTRY]).T
IS_NEW = np.array([float(e.is_new) for e in ENTRY])
LN_OFFSET_SD, LN_OFFSET_SD_SD = float(np.log(0.05)), 0.2
"""Prior of the sd over clean units: 4 % by unit, 3 % by residual biases of its sensors."""
MIN_FLIGHT_SD = 0.005
CLEAN_BAND = 0.06


class InitialWear(NamedTuple):
    """Posterior mean and variance of the ln loss at entry, (n,) each."""

    wear: Array
    wear_var: Array


def entry_posterior(ratio: Array, ratio_var: Array, level: float, offset_sd: float) -> InitialWear:
    """Compute the posterior of a unit's wear at entry from its first flights.

    Parameters
    ----------
    ratio, ratio_var : array
        ln conductance ratio of the first flights and its variance. (n,)
    level, offset_sd : float
        Of clean units: see `Dsm`.
    """
    var = WEAR_VAR + (offset_sd**2 + ratio_var)[:, None]
    short = level - WEAR_MEAN - ratio[:, None]
    log = np.log(SHARE) - 0.5 * (short**2 / var + np.log(var))
    weight = np.exp(log - log.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    class_mean = WEAR_MEAN + WEAR_VAR / var * short
    mean = (weight * class_mean).sum(axis=1)
    variance = WEAR_VAR * (1.0 - WEAR_VAR / var) + (class_mean - mean[:, None]) ** 2
    return InitialWear(mean, (weight * variance).sum(axis=1))


def fleet_levels(
    twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, coarse: pl.DataFrame | None = None
) -> Dsm:
    """Complete a model with the distribution of clean units: level, sd by unit, scatter by flight.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights` over the baseline.
    coarse : DataFrame, optional
        `FLIGHT` of those whose flow is recorded in coarse steps: their scatter is not the fleet's where others show it.
    """
    ratio = pl.col("ln_ua_ratio")
    flights = twin_flights.drop_nulls("ln_ua_ratio").sort(IN_ORDER)
    if not flights.height:
        return dsm
    fine = flights if coarse is None else flights.join(coarse, on=FLIGHT, how="anti", maintain_order="left")
    typical = fine if fine.height else flights
    steps = typical.with_columns((ratio.diff().over(PACK) / np.sqrt(2.0)).alias("step"))["step"].drop_nulls().to_numpy()
    scatter = spread(steps) if len(steps) >= 20 else dsm.flight_sd
    sampling = float((typical["ln_ua_ratio_sd"].to_numpy() ** 2).mean())
    flight_sd = float(np.sqrt(max(scatter**2 - sampling, MIN_FLIGHT_SD**2)))
    levels = first_levels(flights)
    # units whose installation is logged are new
    life = pl.Series("life", log_flags(flights, maintenance, "HX")[1] == REPLACEMENT).cast(pl.Int32)
    lives = flights.with_columns(life).with_columns(pl.col("life").cum_sum().over(PACK))
    new_levels = first_levels(lives.filter(pl.col("life") > 0), [*PACK, "life"])
    all_levels = pl.concat([levels, new_levels], how="diagonal")
    value = all_levels["ln_ua_ratio"].to_numpy()
    error = 1.25 * scatter / np.sqrt(all_levels["n"].to_numpy())
    is_new = np.asarray(np.arange(all_levels.height) >= levels.height)
    level, level_sd, offset_sd = _clean_units(value, error**2, is_new)
    clean = flights.filter(ratio > level - CLEAN_BAND)["ua_expected_w_k"]
    reference = clean.median() if len(clean) else flights["ua_expected_w_k"].median()
    return replace(
        dsm,
        clean_level=level,
        clean_level_sd=level_sd,
        offset_sd=offset_sd,
        flight_sd=flight_sd,
        reference_ua_w_k=float(reference),  # type: ignore[arg-type]
    )


def first_levels(flights: pl.DataFrame, unit: Sequence[str] = PACK) -> pl.DataFrame:
    """Compute each unit's median `ln_ua_ratio` over its first flights, and their number `n`; flights in order."""
    first = flights.group_by(unit, maintain_order=True).head(FIRST_FLIGHTS)
    return first.group_by(unit, maintain_order=True).agg(pl.col("ln_ua_ratio").median(), pl.len().alias("n"))


def _clean_units(value: Array, error_var: Array, is_new: Array) -> tuple[float, float, float]:
    """Estimate mean and sd of the clean level and the sd over clean units, with the wear of each integrated out.

    `value`, `error_var` of each unit's first flights and `is_new` of its installation, (n,).
    """
    if not len(value):
        return 0.0, 0.05, float(np.exp(LN_OFFSET_SD))
    level = float(np.median(value)) + np.linspace(-0.15, 0.25, 81)
    offset_sd = np.exp(LN_OFFSET_SD + LN_OFFSET_SD_SD * np.linspace(-2.5, 2.5, 21))
    share = np.where(is_new[:, None], IS_NEW, SHARE)
    prior = -0.5 * ((np.log(offset_sd) - LN_OFFSET_SD) / LN_OFFSET_SD_SD)[:, None] ** 2
    log = clean_log_likelihood(value, error_var, level, offset_sd, share, WEAR_MEAN, WEAR_VAR).sum(-1) + prior
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = float((weight.sum(0) * level).sum())
    sd = float(np.sqrt((weight.sum(0) * (level - mean) ** 2).sum()))
    return mean, sd, float((weight.sum(1) * offset_sd).sum())


def clean_log_likelihood(
    value: Array, error_var: Array, level: Array, offset_sd: Array, share: Array, wear: Array, wear_var: Array
) -> Array:
    """Compute the log likelihood of each unit's first flights, its wear integrated out. (s, m, n)

    Parameters
    ----------
    value, error_var : array (n,)
        Ln ratio of a unit's first flights and its variance.
    level, offset_sd : array (m,), (s,)
        Clean levels and sds over clean units, every pair of them.
    share : array (n, c) or (c,)
        Share of units in each class of wear at entry.
    wear, wear_var : array (c,)
        Ln loss of a class, and its variance.
    """
    var = offset_sd[:, None, None, None] ** 2 + error_var[:, None] + wear_var
    short = level[:, None, None] - wear - value[:, None]
    likelihood = (share * np.exp(-0.5 * short**2 / var) / np.sqrt(var)).sum(-1)
    return np.asarray(np.log(np.maximum(likelihood, 1e-300)))


def audit_drift(twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Estimate the drift of each unit's conductance over the baseline.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights` over the baseline flights.
    maintenance : DataFrame
        Replaced exchangers begin a new unit.
    dsm : Dsm
        The model of the flight estimates.

    Returns
    -------
    DataFrame
        One row a pack and unit of twenty flights or more, by pack: `n_flights`, `anchor` (ln conductance ratio of its
        first ten flights, above the clean fleet's), `drift_per_100_flights` (of the ratio, Theil and Sen's slope) with
        `drift_sd`, `unlearned` (ln ratio of its last ten flights below its first: what the anchor keeps out of the
        model), and `drifts` (bool).
    """
    flights = twin_flights.drop_nulls("ln_ua_ratio").sort(IN_ORDER)
    rows = [
        _audit_unit(dict(zip((*PACK, "unit"), key, strict=True)), unit["ln_ua_ratio"].to_numpy(), dsm.clean_level)
        for key, unit in number_units(flights, maintenance).group_by(*PACK, "unit", maintain_order=True)
        if unit.height >= MIN_FLIGHTS
    ]
    schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "unit": pl.Int64, "n_flights": pl.Int64}
    schema |= dict.fromkeys(("anchor", "drift_per_100_flights", "drift_sd", "unlearned"), pl.Float64)
    return pl.DataFrame(rows, schema={**schema, "drifts": pl.Boolean}).sort(*PACK, "unit")


def _audit_unit(keys: dict[str, object], ratio: np.ndarray, clean_level: float) -> dict[str, object]:
    from scipy.stats import theilslopes  # noqa: PLC0415 (loads for half a second, and few nights calibrate)

    slope = theilslopes(ratio, alpha=0.6827)
    sd = 0.5 * (slope.high_slope - slope.low_slope)
    first = float(np.median(ratio[:FIRST_FLIGHTS]))
    last = float(np.median(ratio[-FIRST_FLIGHTS:]))
    return keys | {
        "n_flights": len(ratio),
        "anchor": first - clean_level,
        "drift_per_100_flights": 100.0 * slope.slope,
        "drift_sd": 100.0 * sd,
        "unlearned": first - last,
        "drifts": bool(abs(slope.slope) > DRIFT_SD * sd and abs(100.0 * slope.slope) > LEAST_DRIFT),
    }
