"""Twins of declared components: calibrate each pack's first unit, then track every flight's health."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
from scipy.stats import median_abs_deviation

from hdt_core.calibration.arrays import Array
from hdt_core.components import Component
from hdt_core.flight.bleed import reject_odd_bleed
from hdt_core.flight.component_legs import LEG, NO_EVIDENCE, component_legs, component_samples
from hdt_core.physics.model import PhysicsModel, declared
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import number_units, select_entries
from hdt_core.tracking.component import (
    SAYS_NOTHING,
    DesignOffset,
    calibrate_component,
    design_prior,
    track_component,
    wear_of,
)
from hdt_core.tracking.component_readings import HEALTH, ONE_OR_MORE, component_readings
from hdt_core.tracking.flight_panel import health_rows
from hdt_core.tracking.sequential import flight_by_flight

MOST, FEWEST, SHARE_OF_LIFE = 100, 10, 0.1
"""Steady flights of a pack's first unit on which it is taken to be as built: a tenth of its life, within limits."""
STRAY_SD = 5.0
"""Standard deviations from the commissioning median at which a flight is no flight of the part as built."""
WIDEST = -3.0
"""Lower bound of a loss judged by the declared design, which may be far smaller than the real one."""
NEAR_BOUND = 1e-3
"""Share of a loss's span that counts as its bound."""
KEYS = [*PACK, "component"]


