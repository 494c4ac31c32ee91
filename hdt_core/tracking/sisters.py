"""Pool the designs of a declared component's sister units: the clean level and the spread that other packs show.

A pack is calibrated on its own first flights, which can't tell a worn unit from a small one. Its sisters can: the
first flights of each, by the one declared design, scatter by what units differ and by what some had lost at entry.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.baseline_wear import clean_log_likelihood
from hdt_core.calibration.component_fit import design_prior, flight_by_flight
from hdt_core.components import Component
from hdt_core.physics.model import PhysicsModel, declared
from hdt_core.records.keys import LEG, PACK
from hdt_core.robust import median_error
from hdt_core.tracking.component import DesignOffset, entry_classes, wear_of, wear_size
from hdt_core.tracking.wear_model import UNIT_SD

FEWEST = 10
"""Flights that calibrate a pack at least, and show its level at first."""
WIDEST = -3.0
"""Lower bound of a loss judged by the declared design, which may be far smaller than the real one."""
SPREAD_SD, UNKNOWN_SPREAD_SD = 0.3, 0.7
"""Of ln of the spread between units, where it is declared and where not."""
SPREADS = np.linspace(-2.5, 2.5, 21)
"""Nodes of that spread, in its standard deviations."""
LEVELS, LEAST_REACH, REACH_SD = 201, 0.6, 4.0
"""Nodes of the clean level; how far they reach to either side at least, and in standard deviations of the sisters."""


class CleanLevel(NamedTuple):
    """Level of a clean unit by a pack's sisters, its sd, and the spread between units; ln, or the loss's unit."""

    level: float
    level_sd: float
    unit_sd: float


def level_name(component: Component) -> str:
    """Name the performance of a pack's first flights among its design parameters."""
    return f"{component.folder}_level"


