"""Check the redundant outputs of a declared component by its equations, and correct its loss for a sensor's shift.

A loss moves all outputs as the equations say: both outlets of an exchanger keep its heat balance. What remains after
the loss is fitted can't be wear. Where it has left its usual level, a sensor has shifted, and the loss with it.
"""

from typing import Any, NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.component_fit import WITHOUT_ESTIMATE, recorded_outputs
from hdt_core.components import Component
from hdt_core.physics.model import PhysicsModel, declared
from hdt_core.records.keys import FLIGHT_PACK
from hdt_core.robust import MAD_TO_SD, median_error

USUAL_FLIGHTS, SMOOTHED_FLIGHTS = 20, 7
"""First flights whose median is a check's usual level; flights of its running median."""
GATE_SD = 4.0
"""Deviations of the running median's noise, and the half of a declared sensor error, beyond which a check has left."""
LEAST_SHARE = 0.5
STEP, LEAST_VAR = 1e-4, 1e-12


class _Slopes(NamedTuple):
    """Derivatives of the outputs, each over its sigma, by the loss (m,) and by the sensors' errors over their sd."""

    by_loss: Array
    by_error: Array


def sensor_shifts(
    flights: pl.DataFrame, samples: pl.DataFrame, model: PhysicsModel, component: Component
) -> pl.DataFrame:
    r"""Estimate what shifted sensors do to the loss of each flight of one pack.

    Parameters
    ----------
    flights : DataFrame
        Of `flight_by_flight`, in order.
    samples : DataFrame
        Of these flights.
    model : PhysicsModel
        The pack's, calibrated.

    Returns
    -------
    DataFrame
        `flights` with `sensor_shift` of the loss and `sensor_shift_sd`, both 0 where no check has left its level or
        no output is redundant: with one output, or several health parameters. A flight's follow from those before it.

    Notes
    -----
    The outputs alone can't tell which of two outlets is off: one feigns wear, the other the contrary. But the loss
    made a step when the check left its level, and wear seldom does just then. With errors e of covariance S, declared
    or as large as the check shows, and y their traces H e in residuals and loss with noise R:

    .. math:: e \mid y \sim N(S H^T (H S H^T + R)^{-1} y, \; S - S H^T (H S H^T + R)^{-1} H S)
    """
    outputs = recorded_outputs(model, samples)
    none = flights.with_columns(sensor_shift=pl.lit(0.0), sensor_shift_sd=pl.lit(0.0))
    n_known = flights.filter(~pl.col("status").is_in(WITHOUT_ESTIMATE)).height
    if len(outputs) < 2 or len(model.free("health")) > 1 or n_known <= USUAL_FLIGHTS:
        return none
    rows = samples.join(flights.select(*FLIGHT_PACK, component.loss), on=FLIGHT_PACK, validate="m:1")
    off, noise_var = _departure(_residuals(rows, flights, model, outputs, component))
    evidence = _evidence(_slopes(rows, model, outputs, component))
    inverse = np.linalg.pinv(evidence[:-1] @ evidence[:-1].T, rcond=1e-6, hermitian=True)
    size = np.einsum("ki,ij,kj->k", off, inverse, off)
    has_left = ((off**2).sum(axis=1) > GATE_SD**2 * noise_var.sum()) & (size > LEAST_SHARE**2)
    loss = flights[component.loss].to_numpy()
    usual_rate = component.limit.mean / component.life_flights
    shift = np.zeros(flights.height)
    shift_sd = np.zeros(flights.height)
    onset = 0
    for k in np.flatnonzero(has_left):
        onset = onset if has_left[k - 1] else int(k)
        step, step_var = _step(loss, onset, int(k), usual_rate)
        seen = np.r_[off[k], step]
        seen_var = np.r_[noise_var, step_var]
        shift[k], shift_sd[k] = _attribute(evidence, seen, seen_var, max(float(size[k]), 1.0))
    return none.with_columns(sensor_shift=pl.Series(shift), sensor_shift_sd=pl.Series(shift_sd))


def _evidence(slopes: _Slopes) -> Array:
    """Compute what each sensor's error leaves in the outputs after the fit, and what it adds to the loss. (m + 1, e)"""
    gain = slopes.by_loss / (slopes.by_loss @ slopes.by_loss)
    of_loss = gain @ slopes.by_error
    return np.vstack([slopes.by_error - np.outer(slopes.by_loss, of_loss), of_loss])


