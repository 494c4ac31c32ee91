"""Remaining life of a declared component: first passage of its loss through the level at which units fail.

The wear rate follows from the unit's own trend and its declared life; the limit from messages of other tails that were
on record when the flight's month began, with the declared limit as prior.
"""

import hashlib
from functools import partial

import numpy as np
import polars as pl
from scipy.special import ndtr

from hdt_core.components import Component, Limit, WearLaw
from hdt_core.margin.first_passage import wear_rate
from hdt_core.prognosis.choices import Washes, forecast_choices
from hdt_core.prognosis.fleet_record import FleetRecord, month_of, start_of
from hdt_core.prognosis.hazard import EDGES, events_ahead, quantile
from hdt_core.prognosis.history import Index
from hdt_core.prognosis.model import HORIZON, OUT_OF_FOLD
from hdt_core.prognosis.unit_lives import episodes, life_table
from hdt_core.prognosis.wear_laws import wear_laws
from hdt_core.records.keys import PACK
from hdt_core.robust import Array

KEYS = ["operator", "tail", "flight_id", "pack", "component", "departed_at"]
QUANTILE_LEVELS = {"rul_low": 0.05, "rul_flights": 0.5, "rul_high": 0.95}
LOSS_COLUMNS = ("loss", "loss_sd", "loss_slope_100_per_flight", "flights_since_drop")


