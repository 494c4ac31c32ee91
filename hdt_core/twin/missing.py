"""Missing physics: which term of a small library the residuals of nominal flights ask for, and how strongly.

Wear is slow and weather is not, so the change of the conductance from one flight of a pack to the next is held against
the change of each term. What another design would explain as well (film exponents, the duct's map) is granted to the
design first; what is left must be seen again on aircraft that the coefficient was not learned from. And as in the
calibration, flights are compared through instruments only, weather, level and demand: the door and the outlet answer to
the very conductance that is being explained.
"""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.physics.terms import TERMS, corrected
from hdt_core.twin import exchanger as hx
from hdt_core.twin.crossing import IN_ORDER, PACK, Array
from hdt_core.twin.dsm import Dsm
from hdt_core.twin.flights import MEDIANS, design_gradient
from hdt_core.twin.hierarchy import instruments_of

STEP = 1e-3
HUBER, ROBUST_STEPS = 2.0, 10
LEAST_CHANGES, LEAST_GAIN, LEAST_BIC, LEAST_SDS = 60, 0.1, 6.0, 4.0
"""Proposed from so many changes on, where residuals of aircraft left out shrink by this share, BIC by this much, and
the coefficient is so many standard deviations from 0."""
FOLDS = 5


class Changes(NamedTuple):
    """Changes between neighbouring flights of a pack: ln ratio (n,), design (n, p) and terms (n, q); fold (n,).

    `design` and `terms` as far as the instruments explain them; `whole_design`, `whole_terms` as they were.
    """

    ratio: Array
    design: Array
    terms: Array
    whole_design: Array
    whole_terms: Array
    fold: Array


class Fit(NamedTuple):
    """Coefficient of a term and its sd, and the sum of squares with and without it, outliers held down."""

    value: float
    sd: float
    with_term: float
    without: float