def commission(
    signals: pl.DataFrame, maintenance: pl.DataFrame, component: Component, reports: pl.DataFrame | None = None
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Classify the legs of a component and calibrate each pack on its first steady flights.

    Parameters
    ----------
    signals : DataFrame
        Long form, see `component_samples`; whole histories of some aircraft.
    maintenance : DataFrame
        Their log: flights about work on the component are left out, and those after it belong to another unit.
    reports : DataFrame, optional
        Heads of printed reports, table `raw_reports`; they count for a component that bleed air feeds.

    Returns
    -------
    legs : DataFrame
        As of `component_legs`; reasons of the second level beside.
    design : DataFrame
        Long form: `KEYS`, parameter, value, sd, unit, n_flights, identifiable, dsm_version. Of a pack that was not
        commissioned the declared prior, which rests on 0 flights, or none where the declaration has no prior.
    """
    samples = component_samples(signals, component)
    legs = component_legs(samples, component)
    if component.bleed_air and reports is not None:
        legs = reject_odd_bleed(legs, reports)
    first_flights = _as_built(legs, maintenance, component)
    strays, rows = [], []
    for pack, flights in first_flights.group_by(PACK, maintain_order=True):
        stray, design = _calibrated(samples.join(flights, on=LEG, how="semi").filter("nominal"), component)
        strays.append(stray)
        rows += [(*pack, component.code, *row) for row in design]
    packs = legs.filter(~pl.col("reason").is_in(NO_EVIDENCE)).select(PACK).unique(maintain_order=True)
    commissioned = {row[:3] for row in rows}
    prior = [(*p, component.code, *row) for p in packs.rows() if p not in commissioned for row in _prior(component)]
    return _second_level(legs, strays, rows), pl.DataFrame(rows + prior, schema=_DESIGN, orient="row")


def _prior(component: Component) -> list[tuple[object, ...]]:
    """Return the declared design as rows; none where a parameter has no standard deviation."""
    if design_prior(component.model) is None:
        return []
    version = f"prior {component.version}"
    return [(p.name, p.nominal, p.sd, p.unit, 0, False, version) for p in component.model.free("design")]


_DESIGN: dict[str, Any] = {
    "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String, "parameter": pl.String,
    "value": pl.Float64, "sd": pl.Float64, "unit": pl.String, "n_flights": pl.Int64, "identifiable": pl.Boolean,
    "dsm_version": pl.String,
}  # fmt: skip


def _as_built(legs: pl.DataFrame, maintenance: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Select the first steady flights of each pack's first unit, without those before work on it."""
    lives = number_units(legs, maintenance, component.code, "life", component.ended_by)
    first = lives.filter(pl.col("life") == 0).sort("departed_at", "flight_id")
    packs = select_entries(maintenance, (component.code,), component.ended_by).select(PACK).unique()
    last = first.join(packs, on=PACK, how="semi").group_by(PACK).tail(component.around_work[0])
    steady = first.join(last, on=LEG, how="anti").filter(pl.col("reason") == "")
    n_flights = int(np.clip(SHARE_OF_LIFE * component.life_flights, FEWEST, MOST))
    return steady.group_by(PACK, maintain_order=True).head(n_flights)


def _calibrated(samples: pl.DataFrame, component: Component) -> tuple[pl.DataFrame, list[tuple[object, ...]]]:
    """Find outlying flights, and calibrate one pack's design as rows; none where the flights do not determine it."""
    none = samples.select(LEG).clear()
    if samples.select(pl.struct(LEG).n_unique()).item() < FEWEST:
        return none, []
    try:
        first, _ = calibrate_component(component.model, samples)
        flights = flight_by_flight(samples, first, [p.name for p in component.model.free("health")])
        stray = _strays(flights, component.loss)
        regular = samples.join(stray, on=LEG, how="anti")
        dsm, estimate = calibrate_component(component.model, regular)
    except ValueError:  # the flights do not determine the design: NOT_COMMISSIONED
        return none, []
    n_flights = regular.select(pl.struct(LEG).n_unique()).item()
    params = zip(component.model.free("design"), estimate.belief.sd.tolist(), strict=True)
    version = hashlib.blake2b(f"{component.version} {dsm.nominal}".encode(), digest_size=6).hexdigest()
    return stray, [
        (p.name, dsm.nominal[p.name], sd, p.unit, n_flights, p.name not in estimate.weak, version) for p, sd in params
    ]


def _strays(flights: pl.DataFrame, loss: str) -> pl.DataFrame:
    """Select flights whose loss is far from the median."""
    losses = flights[loss].to_numpy()
    sd = float(median_abs_deviation(losses, scale="normal", nan_policy="omit"))
    far = (pl.col(loss) - pl.col(loss).median()).abs() > STRAY_SD * max(sd, 1e-9)
    return flights.filter(far).select(LEG)


def _second_level(legs: pl.DataFrame, strays: list[pl.DataFrame], rows: list[tuple[object, ...]]) -> pl.DataFrame:
    """Add reasons of the second level; `admitted` where there is none."""
    commissioned = pl.DataFrame(
        [row[:3] for row in rows], schema=dict(list(_DESIGN.items())[:3]), orient="row"
    ).unique()
    stray_legs = pl.concat([legs.select(LEG).clear(), *strays]).with_columns(pl.lit(True).alias("stray"))
    marked = legs.join(
        commissioned.with_columns(pl.lit(True).alias("known")), on=PACK, how="left", validate="m:1"
    ).join(stray_legs, on=LEG, how="left", validate="m:1")
    reason = (
        pl.when(pl.col("reason") != "")
        .then("reason")
        .when(pl.col("stray"))
        .then(pl.lit("STRAY"))
        .when(pl.col("known").is_null())
        .then(pl.lit("NOT_COMMISSIONED"))
        .otherwise("reason")
    )
    verdicts = marked.with_columns(reason.alias("reason")).with_columns((pl.col("reason") == "").alias("admitted"))
    return verdicts.drop("known", "stray").sort("operator", "tail", "departed_at", "flight_id", "pack")


def unit_health(
    samples: pl.DataFrame, legs: pl.DataFrame, design: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Estimate health of every steady flight of packs that have a design.

    Returns
    -------
    flights : DataFrame
        Of `flight_by_flight`: each flight's own estimate.
    health : DataFrame
        Of `track_component`: filtered along each life, long form.
    """
    results = [
        _tracked(pack, model, legs, maintenance, component, rests_on_prior)
        for model, rests_on_prior, pack in _packs(samples.filter("nominal"), design, component)
    ]
    if not results:
        empty = flight_by_flight(samples.clear(), component.model, [component.loss])
        return empty, pl.DataFrame(schema=HEALTH)
    flights, health = zip(*results, strict=True)
    return pl.concat(flights), pl.concat(health)


def calibrated_model(design: pl.DataFrame, component: Component) -> PhysicsModel:
    """The digital system model of one pack, from its rows of `commission`'s design."""
    return component.model.calibrated(dict(design.select("parameter", "value").rows()))


def _packs(
    samples: pl.DataFrame, design: pl.DataFrame, component: Component
) -> Iterator[tuple[PhysicsModel, bool, pl.DataFrame]]:
    for pack, rows in design.filter(component=component.code).group_by(PACK, maintain_order=True):
        pack_samples = samples.filter(*(pl.col(c) == v for c, v in zip(PACK, pack, strict=True)))
        yield calibrated_model(rows, component), bool((rows["n_flights"] == 0).all()), pack_samples


def _tracked(
    samples: pl.DataFrame,
    model: PhysicsModel,
    legs: pl.DataFrame,
    maintenance: pl.DataFrame,
    component: Component,
    rests_on_prior: bool,
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Flights and health of one pack."""
    steady = samples.join(legs.filter(~pl.col("reason").is_in(NO_EVIDENCE)), on=LEG, how="semi")
    flights = _explained(flight_by_flight(steady, model, [p.name for p in model.free("health")]), steady, component)
    if flights.is_empty():
        return flights, pl.DataFrame(schema=HEALTH)
    built = _design_offset(steady, model, component)
    if rests_on_prior:
        return flights, by_prior(flights, built.sd, component)
    return flights, track_component(flights, component, maintenance, built)


def _design_offset(samples: pl.DataFrame, calibrated: PhysicsModel, component: Component) -> DesignOffset:
    """What the declaration says of a pack's design, by what each of both makes of the first flights."""
    if design_prior(component.model) is None:
        return DesignOffset()
    loss, first = component.model.param(component.loss), samples.select(LEG).unique(maintain_order=True).head(FEWEST)
    wide = replace(loss, bounds=(WIDEST, loss.bounds[1]))
    first_samples = samples.join(first, on=LEG, how="semi")

    def wear(design: Mapping[str, float]) -> Array:
        params = tuple(wide if p.name == loss.name else p for p in calibrated.calibrated(design).params)
        losses = flight_by_flight(first_samples, replace(calibrated, params=params), [loss.name])[loss.name].to_numpy()
        return wear_of(losses, losses, loss)[0]

    design, calibrated_wear = calibrated.free("design"), wear({})
    shifts = [np.median(wear({p.name: min(p.nominal + declared(p.sd), p.bounds[1])}) - calibrated_wear) for p in design]
    shift = np.median(wear({p.name: p.nominal for p in component.model.free("design")}) - calibrated_wear)
    return DesignOffset(float(shift), float(np.linalg.norm(shifts)))


def _explained(flights: pl.DataFrame, samples: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Mark flights beyond the part's possible range as not identifiable: the model lacks their cause."""
    (low, high), loss = next(p.bounds for p in component.model.params if p.name == component.loss), component.loss
    better = pl.col(loss) < low + NEAR_BOUND * (high - low)
    if not component.has_term:
        readings = component_readings(samples, component).filter(status=ONE_OR_MORE)
        beyond = readings.select(pl.struct(LEG).unique()).to_series()
        better |= pl.struct(LEG).is_in(beyond.implode())
    return flights.with_columns(pl.when(better).then(pl.lit("not_identifiable")).otherwise("status").alias("status"))


def by_prior(flights: pl.DataFrame, design_sd: float, component: Component) -> pl.DataFrame:
    """Health where no flight has calibrated the design: what the declaration believes, moved by what flights say.

    A part is taken to be as built, give or take the loss that would raise an alert. A flight's own loss is as unsure as
    the design is, and flights of one pack share that error: it does not grow smaller with their number.

    Parameters
    ----------
    design_sd : float
        Of `DesignOffset`.
    """
    variances = []
    for param in component.model.free("health"):
        loss, sd = flights.select(param.name, f"{param.name}_sd").to_numpy().astype(float).T
        variance = (1.0 - loss) * np.expm1(-design_sd) if param.bounds[1] < 1.0 else design_sd
        weight = component.warn_loss**2 / (component.warn_loss**2 + sd**2 + variance**2)
        weight = np.nan_to_num(np.where(flights["status"].is_in(SAYS_NOTHING), 0.0, weight))
        value, value_sd = weight * np.nan_to_num(loss), component.warn_loss * np.sqrt(1.0 - weight)
        names = (component.code, param.name, param.unit, "kalman_filtered")
        variances.append(health_rows(flights, names, value, value_sd, pl.lit("prior_only")))
    return pl.concat(variances)
