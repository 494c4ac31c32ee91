"""Missing physics: which term of a small library the residuals ask for, and how strongly.

Wear is slow and weather is not, so what is explained is the change of the conductance from one flight of a pack to the
next, worn packs included. Term and design are refitted together, for a model that lacks a term has bent its design to
make up for it; and as in the calibration, flights are compared through instruments only, weather, level and demand: the
door and the outlet answer to the very conductance that is being explained. What counts is the residual on aircraft that
term and design were not learned from, held against that of the model in service.
"""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Array
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.exchanger_fit import DESIGN_EFFECT, MAX_STEP, instruments_of
from hdt_core.calibration.flight_estimates import MEDIANS, design_gradient
from hdt_core.physics.installed_exchanger import with_static_pressure
from hdt_core.physics.terms import TERMS, correct_signals, within
from hdt_core.records.keys import IN_ORDER, PACK
from hdt_core.robust import huber_weights, spread

STEP = 1e-3
HUBER, ROBUST_STEPS, REFITS = 2.0, 10, 5
OUTLIER_SDS = 4.0
LEAST_CHANGES, LEAST_GAIN, LEAST_BIC, LEAST_SDS = 60, 0.1, 6.0, 4.0
"""Proposed from so many changes on, where residuals of aircraft left out shrink by this share, BIC by this much, and
the coefficient is so many standard deviations from 0."""
FOLDS = 5
MOST_FLIGHTS = 20_000
"""Evidence enough: from a larger fleet every second, third, ... aircraft is taken."""


class _FlightSteps(NamedTuple):
    """Flights in order, (n,), and which of the n - 1 steps between rows are changes of one pack, with their fold.

    `offset` is what a flight's own ratio has over that at the medians of its signals.
    """

    signals: dict[str, Array]
    bias: Array
    offset: Array
    change: Array
    fold: Array

    def ratio(self, terms: dict[str, float], design: Array) -> Array:
        """Ln conductance ratio were these terms and this design the truth. (n,)"""
        return hx.ln_conductance_ratio(correct_signals(self.signals, terms), design, self.bias)

    def left(self, terms: dict[str, float], design: Array) -> Array:
        """What changes from flight to flight beside that. (changes,)"""
        return np.asarray(np.diff(self.ratio(terms, design) + self.offset)[self.change])


class _Fit(NamedTuple):
    """Coefficients of terms, their sd, and the design that goes with them."""

    terms: dict[str, float]
    sd: Array
    design: Array


