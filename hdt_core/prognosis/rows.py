"""From frames to the learner's arrays: one row a flight and pack, in units of the limit."""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from hdt_core.prognosis.history import FEATURES, history
from hdt_core.prognosis.limits import Limit
from hdt_core.prognosis.lives import flight_rows
from hdt_core.records.unit_index import PACK
from hdt_core.simulate.training import draw_fleets

Array = NDArray[np.float64]

INPUTS = (*FEATURES, "limit_sd")
LOSSES = (
    "hx_fouling", "hx_fouling_sd", "door_full_open_share", "cc_efficiency_loss", "cc_efficiency_loss_sd",
    "cc_diameter_loss",
)  # fmt: skip
"""Features that a prognosis is made of."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Features and, for training, what became of each row.

    Attributes
    ----------
    features : ndarray, shape (n, p)
        Columns `INPUTS`; NaN where unknown.
    left : ndarray, shape (n,)
        Flights until the message, or until the life was cut short. [flight]
    failed : ndarray of bool, shape (n,)
        Whether the life ended in the message.
    group : ndarray of str, shape (n,)
        What is held out together: the tail.
    life : ndarray of int, shape (n,)
        Which life the row belongs to, numbered over the whole frame.
    """

    features: Array
    left: Array
    failed: NDArray[np.bool_]
    group: NDArray[np.str_]
    life: NDArray[np.int_]

    def take(self, keep: NDArray[np.bool_]) -> "Rows":
        """The rows where `keep` holds."""
        return Rows(self.features[keep], self.left[keep], self.failed[keep], self.group[keep], self.life[keep])


def simulated_rows(seed: int, fleets: int = 50, units: int = 70, flights: int = 600, stride: int = 20) -> Rows:
    """Rows of simulated lives; the limit is known no better than a fleet with few messages knows it."""
    rng = np.random.default_rng(seed + 1)
    parts = []
    for number, (lives, limit) in enumerate(draw_fleets(seed, fleets, units, flights)):
        doubt = np.exp(rng.uniform(np.log(0.02), np.log(0.18), units))
        believed = limit * np.exp(doubt * rng.standard_normal(units))
        age = np.where(lives.age_known[:, None], np.arange(flights, dtype=float), np.nan)
        # a fleet in four has no door signal, and so has every compressor
        door = lives.full_open if number % 4 else np.full_like(lives.full_open, np.nan)
        table = _table(lives.measured / believed[:, None], lives.sd / believed[:, None], age, door, doubt)
        left = lives.message[:, None] - np.arange(flights)[None, :]
        keep = (left >= 1) & ((np.arange(flights)[None, :] + rng.integers(0, stride, (units, 1))) % stride == 0)
        unit = np.nonzero(keep)[0]
        failed = lives.message[unit] < flights
        parts.append(
            Rows(table[keep], left[keep].astype(float), failed, np.full(unit.size, f"{number}"), number * units + unit)
        )
    return Rows(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in ("features", "left", "failed", "group", "life"))
    )


@dataclass(frozen=True, slots=True)
class Tracks:
    """Health tracks of one component, one row a life, flights of unknown health left out.

    Attributes
    ----------
    value, sd, age, door : ndarray, shape (lives, flights)
        Loss, its standard deviation, flights since installation, share of the cruise with the ram door full open; NaN
        after a life's last flight. [-], [-], [flight], [-]
    at : ndarray of int, shape (n, 2)
        For each row of `keys`: its life and its column, the column -1 before the first known value.
    keys : DataFrame
        operator, tail, flight_id, pack, departed_at, one row a flight, sorted by pack and departure.
    left, failed : ndarray, shape (n,)
        As in `Rows`.
    """

    value: Array
    sd: Array
    age: Array
    door: Array
    at: NDArray[np.int_]
    keys: pl.DataFrame
    left: Array
    failed: NDArray[np.bool_]