def clean_levels(design: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Estimate the clean level and the spread of units for each pack, from all packs but itself.

    Parameters
    ----------
    design : DataFrame
        Table `calibration_components`, of the fleet.

    Returns
    -------
    DataFrame
        `PACK`, component, `level`, `level_sd`, `unit_sd`: all in the unit of the row `level_name`, ln of the
        performance over the declared design's where the loss is a share. No row of a pack without sisters.

    Notes
    -----
    As `baseline_wear.fleet_levels` for the exchanger. The pack itself is left out, for the filter compares its own
    flights with this level; how well these are known, given the errors of its sensors, is part of `level_sd`.
    """
    rows = design.filter(component=component.code, parameter=level_name(component)).sort(PACK)
    keys = [*PACK, "component"]
    if rows.height < 2:
        return rows.select(keys).clear().with_columns(pl.lit(0.0).alias(name) for name in CleanLevel._fields)
    size = wear_size(component, component.model.param(component.loss))
    expected = _expected_levels(rows["value"].to_numpy() / size, rows["sd"].to_numpy() / size, component, size)
    return rows.select(keys).with_columns(
        pl.Series(n, size * x) for n, x in zip(CleanLevel._fields, expected, strict=True)
    )


def _expected_levels(value: Array, error_sd: Array, component: Component, size: float) -> tuple[Array, Array, Array]:
    """Compute mean and sd of the clean level, and the spread's mean, by each unit's sisters. (n,) each"""
    declared = component.model.param(component.loss).unit_sd
    spread = (UNIT_SD if declared is None else declared) / size
    spread_sd = UNKNOWN_SPREAD_SD if declared is None else SPREAD_SD
    offset_sd = spread * np.exp(spread_sd * SPREADS)
    reach = max(LEAST_REACH, REACH_SD * float(np.std(value)))
    level = float(np.median(value)) + np.linspace(-reach, reach, LEVELS)
    share, wear, wear_sd = np.array([(e.share, e.wear, e.wear_sd) for e in entry_classes(component.new_share)]).T
    of_each = clean_log_likelihood(value, error_sd**2, level, offset_sd, share, wear, wear_sd**2)
    of_all = of_each.sum(axis=-1) - 0.5 * SPREADS[:, None] ** 2
    log = of_all - np.moveaxis(of_each, -1, 0)
    weight = np.exp(log - log.max(axis=(1, 2), keepdims=True))
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    of_level = weight.sum(axis=1)
    mean = of_level @ level
    variance = error_sd**2 + (of_level * (level - mean[:, None]) ** 2).sum(axis=1)
    return mean, np.sqrt(variance), weight.sum(axis=2) @ offset_sd


def first_level(samples: pl.DataFrame, model: PhysicsModel, cov: Array, component: Component) -> tuple[float, float]:
    """Estimate the level of a pack's first flights by the declared design: value and sd.

    Parameters
    ----------
    model : PhysicsModel
        Calibrated on the pack's flights, with the errors of its sensors.
    cov : array (p, p)
        Covariance of its design.
    """
    design = [p.name for p in component.model.free("design")]
    usual_wear = _first_wear(samples, model, component)
    nominal = {name: component.model.nominal[name] for name in design}
    wear = _first_wear(samples, model.calibrated(nominal), component)
    sd = np.sqrt(np.diag(cov))[: len(design)]
    top = np.array([model.param(name).bounds[1] for name in design])
    value = np.array([model.nominal[name] for name in design])
    step = np.where(value + sd > top, -sd, sd)
    moved = [model.calibrated({name: v}) for name, v in zip(design, (value + step).tolist(), strict=True)]
    shifts = np.array([np.median(_first_wear(samples, m, component) - usual_wear) for m in moved])
    correlation = cov[: len(design), : len(design)] / np.outer(step, step)
    known = wear[np.isfinite(wear)]
    scatter = float(np.std(known, ddof=1)) * median_error(float(len(known)))
    return -float(np.median(known)), float(np.sqrt(scatter**2 + shifts @ correlation @ shifts))


def design_offset(
    samples: pl.DataFrame, model: PhysicsModel, component: Component, sisters: CleanLevel | None = None
) -> DesignOffset:
    """Estimate the clean level's offset from a pack's calibrated design, by its first flights.

    The clean level is the declared design's, where it has a prior, and that of the sisters, each by its uncertainty.
    """
    prior = design_prior(component.model)
    if prior is None and sisters is None:
        return DesignOffset()
    usual_wear = _first_wear(samples, model, component)
    nominal = {p.name: p.nominal for p in component.model.free("design")}
    shift = float(np.median(_first_wear(samples, model.calibrated(nominal), component) - usual_wear))
    own = DesignOffset()
    if prior is not None:
        most = {p.name: min(p.nominal + declared(p.sd), p.bounds[1]) for p in model.free("design")}
        models = [model.calibrated({name: value}) for name, value in most.items()]
        shifts = [np.median(_first_wear(samples, m, component) - usual_wear) for m in models]
        own = DesignOffset(shift, float(np.linalg.norm(shifts)))
    return own if sisters is None else _pool(own, shift, sisters)


def _pool(own: DesignOffset, shift: float, sisters: CleanLevel) -> DesignOffset:
    """Weigh a pack's own offset and that by its sisters by their variances."""
    weight = own.sd**2 / (own.sd**2 + sisters.level_sd**2)
    pooled = (1.0 - weight) * own.shift + weight * (shift + sisters.level)
    return DesignOffset(pooled, float(np.sqrt(weight)) * sisters.level_sd, sisters.unit_sd)


def _first_wear(samples: pl.DataFrame, model: PhysicsModel, component: Component) -> Array:
    """Estimate the wear of a pack's first flights by a design of the component's model."""
    loss = component.model.param(component.loss)
    wide = replace(loss, bounds=(WIDEST, loss.bounds[1]))
    params = tuple(wide if p.name == loss.name else p for p in model.params)
    first = samples.select(LEG).unique(maintain_order=True).head(FEWEST)
    first_samples = samples.join(first, on=LEG, how="semi")
    losses = flight_by_flight(first_samples, replace(model, params=params), [loss.name])[loss.name].to_numpy()
    return wear_of(losses, losses, loss)[0]
