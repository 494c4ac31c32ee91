"""Twins of declared components: each pack's first unit calibrated as built, then every flight's health."""

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import polars as pl
from scipy.stats import median_abs_deviation

from hdt_core.components import Component
from hdt_core.flight.component_legs import LEG, component_legs, component_samples
from hdt_core.physics.model import PhysicsModel
from hdt_core.records.unit_index import PACK, number_units, select_entries
from hdt_core.twin.component import calibrate_component, track_component
from hdt_core.twin.sequential import flight_by_flight

MOST, FEWEST, SHARE_OF_LIFE = 100, 10, 0.1
"""Steady flights of a pack's first unit on which it is taken to be as built: a tenth of its life, within limits."""
STRAY_SD = 5.0
"""Standard deviations from the commissioning median at which a flight is no flight of the part as built."""
KEYS = [*PACK, "component"]


def commission(
    signals: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Judge the legs of a component and calibrate each pack on its first steady flights.

    Parameters
    ----------
    signals : DataFrame
        Long form, see `component_samples`; whole histories of some aircraft.
    maintenance : DataFrame
        Their log: flights about work on the component are left out, and those after it belong to another unit.

    Returns
    -------
    legs : DataFrame
        As of `component_legs`; reasons of the second level beside.
    design : DataFrame
        Long form: `KEYS`, parameter, value, sd, unit, n_flights, identifiable, dsm_version; none of a pack that was not
        commissioned.
    """
    samples = component_samples(signals, component)
    legs = component_legs(samples, component)
    chosen = _as_built(legs, maintenance, component)
    strays, rows = [], []
    for pack, flights in chosen.group_by(PACK, maintain_order=True):
        stray, found = _calibrated(samples.join(flights, on=LEG, how="semi").filter("nominal"), component)
        strays.append(stray)
        rows += [(*pack, component.code, *row) for row in found]
    return _second_level(legs, strays, rows), pl.DataFrame(rows, schema=_DESIGN, orient="row")


_DESIGN: dict[str, Any] = {
    "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String, "parameter": pl.String,
    "value": pl.Float64, "sd": pl.Float64, "unit": pl.String, "n_flights": pl.Int64, "identifiable": pl.Boolean,
    "dsm_version": pl.String,
}  # fmt: skip


def _as_built(legs: pl.DataFrame, maintenance: pl.DataFrame, component: Component) -> pl.DataFrame:
    """The first steady flights of each pack's first unit, those before work on it left out."""
    numbered = number_units(legs, maintenance, component.code, "life", component.ended_by)
    first = numbered.filter(pl.col("life") == 0).sort("departed_at", "flight_id")
    worked = select_entries(maintenance, (component.code,), component.ended_by).select(PACK).unique()
    last = first.join(worked, on=PACK, how="semi").group_by(PACK).tail(component.around_work[0])
    steady = first.join(last, on=LEG, how="anti").filter(pl.col("reason") == "")
    wanted = int(np.clip(SHARE_OF_LIFE * component.life_flights, FEWEST, MOST))
    return steady.group_by(PACK, maintain_order=True).head(wanted)


def _calibrated(samples: pl.DataFrame, component: Component) -> tuple[pl.DataFrame, list[tuple[object, ...]]]:
    """Flights that stand apart, and the design of one pack as rows; none where the flights do not determine it."""
    nobody = samples.select(LEG).clear()
    if samples.select(pl.struct(LEG).n_unique()).item() < FEWEST:
        return nobody, []
    try:
        first, _ = calibrate_component(component.model, samples)
        flights = flight_by_flight(samples, first, [p.name for p in component.model.free("health")])
        stray = _strays(flights, component.loss)
        kept = samples.join(stray, on=LEG, how="anti")
        dsm, found = calibrate_component(component.model, kept)
    except ValueError:  # the flights do not determine the design: said by the legs, NOT_COMMISSIONED
        return nobody, []
    n_flights = kept.select(pl.struct(LEG).n_unique()).item()
    named = zip(component.model.free("design"), found.belief.sd.tolist(), strict=True)
    version = hashlib.blake2b(f"{component.version} {dsm.nominal}".encode(), digest_size=6).hexdigest()
    return stray, [
        (p.name, dsm.nominal[p.name], sd, p.unit, n_flights, p.name not in found.weak, version) for p, sd in named
    ]


def _strays(flights: pl.DataFrame, loss: str) -> pl.DataFrame:
    """Flights whose loss lies far from the median of all."""
    seen = flights[loss].to_numpy()
    spread = float(median_abs_deviation(seen, scale="normal", nan_policy="omit"))
    far = (pl.col(loss) - pl.col(loss).median()).abs() > STRAY_SD * max(spread, 1e-9)
    return flights.filter(far).select(LEG)


def _second_level(legs: pl.DataFrame, strays: list[pl.DataFrame], rows: list[tuple[object, ...]]) -> pl.DataFrame:
    """Reasons of the first level, then of the second; `admitted` where there is none."""
    known = pl.DataFrame([row[:3] for row in rows], schema=dict(list(_DESIGN.items())[:3]), orient="row").unique()
    apart = pl.concat([legs.select(LEG).clear(), *strays]).with_columns(pl.lit(True).alias("stray"))
    judged = legs.join(known.with_columns(pl.lit(True).alias("known")), on=PACK, how="left").join(
        apart, on=LEG, how="left"
    )
    reason = (
        pl.when(pl.col("reason") != "")
        .then("reason")
        .when(pl.col("stray"))
        .then(pl.lit("STRAY"))
        .when(pl.col("known").is_null())
        .then(pl.lit("NOT_COMMISSIONED"))
        .otherwise("reason")
    )
    told = judged.with_columns(reason.alias("reason")).with_columns((pl.col("reason") == "").alias("admitted"))
    return told.drop("known", "stray").sort("operator", "tail", "departed_at", "flight_id", "pack")


def unit_health(
    samples: pl.DataFrame, legs: pl.DataFrame, design: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Health of every steady flight of packs that have a design.

    Returns
    -------
    flights : DataFrame
        Of `flight_by_flight`: what each flight says alone.
    health : DataFrame
        Of `track_component`: filtered along each life, long form.
    """
    told = [
        _tracked(pack, model, legs, maintenance, component)
        for model, pack in _packs(samples.filter("nominal"), design, component)
    ]
    if not told:
        empty = flight_by_flight(samples.clear(), component.model, [component.loss])
        return empty, pl.DataFrame(schema=HEALTH)
    flights, health = zip(*told, strict=True)
    return pl.concat(flights), pl.concat(health)


HEALTH: dict[str, Any] = {
    "operator": pl.String, "tail": pl.String, "flight_id": pl.String, "pack": pl.Int32,
    "departed_at": pl.Datetime("us", "UTC"), "component": pl.String, "parameter": pl.String, "value": pl.Float64,
    "sd": pl.Float64, "unit": pl.String, "status": pl.String, "estimator": pl.String,
}  # fmt: skip


def calibrated_model(design: pl.DataFrame, component: Component) -> PhysicsModel:
    """The digital system model of one pack, from its rows of `commission`'s design."""
    return component.model.calibrated(dict(design.select("parameter", "value").rows()))


def _packs(
    samples: pl.DataFrame, design: pl.DataFrame, component: Component
) -> Iterator[tuple[PhysicsModel, pl.DataFrame]]:
    for pack, rows in design.filter(component=component.code).group_by(PACK, maintain_order=True):
        own = samples.filter(*(pl.col(c) == v for c, v in zip(PACK, pack, strict=True)))
        yield calibrated_model(rows, component), own


def _tracked(
    samples: pl.DataFrame, model: PhysicsModel, legs: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Flights and health of one pack."""
    steady = legs.filter(~pl.col("reason").is_in(["FEW_SAMPLES", "UNSTEADY"]))
    flights = flight_by_flight(
        samples.join(steady, on=LEG, how="semi"), model, [p.name for p in component.model.free("health")]
    )
    lives = number_units(flights, maintenance, component.code, "life", component.ended_by)
    if flights.is_empty():
        return flights, pl.DataFrame(schema=HEALTH)
    return flights, track_component(lives, model, component.code).select(list(HEALTH))