def component_prognoses(
    features: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Predict each unit's remaining flights after each flight, unconditionally, in the columns of `prognoses`.

    Parameters
    ----------
    features : DataFrame
        Of `component_features`, all tails.
    messages, maintenance : DataFrame
        Of the same fleet. A flight is predicted from failures of other tails on record when its month began.

    Returns
    -------
    DataFrame
        One row a flight and pack; values are null where the loss is not known.
    """
    rows = features.filter(pl.col("component") == component.code).sort(*PACK, "departed_at", "flight_id")
    record = FleetRecord(rows, messages, maintenance)
    month_at = month_of(rows["departed_at"])
    parts = [_predict(rows.filter(month_at == m), record.as_of(start_of(m)), component) for m in record.months()]
    return pl.concat([_predict(rows.clear(), record, component), *parts]).sort(*PACK, "departed_at", "flight_id")


def component_choices(
    features: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component, washes: Washes
) -> pl.DataFrame:
    """Forecast each unit after its last flight from the loss that each choice leaves; see `component_prognoses`."""
    rows = features.filter(pl.col("component") == component.code).sort(*PACK, "departed_at", "flight_id")
    record = FleetRecord(rows, messages, maintenance)
    last_flights = rows.drop_nulls("loss").unique(PACK, keep="last", maintain_order=True)
    month_at = month_of(last_flights["departed_at"])
    parts = []
    for month in month_at.unique().sort():
        units = last_flights.filter(month_at == month)
        past = record.as_of(start_of(month))
        predict = partial(_predict_from, units, past, component)
        parts.append(forecast_choices(units, units["loss"].to_numpy(), component.code, washes, predict))
    return pl.concat(parts) if parts else pl.DataFrame()


def _predict_from(
    units: pl.DataFrame, past: FleetRecord, component: Component, numbers: Index, losses: Array
) -> pl.DataFrame:
    """Predict some units, by number, from other losses."""
    return _predict(units[numbers].with_columns(loss_left=losses), past, component)


def component_life_table(
    features: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Return `life_table` of a component's units; without a declared message all are censored."""
    rows = features.filter(component=component.code)
    return life_table(rows, episodes(rows, messages, maintenance, (component,)))


def _predict(rows: pl.DataFrame, past: FleetRecord, component: Component) -> pl.DataFrame:
    """Predict some flights from the record before them."""
    failures = _failures(past, component)
    # no message then means no failure: the component has one, and the operator delivers messages
    operators = past.messages["operator"].unique().to_list() if component.message_code else []
    alive = rows["operator"].is_in(operators).to_numpy()
    limits = _limits(rows, failures, component)
    laws = wear_laws(component, past.features)
    by_law = [x.weight * _event_by(rows, limits, component, alive, x.law) for x in laws]
    by = np.sum(by_law, axis=0)
    values = {name: quantile(by, level) for name, level in QUANTILE_LEVELS.items()}
    values |= events_ahead(by)
    is_known = np.isfinite(by[:, -1])
    columns = [pl.Series(name, np.where(is_known, v, np.nan)).fill_nan(None) for name, v in values.items()]
    weights = [round(x.weight, 6) for x in laws]
    training_data = repr((component.version, sorted(operators), failures.sort("tail", "loss").rows(), weights)).encode()
    version = f"first-passage-{hashlib.blake2b(training_data, digest_size=4).hexdigest()}"
    return (
        rows.select(*KEYS)
        .with_columns(*columns, pl.lit(version).alias("model_version"), pl.lit(OUT_OF_FOLD).alias("split"))
        .with_columns((pl.col("rul_flights") >= HORIZON).alias("beyond_horizon"))
    )


def first_passage(
    loss: Array, loss_sd: Array, rate: Array, rate_sd: Array, limit: tuple[Array, Array], alive: Array
) -> Array:
    """Compute P(loss passes the limit within `EDGES` flights). (n, len(EDGES))

    Parameters
    ----------
    loss, loss_sd : array, shape (n,)
        Now. [-]
    rate, rate_sd : array, shape (n,)
        Of wear. [1/flight]
    limit : tuple of array, shape (n,)
        Mean and standard deviation of the loss at which this unit fails. [-]
    alive : array of bool, shape (n,)
        True where the unit has not failed for certain: then its own limit lies above its loss.
    """
    mean, sd = limit
    ahead = EDGES[None, :]
    total_sd = np.sqrt(loss_sd[:, None] ** 2 + sd[:, None] ** 2 + (rate_sd[:, None] * ahead) ** 2)
    p_passed = ndtr((loss[:, None] + np.maximum(rate, 0.0)[:, None] * ahead - mean[:, None]) / total_sd)
    p_passed_now = np.where(alive[:, None], p_passed[:, :1], 0.0)
    p_alive = np.maximum(1.0 - p_passed_now, 1e-9)
    return np.clip(np.maximum.accumulate((p_passed - p_passed_now) / p_alive, axis=1), 0.0, 1.0)


def _event_by(
    rows: pl.DataFrame, limits: tuple[Array, Array], component: Component, alive: Array, law: WearLaw
) -> Array:
    """Compute P(failure within `EDGES` flights) of each row if its loss grows by `law`."""
    loss, sd, slope, n_flights = (rows[c].cast(pl.Float64).to_numpy() for c in LOSS_COLUMNS)
    usual = law.grown(np.array(component.limit.mean)) / component.life_flights
    flights = np.where(np.isnan(slope), 2.0, np.minimum(n_flights + 1.0, 100.0))
    limit, limit_sd = limits
    gained = law.grown(loss) - law.grown(loss - np.nan_to_num(slope) * flights)
    left = rows["loss_left"].to_numpy() if "loss_left" in rows.columns else loss
    grown = law.grown(left)
    grown_sd = 0.5 * (law.grown(left + sd) - law.grown(left - sd))
    rate, rate_sd = wear_rate(gained / flights, flights, float(usual), float(usual))
    return first_passage(grown, grown_sd, rate, rate_sd, (law.grown(limit), law.slope(limit) * limit_sd), alive)


def _limits(rows: pl.DataFrame, failures: pl.DataFrame, component: Component) -> tuple[Array, Array]:
    """Estimate the loss at which each row's unit fails, from failures of other tails: mean and sd. (n,) each"""
    limits = {
        tail: learn_limit(failures.filter(pl.col("tail") != tail)["loss"].to_numpy(), component.limit)
        for tail in rows["tail"].unique()
    }
    row_limits = [limits[tail] for tail in rows["tail"]]
    # variance of the fleet's limit plus that of one unit about it
    return np.array([x.mean for x in row_limits]), np.array([np.hypot(x.sd, x.unit_sd) for x in row_limits])


def learn_limit(levels: Array, prior: Limit) -> Limit:
    """Compute the posterior of the limit from losses just before messages (normal, known variance).

    Parameters
    ----------
    levels : array, shape (n,)
        Loss before each message, one a failure; a level reached by a jump reads high, so values far off count less. [-]
    prior : Limit
        Prior before any message.
    """
    levels = levels[np.isfinite(levels)]
    if levels.size == 0:
        return prior
    # Huber weights: a sudden clog overshoots the limit, a wrong message undershoots it
    distance = np.abs(levels - np.median(np.append(levels, prior.mean))) / (1.5 * prior.unit_sd)
    weight = 1.0 / np.maximum(distance, 1.0)
    precision = 1.0 / prior.sd**2 + weight.sum() / prior.unit_sd**2
    mean = (prior.mean / prior.sd**2 + (weight * levels).sum() / prior.unit_sd**2) / precision
    return Limit(float(mean), float(precision**-0.5), prior.unit_sd)


def _failures(past: FleetRecord, component: Component) -> pl.DataFrame:
    """Return the loss just before each failure: tail, loss."""
    rows = past.features.sort(*PACK, "departed_at", "flight_id")
    if component.message_code is None or rows.is_empty():
        return pl.DataFrame(schema={"tail": pl.String, "loss": pl.Float64})
    lives = episodes(rows, past.messages, past.maintenance, (component,))
    ends = lives.filter("failed").select(*PACK, row=pl.col("end_row"))
    flights = rows.with_columns(row=pl.int_range(pl.len()).over(PACK).cast(pl.Int64))
    last = pl.col("loss").forward_fill().over(PACK)
    with_loss = flights.with_columns(last.alias("loss")).join(ends, on=[*PACK, "row"], validate="1:1")
    return with_loss.select("tail", "loss").drop_nulls()