def propose(twin_flights: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Every term of the library that the model does not have yet, with its evidence.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights` with this model, over the baseline's flights, worn packs or not.

    Returns
    -------
    DataFrame
        By evidence: `term, meaning, value, sd, unit`; `f`, (value / sd)**2; `bic_gain`, f - ln n, the fall of BIC to
        second order (above 10 is strong);
        `held_out_change` (of the residual's rms on aircraft that neither coefficient nor design were learned from,
        relative to the model in service; blocks of flights where there are fewer than three aircraft);
        `loss_shift_sd`, what it moves a flight's loss by; `n` changes; `proposed`: the strongest term, if it passes the
        bars and lies within its bounds.
    """
    seen = _seen(twin_flights, dsm)
    names = [name for name in TERMS if name not in dsm.terms]
    if len(seen.fold) < LEAST_CHANGES:
        rows = [_row(name, None, (*(None,) * 4, len(seen.fold))) for name in names]
    else:
        rows = [_evidence(seen, dsm, name) for name in names]
    schema = {"term": pl.String, "meaning": pl.String, "value": pl.Float64, "sd": pl.Float64, "unit": pl.String}
    schema |= dict.fromkeys(("bic_gain", "f", "held_out_change", "loss_shift_sd"), pl.Float64) | {"n": pl.Int64}
    found = pl.DataFrame(rows, schema=schema, orient="row").sort("bic_gain", descending=True, nulls_last=True)
    bound = [value is not None and value in TERMS[name].bounds for name, value in found.select("term", "value").rows()]
    passes = (pl.col("bic_gain") > LEAST_BIC) & (pl.col("held_out_change") < -LEAST_GAIN) & ~pl.Series(bound)
    passes &= pl.col("value").abs() > LEAST_SDS * pl.col("sd")
    return found.with_columns(proposed=(pl.int_range(pl.len()) == 0) & passes.fill_null(False))


def coefficients(twin_flights: pl.DataFrame, dsm: Dsm, names: tuple[str, ...]) -> dict[str, float]:
    """Change of each accepted term's coefficient that the residuals ask for, all of them together."""
    seen = _seen(twin_flights, dsm)
    return dict.fromkeys(names, 0.0) if len(seen.fold) < LEAST_CHANGES else _fit(seen, dsm, names).terms


def _seen(twin_flights: pl.DataFrame, dsm: Dsm) -> _FlightSteps:
    rows = twin_flights.filter(pl.col("ln_ua_ratio").is_not_null()).drop_nulls(list(hx.SIGNALS)).sort(IN_ORDER)
    tail = pl.struct("operator", "tail").rank("dense").cast(pl.Int64) - 1
    rows = rows.with_columns(tail_index=tail).filter(
        pl.col("tail_index") % max(-(-rows.height // MOST_FLIGHTS), 1) == 0
    )
    signals = with_static_pressure({name: rows[name].cast(pl.Float64).to_numpy() for name in MEDIANS})
    here = hx.ln_conductance_ratio(signals, dsm.design, dsm.bias_of(rows))
    offset = rows["ln_ua_ratio"].cast(pl.Float64).to_numpy() - here
    pack = rows.select(pl.struct(PACK).rank("dense")).to_series().to_numpy().astype(int)
    change = (np.diff(pack) == 0) & np.isfinite(np.diff(offset))
    tails, n = rows["tail_index"].rank("dense").to_numpy().astype(int), rows.height
    fold = tails % FOLDS if len(np.unique(tails)) > 2 else np.arange(n) * FOLDS // max(n, 1)
    return _FlightSteps(signals, dsm.bias_of(rows), offset, change, fold[1:][change])


def _evidence(seen: _FlightSteps, dsm: Dsm, name: str) -> tuple[object, ...]:
    fit, n = _fit(seen, dsm, (name,)), len(seen.fold)
    f = float((fit.terms[name] / fit.sd[0]) ** 2)
    in_service = seen.left({}, dsm.design)
    limit = OUTLIER_SDS * spread(in_service)
    held_out = _rms(_left_out(seen, dsm, name), limit) / _rms(in_service, limit) - 1.0
    moved = np.nanstd(seen.ratio(fit.terms, fit.design) - seen.ratio({}, dsm.design))
    return _row(name, fit, (f - float(np.log(n)), f, held_out, float(moved), n))


def _row(name: str, fit: _Fit | None, evidence: tuple[object, ...]) -> tuple[object, ...]:
    term = TERMS[name]
    value, sd = (None, None) if fit is None else (fit.terms[name], float(fit.sd[0]))
    return (name, term.meaning, value, sd, term.unit, *evidence)


def _left_out(seen: _FlightSteps, dsm: Dsm, name: str) -> Array:
    """What is left of each change by term and design of the other folds. (changes,)"""
    left = np.empty(len(seen.fold))
    for fold in np.unique(seen.fold):
        out = seen.fold == fold
        fit = _fit(seen, dsm, (name,), ~out)
        left[out] = seen.left(fit.terms, fit.design)[out]
    return left


def _fit(seen: _FlightSteps, dsm: Dsm, names: tuple[str, ...], among: Array | None = None) -> _Fit:
    """Terms and design together, Gauss-Newton on the changes that the instruments explain (two-stage least squares)."""
    terms, design, sd = dict.fromkeys(names, 0.0), dsm.design, np.zeros(len(names))
    instruments = np.diff(instruments_of(seen.signals), axis=0)[seen.change]
    for _ in range(REFITS):
        columns, left = _columns(seen, terms, design), seen.left(terms, design)
        usable = np.isfinite(np.c_[columns, left]).all(axis=1) & (True if among is None else among)
        step, sd = _step(columns[usable], left[usable], instruments[usable], design)
        terms = {name: within(name, terms[name] + float(move)) for name, move in zip(names, step, strict=False)}
        design = np.clip(design + np.clip(step[len(names) :], -MAX_STEP, MAX_STEP), hx.LOW, hx.HIGH)
    return _Fit(terms, sd[: len(names)], design)


def _columns(seen: _FlightSteps, terms: dict[str, float], design: Array) -> Array:
    """What is left falls by these a unit of each term and design value. (changes, terms + design)"""
    met, here = correct_signals(seen.signals, terms), seen.ratio(terms, design)
    moved = [seen.ratio(terms | {name: value + STEP}, design) - here for name, value in terms.items()]
    by_design = design_gradient(met, design, seen.bias, here)
    every = np.c_[np.reshape(moved, (len(terms), len(here))).T / STEP, by_design]
    return np.asarray(-np.diff(every, axis=0)[seen.change])


def _step(columns: Array, left: Array, instruments: Array, design: Array) -> tuple[Array, Array]:
    """Huber's regression, the design under its prior and the terms (first) under none: move and sd of each."""
    explained = instruments @ np.linalg.lstsq(instruments, columns, rcond=None)[0]
    free = columns.shape[1] - len(design)
    prior, towards = np.r_[np.zeros(free), hx.SD**-2.0], np.r_[np.zeros(free), hx.MEAN - design]
    weight, scale = np.ones(len(left)), spread(left)
    for _ in range(ROBUST_STEPS):
        weighted = explained * weight[:, None] / (scale**2 * DESIGN_EFFECT)
        cov = np.linalg.pinv(weighted.T @ explained + np.diag(prior), hermitian=True)
        step = cov @ (weighted.T @ left + prior * towards)
        away = left - columns @ step
        scale = spread(away)
        weight = huber_weights(np.abs(away), scale, HUBER)
    return step, np.sqrt(cov.diagonal())


def _rms(left: Array, limit: float) -> float:
    """Root mean square, outliers held at `limit`."""
    return float(np.sqrt(np.nanmean(np.clip(left, -limit, limit) ** 2)))
