"""Remaining life of a declared component: first passage of its loss through the level at which units fail.

Wear goes on at a rate that the unit's own trend and its declared life tell; where it ends is learned from the messages
of the other tails, and from the declared limit while there are none.
"""

import hashlib

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.special import ndtr

from hdt_core.components import Component, Limit
from hdt_core.margin.first_passage import wear_rate
from hdt_core.prognosis.component_limits import learn_limit
from hdt_core.prognosis.hazard import EDGES, quantile
from hdt_core.prognosis.model import AHEAD, HELD, HORIZON
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
        Of the same fleet. A flight is judged by the failures of other tails that had happened before it.

    Returns
    -------
    DataFrame
        One row a flight and pack; values are null where the loss is not known.
    """
    rows = described.filter(pl.col("component") == component.code).sort(*PACK, "departed_at", "flight_id")
    by = _event_by(rows, _limits(rows, messages, maintenance, component), component, _speaks(rows, messages, component))
    told = {name: quantile(by, level) for name, level in TOLD_AT.items()}
    told |= {f"p_event_{k}": by[:, int(np.searchsorted(EDGES, k))] for k in AHEAD}
    known = np.isfinite(by[:, -1])
    columns = [pl.Series(name, np.where(known, v, np.nan)).fill_nan(None) for name, v in told.items()]
    version = f"first-passage-{hashlib.blake2b(component.version.encode(), digest_size=4).hexdigest()}"
    return (
        rows.select(*KEYS)
        .with_columns(
            *columns,
            pl.lit(version).alias("model_version"),
            pl.lit(HELD).alias("split"),
        )
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


def _speaks(rows: pl.DataFrame, messages: pl.DataFrame, component: Component) -> NDArray[np.bool_]:
    """Whether the aircraft would have told of a failure: it has a message, and its operator delivers messages."""
    operators = messages["operator"].unique().to_list() if component.message_code else []
    return rows["operator"].is_in(operators).to_numpy()


def _event_by(rows: pl.DataFrame, limits: tuple[Array, Array], component: Component, alive: NDArray[np.bool_]) -> Array:
    loss, sd, slope, seen = (rows[c].cast(pl.Float64).to_numpy() for c in KNOWN)
    usual = component.limit.mean / component.life_flights
    flights = np.where(np.isnan(slope), 2.0, np.minimum(seen + 1.0, 100.0))
    rate, rate_sd = wear_rate(np.nan_to_num(slope), flights, usual, usual)
    return first_passage(loss, sd, rate, rate_sd, limits, alive)


def _limits(
    rows: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> tuple[Array, Array]:
    """Loss at which each row's unit fails, by the failures of other tails before it: mean and sd. (n,) each"""
    failed = _failures(rows, messages, maintenance, component)
    tails, at = rows["tail"].to_numpy(), rows["departed_at"].dt.epoch("s").to_numpy()
    mean, sd = (np.empty(rows.height) for _ in range(2))
    for tail in np.unique(tails):
        own = np.flatnonzero(tails == tail)
        told = failed.filter(pl.col("tail") != tail).sort("failed_at")
        moments, levels = told["failed_at"].dt.epoch("s").to_numpy(), told["loss"].to_numpy()
        known = np.searchsorted(moments, at[own])
        for count in np.unique(known):
            limit = learn_limit(levels[:count], component.limit)
            mean[own[known == count]], sd[own[known == count]] = limit.mean, _spread(limit)
    return mean, sd


def _spread(limit: Limit) -> float:
    """Of one unit about what is believed of the fleet."""
    return float(np.hypot(limit.sd, limit.unit_sd))


def _failures(
    rows: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Loss just before each failure: tail, failed_at, loss."""
    none = pl.DataFrame(schema={"tail": pl.String, "failed_at": pl.Datetime("us", "UTC"), "loss": pl.Float64})
    if component.message_code is None or rows.is_empty():
        return none
    lives = component_lives(rows, messages, maintenance, Failure(component.code, component.message_code))
    ended = lives.filter("failed").select(*PACK, row=pl.col("end_row"))
    numbered = rows.with_columns(row=pl.int_range(pl.len()).over(PACK).cast(pl.Int64))
    last = pl.col("loss").forward_fill().over(PACK)
    told = numbered.with_columns(last.alias("loss")).join(ended, on=[*PACK, "row"], validate="m:1")
    return told.select("tail", pl.col("departed_at").alias("failed_at"), "loss").drop_nulls()
