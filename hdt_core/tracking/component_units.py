"""Twins of declared components: calibrate each pack's first unit, then track every flight's health and readings."""

import hashlib
from collections.abc import Iterator, Mapping

import numpy as np
import polars as pl

from hdt_core.calibration.component_fit import (
    WITHOUT_ESTIMATE,
    calibrate_with_sensors,
    declared_estimator,
    design_prior,
    flight_by_flight,
)
from hdt_core.components import Component
from hdt_core.flight.component_legs import NO_EVIDENCE, component_legs, component_samples
from hdt_core.flight.legs import reject_odd_bleed
from hdt_core.physics.model import PhysicsModel
from hdt_core.physics.sensor_errors import with_sensor_errors
from hdt_core.records.keys import LEG, PACK, is_among
from hdt_core.records.unit_index import number_units, select_entries
from hdt_core.tables.twin import CalibrationComponents, TwinCheckpoints
from hdt_core.tracking.component import track_component
from hdt_core.tracking.component_readings import ONE_OR_MORE, STRAY_SD, component_readings
from hdt_core.tracking.loss_filter import TrackResult, health_rows, join_tracks
from hdt_core.tracking.redundancy import sensor_shifts
from hdt_core.tracking.sisters import FEWEST, CleanLevel, clean_levels, design_offset, first_level, level_name

MOST, SHARE_OF_LIFE = 100, 0.1
"""Steady flights of a pack's first unit on which it is taken to be as built: a tenth of its life, within limits."""
NEAR_BOUND = 1e-3
"""Share of a loss's span that counts as its bound."""
PRIOR = "prior"
"""What made the design of a pack that no flight calibrated."""


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
        Table `calibration_components` without its scope. Of a pack that was not commissioned the declared prior, which
        rests on 0 flights, or none where the declaration has no prior.
    """
    samples = component_samples(signals, component)
    legs = component_legs(samples, component)
    if component.bleed_air and reports is not None:
        legs = reject_odd_bleed(legs, reports)
    fits = {
        pack: _calibrate_pack(samples.join(flights, on=LEG, how="semi").filter("nominal"), component)
        for pack, flights in _as_built(legs, maintenance, component).group_by(PACK, maintain_order=True)
    }
    strays = pl.concat([samples.select(LEG).clear(), *(stray for stray, _ in fits.values())])
    design = _design({pack: rows for pack, (_, rows) in fits.items()}, component)
    commissioned = design.select(PACK).unique()
    legs = _second_level(legs, strays, commissioned)
    others = legs.filter(~pl.col("reason").is_in(NO_EVIDENCE) & ~is_among(commissioned))
    packs = others.select(PACK).unique(maintain_order=True).rows()
    return legs, pl.concat([design, _design(dict.fromkeys(packs, _prior(component)), component)])


def _design(packs: Mapping[tuple[object, ...], list[tuple[object, ...]]], component: Component) -> pl.DataFrame:
    """Tabulate each pack's rows, which hold the columns from `parameter` on."""
    rows = [(*pack, component.code, *row) for pack, own in packs.items() for row in own]
    return pl.DataFrame(rows, schema=CalibrationComponents.types("scope"), orient="row")


def _prior(component: Component) -> list[tuple[object, ...]]:
    """Return the declared design as rows; none where a parameter has no standard deviation."""
    if design_prior(component.model) is None:
        return []
    version = f"prior {component.version}"
    return [(p.name, p.nominal, p.sd, p.unit, 0, False, version, PRIOR) for p in component.model.free("design")]