def tracks(features: pl.DataFrame, lives: pl.DataFrame, component: str) -> Tracks:
    """Cut health tracks into lives.

    Parameters
    ----------
    features : DataFrame
        operator, tail, flight_id, pack, departed_at and the component's loss and sd (see `_loss`), any row order.
    lives : DataFrame
        From `lives.episodes`.
    component : str
        "HX" or "CC".
    """
    flights = flight_rows(features.with_columns(_loss(features, component)), "value", "sd", "door")
    own = lives.filter(pl.col("component") == component).drop("component")
    flights = flights.join(own, on=PACK).filter(pl.col("first_row") <= pl.col("row")).sort(*PACK, "row", "first_row")
    flights = flights.unique([*PACK, "row"], keep="last", maintain_order=True).with_columns(
        life_id=(pl.struct(*PACK, "life").rank("dense").cast(pl.Int64) - 1),
        column=pl.col("value").is_not_null().cum_sum().over(*PACK, "life").cast(pl.Int64) - 1,
    )
    seen = flights.filter(pl.col("value").is_not_null())
    shape = (int(flights["life_id"].max() or 0) + 1, int(seen["column"].max() or 0) + 1)  # type: ignore[arg-type]
    place = (seen["life_id"].to_numpy(), seen["column"].to_numpy())
    age = np.where(seen["age_known"].to_numpy(), (seen["row"] - seen["first_row"]).to_numpy(), np.nan)
    return Tracks(
        value=_spread(shape, place, seen["value"].to_numpy()),
        sd=_spread(shape, place, seen["sd"].to_numpy()),
        age=_spread(shape, place, age),
        door=_spread(shape, place, seen["door"].cast(pl.Float64).to_numpy()),
        at=flights.select("life_id", "column").to_numpy(),
        keys=flights.select(*PACK, "flight_id", "departed_at", "life_id"),
        left=(flights["end_row"] - flights["row"]).to_numpy().astype(float),
        failed=flights["failed"].to_numpy(),
    )


def fleet_rows(track: Tracks, limit: Limit) -> Rows:
    """Features of every flight of the tracks in units of a limit; unknown health gives NaN, not an error."""
    doubt = np.full(len(track.value), limit.sd / limit.mean)
    table = _table(track.value / limit.mean, track.sd / limit.mean, track.age, track.door, doubt)
    life, column = track.at[:, 0], track.at[:, 1]
    features = np.where((column < 0)[:, None], np.nan, table[life, np.maximum(column, 0)])
    return Rows(features, track.left, track.failed, track.keys["tail"].to_numpy().astype(str), life)


def message_levels(track: Tracks) -> tuple[Array, NDArray[np.str_]]:
    """Loss seen on the flight before each message, and the tail it belongs to."""
    last = track.failed & (track.left == 1) & (track.at[:, 1] >= 0)
    level = track.value[track.at[last, 0], track.at[last, 1]]
    return level, track.keys["tail"].to_numpy().astype(str)[last]


def _table(level: Array, sd: Array, age: Array, door: Array, limit_sd: Array) -> Array:
    columns = history(level, sd, age, door)
    known = [columns[name] for name in FEATURES]
    return np.stack([*known, np.broadcast_to(limit_sd[:, None], level.shape)], axis=-1)


def _spread(shape: tuple[int, int], place: tuple[NDArray[np.int_], NDArray[np.int_]], values: Array) -> Array:
    out = np.full(shape, np.nan)
    out[place] = values
    return out


def _loss(features: pl.DataFrame, component: str) -> list[pl.Expr]:
    """Value and sd of the component's loss and the door's state, null where columns are missing."""
    if component == "HX":
        names = {"hx_fouling": "value", "hx_fouling_sd": "sd", "door_full_open_share": "door"}
        return [_column(features, name).alias(alias) for name, alias in names.items()]
    # head is proportional to efficiency and to the square of the effective diameter (equation 5)
    deficit = _column(features, "cc_diameter_loss")
    value = pl.coalesce(_column(features, "cc_efficiency_loss"), 1.0 - (1.0 - deficit) ** 2)
    value_sd = _column(features, "cc_efficiency_loss_sd").alias("sd")
    return [value.alias("value"), value_sd, pl.lit(None, pl.Float64).alias("door")]


def _column(features: pl.DataFrame, name: str) -> pl.Expr:
    column = pl.col(name) if name in features.columns else pl.lit(None)
    return column.cast(pl.Float64).fill_nan(None)