def _attribute(evidence: Array, seen: Array, seen_var: Array, size: float) -> tuple[float, float]:
    """Compute what the sensors' errors, of variance `size`, add to the loss: mean and sd, given what is seen."""
    cov = size * evidence @ evidence.T
    gain = np.linalg.solve(cov + np.diag(seen_var), cov[:, -1])
    variance = cov[-1, -1] - gain @ cov[:, -1]
    return float(gain @ seen), float(np.sqrt(max(variance, 0.0)))


def _step(loss: Array, onset: int, now: int, usual_rate: float) -> tuple[float, float]:
    """Compute the loss's step where a check left its level, beyond its usual growth, and its variance.

    The running median tells a step half its length late; a sensor's error came then, and wear hardly did.
    """
    came = max(onset - SMOOTHED_FLIGHTS // 2, 1)
    before = loss[max(came - USUAL_FLIGHTS, 0) : came]
    after = loss[came : min(now, onset + USUAL_FLIGHTS) + 1]
    growth = usual_rate * 0.5 * (len(before) + len(after))
    scatter_var = (MAD_TO_SD * np.nanmedian(np.abs(np.diff(loss[: now + 1])))) ** 2 / 2.0
    variance = growth**2 + scatter_var * (median_error(float(len(before))) ** 2 + median_error(float(len(after))) ** 2)
    return float(np.nanmedian(after) - np.nanmedian(before)) - growth, float(variance)


def _residuals(
    rows: pl.DataFrame, flights: pl.DataFrame, model: PhysicsModel, outputs: list[str], component: Component
) -> Array:
    """Compute each flight's mean residual of every output, sensor less twin, over its sigma. (flights, m)"""
    inputs = {s.name: rows[s.name].to_numpy() for s in model.inputs}
    twin = model.predict({component.loss: rows[component.loss].to_numpy()}, inputs)
    sigma = {name: declared(model.signal(name).sigma) for name in outputs}
    off = [pl.Series(name, (rows[name].to_numpy() - twin[name]) / sigma[name]) for name in outputs]
    means = rows.with_columns(off).group_by(FLIGHT_PACK).agg(pl.col(outputs).mean())
    joined = flights.select(*FLIGHT_PACK, "status").join(
        means, on=FLIGHT_PACK, how="left", maintain_order="left", validate="1:1"
    )
    known = pl.when(~pl.col("status").is_in(WITHOUT_ESTIMATE)).then(pl.col(outputs))
    return joined.select(known).to_numpy().astype(float)


def _slopes(rows: pl.DataFrame, model: PhysicsModel, outputs: list[str], component: Component) -> _Slopes:
    """Compute the mean derivatives over the pack's samples."""
    inputs = {s.name: rows[s.name].to_numpy() for s in model.inputs}
    loss = rows[component.loss].to_numpy()
    sigma = np.array([declared(model.signal(name).sigma) for name in outputs])

    def over_sigma(change: dict[str, Any]) -> Array:
        predicted = model.predict({component.loss: loss, **change}, inputs)
        means = [float(np.nanmean(predicted[name])) for name in outputs]
        change_over_sigma: Array = np.array(means) / sigma
        return change_over_sigma

    usual = over_sigma({})
    by_loss = (over_sigma({component.loss: loss + STEP}) - usual) / STEP
    own = {p.name for p in component.model.params}
    errors = [p for p in model.free("design") if p.name not in own]
    moved = [over_sigma({p.name: p.nominal + STEP * declared(p.sd)}) for p in errors]
    by_error = [(x - usual) / STEP for x in moved] or list(np.eye(len(outputs)))
    return _Slopes(by_loss, np.array(by_error).T)


def _departure(residual: Array) -> tuple[Array, Array]:
    """Compute how far the running median lies from the usual level, (k, m), and the variance of its noise, (m,)."""
    known = residual[np.isfinite(residual).all(axis=1)]
    usual = np.median(known[:USUAL_FLIGHTS], axis=0)
    names = [f"{j}" for j in range(residual.shape[1])]
    frame = pl.DataFrame(residual - usual, schema=names).fill_nan(None).fill_null(strategy="forward").fill_null(0.0)
    smooth = frame.select(pl.col(names).rolling_median(SMOOTHED_FLIGHTS, min_samples=SMOOTHED_FLIGHTS)).fill_null(0.0)
    steps = np.diff(frame.to_numpy(), axis=0)
    flight_var = ((MAD_TO_SD * np.median(np.abs(steps), axis=0)) ** 2) / 2.0
    noise_var = flight_var * (median_error(float(SMOOTHED_FLIGHTS)) ** 2 + median_error(float(USUAL_FLIGHTS)) ** 2)
    return smooth.to_numpy(), np.maximum(noise_var, LEAST_VAR)