def _as_built(legs: pl.DataFrame, maintenance: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Select the first steady flights of each pack's first unit, without those before work on it."""
    lives = number_units(legs, maintenance, component.code, "life", component.ended_by)
    first = lives.filter(pl.col("life") == 0).sort("departed_at", "flight_id")
    packs = select_entries(maintenance, (component.code,), component.ended_by).select(PACK).unique()
    last = first.join(packs, on=PACK, how="semi").group_by(PACK).tail(component.around_work[0])
    steady = first.join(last, on=LEG, how="anti").filter(pl.col("reason") == "")
    n_flights = int(np.clip(SHARE_OF_LIFE * component.life_flights, FEWEST, MOST))
    return steady.group_by(PACK, maintain_order=True).head(n_flights)


def _calibrate_pack(samples: pl.DataFrame, component: Component) -> tuple[pl.DataFrame, list[tuple[object, ...]]]:
    """Select outlying flights, and calibrate one pack's design as rows; none where the flights do not determine it.

    The last row is the level of its first flights, which its sisters are compared with.
    """
    nothing: tuple[pl.DataFrame, list[tuple[object, ...]]] = samples.select(LEG).clear(), []
    if samples.select(pl.struct(LEG).n_unique()).item() < FEWEST:
        return nothing
    method = declared_estimator(component)
    try:
        first, _ = calibrate_with_sensors(component.model, samples, method)
        stray = _strays(flight_by_flight(samples, first, _health_names(component), estimator=method), component.loss)
        regular = samples.filter(~is_among(stray))
        dsm, estimate = calibrate_with_sensors(component.model, regular, method)
    except ValueError:  # the flights do not determine the design: NOT_COMMISSIONED
        return nothing
    made_by = estimate.method or method.name
    n_flights = regular.select(pl.struct(LEG).n_unique()).item()
    params = zip(dsm.free("design"), estimate.belief.sd.tolist(), strict=True)
    version = hashlib.blake2b(f"{component.version} {dsm.nominal}".encode(), digest_size=6).hexdigest()
    level = first_level(regular, dsm, estimate.belief.cov, component)
    return stray, [
        *((p.name, dsm.nominal[p.name], sd, p.unit, n_flights, p.name not in estimate.weak, version, made_by)
          for p, sd in params),
        (level_name(component), *level, "ln", FEWEST, True, version, made_by),
    ]  # fmt: skip


def _health_names(component: Component) -> list[str]:
    return [p.name for p in component.model.free("health")]


def _strays(flights: pl.DataFrame, loss: str) -> pl.DataFrame:
    """Select flights whose loss is far from the median."""
    from scipy.stats import median_abs_deviation  # noqa: PLC0415 (loads for half a second)

    losses = flights[loss].to_numpy()
    sd = float(median_abs_deviation(losses, scale="normal", nan_policy="omit"))
    far = (pl.col(loss) - pl.col(loss).median()).abs() > STRAY_SD * max(sd, 1e-9)
    return flights.filter(far).select(LEG)


def _second_level(legs: pl.DataFrame, strays: pl.DataFrame, packs: pl.DataFrame) -> pl.DataFrame:
    """Add reasons of the second level by outlying flights and commissioned packs; `admitted` where there is none."""
    reason = (
        pl.when(pl.col("reason") != "").then("reason")
        .when(is_among(strays)).then(pl.lit("STRAY"))
        .when(~is_among(packs)).then(pl.lit("NOT_COMMISSIONED"))
        .otherwise("reason")
    )  # fmt: skip
    return legs.with_columns(reason.alias("reason")).with_columns((pl.col("reason") == "").alias("admitted"))


def unit_health(
    samples: pl.DataFrame,
    legs: pl.DataFrame,
    design: pl.DataFrame,
    maintenance: pl.DataFrame,
    component: Component,
    previous: TrackResult | None = None,
    seal: str = "",
    levels: pl.DataFrame | None = None,
) -> tuple[pl.DataFrame, TrackResult]:
    """Estimate health of every steady flight of packs that have a design.

    Parameters
    ----------
    samples : DataFrame
        Of `component_samples`.
    legs, design : DataFrame
        Of `commission`.
    previous, seal
        As of `track_loss`.
    levels : DataFrame, optional
        Of `clean_levels`, over the fleet; of the packs of `design` where not given.

    Returns
    -------
    flights : DataFrame
        Of `flight_by_flight`: each flight's own estimate.
    tracks : TrackResult
        Of `track_component`; without checkpoints where no flight calibrated the design.
    """
    steady = samples.filter("nominal").join(legs.filter(~pl.col("reason").is_in(NO_EVIDENCE)), on=LEG, how="semi")
    health_names = _health_names(component)
    method = declared_estimator(component)
    flights = [flight_by_flight(samples.clear(), component.model, health_names)]
    tracks = []
    levels = clean_levels(design, component) if levels is None else levels.filter(component=component.code)
    level_of = {row[:-3]: CleanLevel(*row[-3:]) for row in levels.select(*PACK, *CleanLevel._fields).rows()}
    for model, rests_on_prior, own in pack_models(steady, design, component):
        estimates = flight_by_flight(own, model, health_names, estimator=method)
        estimates = _reject_beyond_range(estimates, own, component)
        flights.append(estimates)
        estimates = sensor_shifts(estimates, own, model, component)
        if estimates.height:
            offset = design_offset(own, model, component, level_of.get(estimates.select(PACK).row(0)))
            tracks.append(
                TrackResult(health_by_prior(estimates, offset.sd, component), TwinCheckpoints.create_empty())
                if rests_on_prior
                else track_component(estimates, component, maintenance, offset, previous, seal)
            )
    return pl.concat(flights), join_tracks(tracks)


def pack_models(
    samples: pl.DataFrame, design: pl.DataFrame, component: Component
) -> Iterator[tuple[PhysicsModel, bool, pl.DataFrame]]:
    """Yield each pack's digital system model by `commission`'s design, whether no flight calibrated it, its samples."""
    for pack, rows in design.filter(component=component.code).group_by(PACK, maintain_order=True):
        values = dict(rows.filter(pl.col("parameter") != level_name(component)).select("parameter", "value").rows())
        model = with_sensor_errors(component.model).calibrated(values)
        own = samples.filter(*(pl.col(c) == v for c, v in zip(PACK, pack, strict=True)))
        yield model, bool((rows["n_flights"] == 0).all()), own


def _reject_beyond_range(flights: pl.DataFrame, samples: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Mark flights beyond the part's possible range as not identifiable: the model lacks their cause."""
    low, high = component.model.param(component.loss).bounds
    is_beyond = pl.col(component.loss) < low + NEAR_BOUND * (high - low)
    if not component.has_term:
        readings = component_readings(samples, component).filter(status=ONE_OR_MORE)
        is_beyond |= is_among(readings.select(LEG).unique())
    return flights.with_columns(pl.when(is_beyond).then(pl.lit("not_identifiable")).otherwise("status").alias("status"))


def health_by_prior(flights: pl.DataFrame, design_sd: float, component: Component) -> pl.DataFrame:
    """Estimate health where no flight has calibrated the design: the declaration's prior, moved by the flights.

    A part is taken to be as built, give or take the loss that would raise an alert. A flight's own loss is as uncertain
    as the design, and flights of one pack share that error: it does not shrink with their number.

    Parameters
    ----------
    design_sd : float
        Of `DesignOffset`.
    """
    rows = []
    for param in component.model.free("health"):
        loss, sd = flights.select(param.name, f"{param.name}_sd").to_numpy().astype(float).T
        shared_sd = (1.0 - loss) * np.expm1(-design_sd) if param.is_share else design_sd
        weight = component.warn_loss**2 / (component.warn_loss**2 + sd**2 + shared_sd**2)
        weight = np.nan_to_num(np.where(flights["status"].is_in(WITHOUT_ESTIMATE), 0.0, weight))
        value = weight * np.nan_to_num(loss)
        value_sd = component.warn_loss * np.sqrt(1.0 - weight)
        names = (component.code, param.name, param.unit, component.estimator)
        rows.append(health_rows(flights, names, value, value_sd, pl.lit("prior_only")))
    return pl.concat(rows)
