"""Detect missing physics: rank terms of a small library by their evidence in the residuals.

Wear is slow and weather is not, so what is explained is the change of the conductance from one flight of a pack to the
next, worn packs included. Term and design are refitted together, for the design of a model without a
term is biased; and as in the calibration, flights are compared by instrumental variables, weather, level and demand,
for door and outlet depend on the conductance. The criterion is the residual on held-out aircraft, compared with that of
the model in service.
"""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Array
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.exchanger import DESIGN_EFFECT, instruments_of
from hdt_core.calibration.flight_estimates import MEDIANS
from hdt_core.estimation.panel import MAX_STEP
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
"""Enough for the test: from a larger fleet every second, third, ... aircraft is taken."""


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
        """Compute the ln conductance ratio with these terms and this design. (n,)"""
        return hx.ln_conductance_ratio(correct_signals(self.signals, terms), design, self.bias)

    def residual(self, terms: dict[str, float], design: Array) -> Array:
        """Compute changes from flight to flight that these leave unexplained. (changes,)"""
        return np.asarray(np.diff(self.ratio(terms, design) + self.offset)[self.change])


class _Fit(NamedTuple):
    """Coefficients of terms, their sd, and the design that goes with them."""

    terms: dict[str, float]
    sd: Array
    design: Array


