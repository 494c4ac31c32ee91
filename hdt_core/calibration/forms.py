"""Rank forms of equation (6): constant, line, and higher polynomials of the diffuser's position."""

from dataclasses import dataclass

import numpy as np

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.diffuser_line import BlockRows
from hdt_core.robust import group_means

FOLDS, RESAMPLES = 5, 200
FORMS = {"constant": 0, "linear": 1, "quadratic": 2, "cubic": 3}
MOST_SAMPLES = 60_000


@dataclass(frozen=True, slots=True)
class FormFit:
    """One form of equation (6): a polynomial of the diffuser's position of this degree, levels apart.

    Attributes
    ----------
    cv_mae_m, cv_rmse_m : float
        Error of held-out flights, five folds.
    aic : float
        Akaike's criterion, above that of the best form.
    r_squared, r_squared_low, r_squared_high : float
        Explained share of the variance about the levels, with a 95 % interval (flights resampled).
    """

    form: str
    cv_mae_m: float
    cv_rmse_m: float
    aic: float
    r_squared: float
    r_squared_low: float
    r_squared_high: float


def compare_forms(rows: BlockRows) -> tuple[FormFit, ...]:
    """Compare constant, linear, quadratic and cubic forms by error on held-out flights and by AIC.

    Errors are those of one sample against the curve at its pack's level, estimated from the other flights. Empty where
    there are fewer flights than folds.
    """
    rows = _thin(rows)
    n_flights = int(rows.flight.max()) + 1
    if n_flights < FOLDS:
        return ()
    z = (rows.x - rows.x.mean()) / max(float(rows.x.std()), 1e-9)
    fold = (np.cumsum(np.r_[0, np.diff(rows.flight) != 0])) % FOLDS
    rng = np.random.default_rng(0)
    picks = rng.multinomial(n_flights, np.full(n_flights, 1.0 / n_flights), RESAMPLES).astype(float)
    picks = picks[picks.any(axis=1)]  # of two flights a resample may hold none
    scores, aics = [], []
    for form, degree in FORMS.items():
        basis = np.stack([z**k for k in range(1, degree + 1)], axis=1) if degree else np.zeros((len(z), 0))
        prediction = np.full(len(z), np.nan)
        for k in range(FOLDS):
            prediction[fold == k] = _predict(rows, basis, fold != k)[fold == k]
        error = rows.y - prediction
        error = error[np.isfinite(error)]
        about, rest = (rows.y - _predict(rows, b, np.ones(len(z), dtype=bool)) for b in (basis[:, :0], basis))
        parts = (picks @ np.bincount(rows.flight, v**2) for v in (rest, about))
        low, high = np.quantile(1.0 - np.divide(*parts), [0.025, 0.975])
        share = 1.0 - float((rest**2).sum() / (about**2).sum())
        aics.append(len(z) * float(np.log((rest**2).mean())) + 2.0 * (degree + len(rows.blocks)))
        scores.append((form, float(np.abs(error).mean()), float(np.sqrt((error**2).mean())), share, low, high))
    return tuple(
        FormFit(form, mae, rmse, aic - min(aics), share, float(low), float(high))
        for (form, mae, rmse, share, low, high), aic in zip(scores, aics, strict=True)
    )


def _thin(rows: BlockRows) -> BlockRows:
    """Select whole flights evenly, up to a number of samples that suffices to rank forms."""
    step = max(1, len(rows.x) // MOST_SAMPLES)
    mask = rows.flight % step == 0
    flight = np.unique(rows.flight[mask], return_inverse=True)[1]
    numbers, block = np.unique(rows.block[mask], return_inverse=True)
    return BlockRows(rows.x[mask], rows.y[mask], block, flight, rows.blocks[numbers.tolist()])


def _predict(rows: BlockRows, basis: Array, use: Array) -> Array:
    """Predict by least squares on `use`, with a level for each block; NaN where a block has none."""
    columns = np.column_stack([rows.y, basis])
    means, n = group_means(columns, rows.block, use.astype(float))
    means[n < 1.0] = np.nan
    deviations = columns - means[rows.block]
    slopes = np.linalg.lstsq(deviations[use, 1:], deviations[use, 0], rcond=None)[0]
    return np.asarray(means[rows.block, 0] + deviations[:, 1:] @ slopes)
