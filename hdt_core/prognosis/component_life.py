"""Remaining life of a declared component: first passage of its loss through the level at which units fail.

Wear goes on at a rate that the unit's own trend and its declared life tell; where it ends is learned from the messages
of the other tails that were on record when the flight's month began, and from the declared limit while there are none.
"""

import hashlib

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.special import ndtr

from hdt_core.components import Component
from hdt_core.margin.first_passage import wear_rate
from hdt_core.prognosis.component_limits import learn_limit
from hdt_core.prognosis.fleet_record import FleetRecord, month_of, start_of
from hdt_core.prognosis.hazard import EDGES, events_ahead, quantile
from hdt_core.prognosis.model import HELD, HORIZON
from hdt_core.prognosis.unit_lives import Failure, component_lives
from hdt_core.records.keys import PACK

Array = NDArray[np.float64]
KEYS = ["operator", "tail", "flight_id", "pack", "component", "departed_at"]
TOLD_AT = {"rul_low": 0.05, "rul_flights": 0.5, "rul_high": 0.95}
KNOWN = ("loss", "loss_sd", "loss_slope_100_per_flight", "flights_seen_of_unit")


def component_prognoses(
    described: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Flights left of each unit after each flight, without any condition, in the columns of `prognoses`.

    Parameters
    ----------
    described : DataFrame
        Of `component_features`, all tails.
    messages, maintenance : DataFrame
        Of the same fleet. A flight is judged by the failures of other tails that were on record when its month began.

    Returns
    -------
    DataFrame
        One row a flight and pack; values are null where the loss is not known.
    """
    rows = described.filter(pl.col("component") == component.code).sort(*PACK, "departed_at", "flight_id")
    record, month_at = FleetRecord(rows, messages, maintenance), month_of(rows["departed_at"])
    parts = [_foretell(rows.filter(month_at == m), record.before(start_of(m)), component) for m in record.months()]
    return pl.concat([_foretell(rows.clear(), record, component), *parts]).sort(*PACK, "departed_at", "flight_id")


def _foretell(rows: pl.DataFrame, past: FleetRecord, component: Component) -> pl.DataFrame:
    """Prognoses of some flights from what was on record before."""
    failed = _failures(past, component)
    # the aircraft would have raised it: there is a message, and the operator delivers messages
    operators = past.messages["operator"].unique().to_list() if component.message_code else []
    by = _event_by(rows, _limits(rows, failed, component), component, rows["operator"].is_in(operators).to_numpy())
    values = {name: quantile(by, level) for name, level in TOLD_AT.items()}
    values |= events_ahead(by)
    known = np.isfinite(by[:, -1])
    columns = [pl.Series(name, np.where(known, v, np.nan)).fill_nan(None) for name, v in values.items()]
    taught = repr((component.version, sorted(operators), failed.sort("tail", "loss").rows())).encode()
    version = f"first-passage-{hashlib.blake2b(taught, digest_size=4).hexdigest()}"
    return (
        rows.select(*KEYS)
        .with_columns(*columns, pl.lit(version).alias("model_version"), pl.lit(HELD).alias("split"))
        .with_columns((pl.col("rul_flights") >= HORIZON).alias("beyond_horizon"))
    )


def first_passage(
    loss: Array, loss_sd: Array, rate: Array, rate_sd: Array, limit: tuple[Array, Array], alive: NDArray[np.bool_]
) -> Array:
    """P(loss passes the limit within `EDGES` flights). (n, len(EDGES))

    Parameters
    ----------
    loss, loss_sd : array, shape (n,)
        Now. [-]
    rate, rate_sd : array, shape (n,)
        Of wear. [1/flight]
    limit : tuple of array, shape (n,)
        Mean and standard deviation of the loss at which this unit fails. [-]
    alive : array of bool, shape (n,)
        Whether it is known not to have failed yet: then its own limit lies above what it has lost.
    """
    mean, sd = limit
    ahead = EDGES[None, :]
    spread = np.sqrt(loss_sd[:, None] ** 2 + sd[:, None] ** 2 + (rate_sd[:, None] * ahead) ** 2)
    passed = ndtr((loss[:, None] + np.maximum(rate, 0.0)[:, None] * ahead - mean[:, None]) / spread)
    before = np.where(alive[:, None], passed[:, :1], 0.0)
    left = np.maximum(1.0 - before, 1e-9)
    return np.clip(np.maximum.accumulate((passed - before) / left, axis=1), 0.0, 1.0)


def _event_by(rows: pl.DataFrame, limits: tuple[Array, Array], component: Component, alive: NDArray[np.bool_]) -> Array:
    loss, sd, slope, seen = (rows[c].cast(pl.Float64).to_numpy() for c in KNOWN)
    usual = component.limit.mean / component.life_flights
    flights = np.where(np.isnan(slope), 2.0, np.minimum(seen + 1.0, 100.0))
    rate, rate_sd = wear_rate(np.nan_to_num(slope), flights, usual, usual)
    return first_passage(loss, sd, rate, rate_sd, limits, alive)


def _limits(rows: pl.DataFrame, failed: pl.DataFrame, component: Component) -> tuple[Array, Array]:
    """Loss at which each row's unit fails, by the failures of other tails: mean and sd. (n,) each"""
    limits = {
        tail: learn_limit(failed.filter(pl.col("tail") != tail)["loss"].to_numpy(), component.limit)
        for tail in rows["tail"].unique()
    }
    own = [limits[tail] for tail in rows["tail"]]
    # the spread of one unit about what is believed of the fleet
    return np.array([x.mean for x in own]), np.array([np.hypot(x.sd, x.unit_sd) for x in own])


def _failures(past: FleetRecord, component: Component) -> pl.DataFrame:
    """Loss just before each failure: tail, loss."""
    rows = past.features.sort(*PACK, "departed_at", "flight_id")
    if component.message_code is None or rows.is_empty():
        return pl.DataFrame(schema={"tail": pl.String, "loss": pl.Float64})
    lives = component_lives(rows, past.messages, past.maintenance, Failure(component.code, component.message_code))
    ended = lives.filter("failed").select(*PACK, row=pl.col("end_row"))
    numbered = rows.with_columns(row=pl.int_range(pl.len()).over(PACK).cast(pl.Int64))
    last = pl.col("loss").forward_fill().over(PACK)
    with_loss = numbered.with_columns(last.alias("loss")).join(ended, on=[*PACK, "row"], validate="1:1")
    return with_loss.select("tail", "loss").drop_nulls()