def propose(twin_flights: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Rank the library's terms that the model does not have yet.

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
    steps = _flight_steps(twin_flights, dsm)
    names = [name for name in TERMS if name not in dsm.terms]
    if len(steps.fold) < LEAST_CHANGES:
        rows = [_row(name, None, (*(None,) * 4, len(steps.fold))) for name in names]
    else:
        rows = [_evidence(steps, dsm, name) for name in names]
    schema = {"term": pl.String, "meaning": pl.String, "value": pl.Float64, "sd": pl.Float64, "unit": pl.String}
    schema |= dict.fromkeys(("bic_gain", "f", "held_out_change", "loss_shift_sd"), pl.Float64) | {"n": pl.Int64}
    evidence = pl.DataFrame(rows, schema=schema, orient="row").sort("bic_gain", descending=True)
    is_at_bound = [v is not None and v in TERMS[name].bounds for name, v in evidence.select("term", "value").rows()]
    passes = (pl.col("bic_gain") > LEAST_BIC) & (pl.col("held_out_change") < -LEAST_GAIN) & ~pl.Series(is_at_bound)
    passes &= pl.col("value").abs() > LEAST_SDS * pl.col("sd")
    return evidence.with_columns(proposed=(pl.int_range(pl.len()) == 0) & passes.fill_null(False))


def coefficients(twin_flights: pl.DataFrame, dsm: Dsm, names: tuple[str, ...]) -> dict[str, float]:
    """Estimate the change of each accepted term's coefficient from the residuals, all of them together."""
    steps = _flight_steps(twin_flights, dsm)
    return dict.fromkeys(names, 0.0) if len(steps.fold) < LEAST_CHANGES else _fit(steps, dsm, names).terms


def _flight_steps(twin_flights: pl.DataFrame, dsm: Dsm) -> _FlightSteps:
    rows = twin_flights.filter(pl.col("ln_ua_ratio").is_not_null()).drop_nulls(list(hx.SIGNALS)).sort(IN_ORDER)
    tail = pl.struct("operator", "tail").rank("dense").cast(pl.Int64) - 1
    rows = rows.with_columns(tail_index=tail).filter(
        pl.col("tail_index") % max(-(-rows.height // MOST_FLIGHTS), 1) == 0
    )
    signals = with_static_pressure({name: rows[name].cast(pl.Float64).to_numpy() for name in MEDIANS})
    ratio = hx.ln_conductance_ratio(signals, dsm.design, dsm.bias_of(rows))
    offset = rows["ln_ua_ratio"].cast(pl.Float64).to_numpy() - ratio
    pack = rows.select(pl.struct(PACK).rank("dense")).to_series().to_numpy().astype(int)
    change = (np.diff(pack) == 0) & np.isfinite(np.diff(offset))
    tails = rows["tail_index"].rank("dense").to_numpy().astype(int)
    n = rows.height
    fold = tails % FOLDS if len(np.unique(tails)) > 2 else np.arange(n) * FOLDS // max(n, 1)
    return _FlightSteps(signals, dsm.bias_of(rows), offset, change, fold[1:][change])


def _evidence(steps: _FlightSteps, dsm: Dsm, name: str) -> tuple[object, ...]:
    fit = _fit(steps, dsm, (name,))
    n = len(steps.fold)
    f = float((fit.terms[name] / fit.sd[0]) ** 2)
    in_service = steps.residual({}, dsm.design)
    limit = OUTLIER_SDS * spread(in_service)
    held_out = _rms(_left_out(steps, dsm, name), limit) / _rms(in_service, limit) - 1.0
    shift_sd = np.nanstd(steps.ratio(fit.terms, fit.design) - steps.ratio({}, dsm.design))
    return _row(name, fit, (f - float(np.log(n)), f, held_out, float(shift_sd), n))


def _row(name: str, fit: _Fit | None, evidence: tuple[object, ...]) -> tuple[object, ...]:
    term = TERMS[name]
    value, sd = (None, None) if fit is None else (fit.terms[name], float(fit.sd[0]))
    return (name, term.meaning, value, sd, term.unit, *evidence)


def _left_out(steps: _FlightSteps, dsm: Dsm, name: str) -> Array:
    """Compute residuals by term and design of the other folds. (changes,)"""
    residual = np.empty(len(steps.fold))
    for fold in np.unique(steps.fold):
        out = steps.fold == fold
        fit = _fit(steps, dsm, (name,), ~out)
        residual[out] = steps.residual(fit.terms, fit.design)[out]
    return residual


def _fit(steps: _FlightSteps, dsm: Dsm, names: tuple[str, ...], among: Array | None = None) -> _Fit:
    """Fit terms and design together by Gauss-Newton on instrumental variables (two-stage least squares)."""
    terms = dict.fromkeys(names, 0.0)
    design = dsm.design
    sd = np.zeros(len(names))
    instruments = np.diff(instruments_of(steps.signals), axis=0)[steps.change]
    for _ in range(REFITS):
        columns = _columns(steps, terms, design)
        residual = steps.residual(terms, design)
        usable = np.isfinite(np.c_[columns, residual]).all(axis=1) & (True if among is None else among)
        step, sd = _step(columns[usable], residual[usable], instruments[usable], design)
        terms = {name: within(name, terms[name] + float(move)) for name, move in zip(names, step, strict=False)}
        design = np.clip(design + np.clip(step[len(names) :], -MAX_STEP, MAX_STEP), hx.LOW, hx.HIGH)
    return _Fit(terms, sd[: len(names)], design)


def _columns(steps: _FlightSteps, terms: dict[str, float], design: Array) -> Array:
    """Compute negative derivatives of the residual by each term and design value. (changes, terms + design)"""
    signals = correct_signals(steps.signals, terms)
    ratio = steps.ratio(terms, design)
    by_term = [steps.ratio(terms | {name: value + STEP}, design) - ratio for name, value in terms.items()]
    by_design = hx.design_gradient(signals, design, steps.bias, ratio)
    derivatives = np.c_[np.reshape(by_term, (len(terms), len(ratio))).T / STEP, by_design]
    return np.asarray(-np.diff(derivatives, axis=0)[steps.change])


def _step(columns: Array, residual: Array, instruments: Array, design: Array) -> tuple[Array, Array]:
    """Solve Huber's regression, with the design's prior and none for the terms (first): step and sd of each."""
    predictors = instruments @ np.linalg.lstsq(instruments, columns, rcond=None)[0]
    free = columns.shape[1] - len(design)
    prior = np.r_[np.zeros(free), hx.SD**-2.0]
    offset = np.r_[np.zeros(free), hx.MEAN - design]
    weight = np.ones(len(residual))
    scale = spread(residual)
    for _ in range(ROBUST_STEPS):
        information = (predictors * weight[:, None] / (scale**2 * DESIGN_EFFECT)).T
        cov = np.linalg.pinv(information @ predictors + np.diag(prior), hermitian=True)
        step = cov @ (information @ residual + prior * offset)
        error = residual - columns @ step
        scale = spread(error)
        weight = huber_weights(np.abs(error), scale, HUBER)
    return step, np.sqrt(cov.diagonal())


def _rms(residual: Array, limit: float) -> float:
    """Compute the root mean square, with outliers clipped at `limit`."""
    return float(np.sqrt(np.nanmean(np.clip(residual, -limit, limit) ** 2)))