def propose(twin_flights: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Every term of the library that the model does not have yet, with its evidence.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights` with this model, over nominal flights: the baseline.

    Returns
    -------
    DataFrame
        By evidence: `term, meaning, value, sd, unit`; `bic_gain` (fall of BIC, above 10 is strong); `f`, the F ratio;
        `held_out_change` (relative change of the residual's rms on aircraft that the coefficient was not learned from;
        blocks of flights where there are fewer than three aircraft); `loss_shift_sd`, what it moves a flight's loss by;
        `n` changes; `proposed`: the strongest term, if it passes the bars.
    """
    names = [name for name in TERMS if name not in dsm.terms]
    changes, shift = _changes(twin_flights, dsm, names)
    rows = [_row(name, changes, k, shift[k]) for k, name in enumerate(names)]
    schema = {"term": pl.String, "meaning": pl.String, "value": pl.Float64, "sd": pl.Float64, "unit": pl.String}
    schema |= dict.fromkeys(("bic_gain", "f", "held_out_change", "loss_shift_sd"), pl.Float64) | {"n": pl.Int64}
    found = pl.DataFrame(rows, schema=schema, orient="row").sort("bic_gain", descending=True, nulls_last=True)
    enough = (pl.col("n") >= LEAST_CHANGES) & (pl.col("bic_gain") > LEAST_BIC)
    passes = enough & (pl.col("held_out_change") < -LEAST_GAIN) & (pl.col("value").abs() > LEAST_SDS * pl.col("sd"))
    return found.with_columns(proposed=(pl.int_range(pl.len()) == 0) & passes.fill_null(False))


def coefficients(twin_flights: pl.DataFrame, dsm: Dsm, names: tuple[str, ...]) -> dict[str, float]:
    """Change of each accepted term's coefficient that the residuals ask for, one after the other."""
    changes, _ = _changes(twin_flights, dsm, list(names))
    if len(changes.ratio) < LEAST_CHANGES:
        return dict.fromkeys(names, 0.0)
    joint = _robust(np.c_[changes.terms, changes.design], changes.ratio, len(names))[0]
    return dict(zip(names, map(float, joint[: len(names)]), strict=True))


def _changes(twin_flights: pl.DataFrame, dsm: Dsm, names: list[str]) -> tuple[Changes, Array]:
    rows = twin_flights.filter(pl.col("ln_ua_ratio").is_not_null()).drop_nulls(list(hx.SIGNALS)).sort(IN_ORDER)
    signals = {name: rows[name].cast(pl.Float64).to_numpy() for name in MEDIANS}
    bias = dsm.bias_of(rows)
    here = hx.ln_conductance_ratio(signals, dsm.design, bias)
    design = design_gradient(signals, dsm.design, bias, here)
    effect = [(hx.ln_conductance_ratio(corrected(signals, {n: STEP}), dsm.design, bias) - here) / STEP for n in names]
    terms = -np.array(effect).reshape(len(names), len(here)).T
    pack = rows.select(pl.struct(PACK).rank("dense"))[:, 0].to_numpy().astype(int) if rows.height else np.zeros(0, int)
    tail = rows.select(pl.struct("operator", "tail").rank("dense"))[:, 0].to_numpy().astype(int)
    own = np.diff(pack, prepend=-1)[1:] == 0
    seen = rows["ln_ua_ratio"].to_numpy().astype(float)
    parts = [np.diff(x, axis=0)[own] for x in (seen, design, terms, instruments_of(signals))]
    fold = tail if len(np.unique(tail)) > 2 else np.arange(len(tail)) * FOLDS // max(len(tail), 1)
    usable = np.isfinite(np.c_[parts[0], parts[1], parts[2]]).all(axis=1)
    change, by_design, by_terms, instruments, fold = (x[usable] for x in (*parts, fold[1:][own]))
    explained = [instruments @ np.linalg.lstsq(instruments, x, rcond=None)[0] for x in (by_design, by_terms)]
    shift = np.nanstd(terms, axis=0) if len(terms) else np.zeros(len(names))
    return Changes(change, explained[0], explained[1], by_design, by_terms, fold), shift


def _row(name: str, changes: Changes, k: int, shift: float) -> tuple[object, ...]:
    term, n = TERMS[name], len(changes.ratio)
    if n < LEAST_CHANGES:
        return (name, term.meaning, None, None, term.unit, None, None, None, None, n)
    fit = _fit(changes.terms[:, k], changes.design, changes.ratio)
    bic = n * np.log(fit.without / fit.with_term) - np.log(n)
    f = (fit.without - fit.with_term) / (fit.with_term / (n - changes.design.shape[1] - 1))
    moved = abs(fit.value) * float(shift)
    evidence = (float(bic), float(f), _held_out(changes, k), moved)
    return (name, term.meaning, fit.value, fit.sd, term.unit, *evidence, n)


def _held_out(changes: Changes, k: int) -> float:
    """Relative change of the residual's robust rms where neither design nor coefficient was learned."""
    left = np.empty((2, len(changes.ratio)))
    for fold in np.unique(changes.fold):
        out = changes.fold == fold
        for with_term in (0, 1):
            columns = np.c_[changes.terms[:, [k] * with_term], changes.design]
            learned, _, _ = _robust(columns[~out], changes.ratio[~out], with_term)
            whole = np.c_[changes.whole_terms[:, [k] * with_term], changes.whole_design]
            left[with_term, out] = changes.ratio[out] - whole[out] @ learned
    limit = 4.0 * 1.4826 * np.median(np.abs(left[0]))
    rms = np.sqrt(np.mean(np.clip(left, -limit, limit) ** 2, axis=1))
    return float(rms[1] / rms[0] - 1.0)


def _fit(term: Array, design: Array, ratio: Array) -> Fit:
    learned, cov, weight = _robust(np.c_[term, design], ratio, 1)
    held = [np.c_[term, design] @ learned, design @ _solve(design, ratio, weight, 0)[0]]
    squares = [float(np.sum(weight * (ratio - x) ** 2)) for x in held]
    return Fit(float(learned[0]), float(np.sqrt(cov[0, 0])), squares[0], squares[1])


def _robust(columns: Array, ratio: Array, free: int) -> tuple[Array, Array, Array]:
    """Huber's regression; the first `free` columns have no prior, the rest that of the design. Values, cov, weights."""
    weight = np.ones(len(ratio))
    for _ in range(ROBUST_STEPS):
        learned, cov = _solve(columns, ratio, weight, free)
        away = np.abs(ratio - columns @ learned)
        scale = 1.4826 * np.median(away) + 1e-12
        weight = 1.0 / np.maximum(1.0, away / (HUBER * scale))
    return learned, cov * scale**2, weight


def _solve(columns: Array, ratio: Array, weight: Array, free: int) -> tuple[Array, Array]:
    prior = np.r_[np.zeros(free), hx.SD[: columns.shape[1] - free] ** -2.0] * (np.median(np.abs(ratio)) * 1.4826) ** 2
    normal = (columns * weight[:, None]).T @ columns + np.diag(prior)
    inverse = np.linalg.pinv(normal)
    return inverse @ (columns.T @ (weight * ratio)), inverse
