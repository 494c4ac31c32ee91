"""Causal features of a unit's record, one row a unit, one column a flight.

Every feature at flight k is a function of flights up to k. Wear, reserve and demand are in ln of conductance, which is
comparable between types, so none is divided by a fleet's limit.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from hdt_core.health.features import DROP, DROP_FLIGHTS
from hdt_core.margin.first_passage import DEMAND_NAMES, LEVELS, RATIO_SD, demand_quantiles, passage, wear_rate
from hdt_core.robust import Array

Index = NDArray[np.int_]

HORIZONS = (10, 30, 100)
WEAR = (
    "level", "level_sd", "peak", "age_flights", "seen_flights", "entry_level", *(f"slope_{h}" for h in HORIZONS),
    "slope_segment", "slope_life", "bend", "roughness", "jump_10", "jump_largest", "jump_share",
)  # fmt: skip
QUANTILES = DEMAND_NAMES[:-1]
RESERVE = (
    *(name.replace("asked", "reserve") for name in QUANTILES), "asked_trend", "left_linear_30", "left_linear_100",
    "left_linear_segment",
)  # fmt: skip
PASSAGE_AHEAD = (50.0, 100.0, 200.0, 300.0)
PASSAGE = (*(f"passage_{round(k)}" for k in PASSAGE_AHEAD), "passage_median")
THERMAL = (
    "overheat_10", "overheat_40", "overheat_most_40", "overheat_half_40", "hot_share_40", "full_open_10",
    "full_open_40", "season_sin", "season_cos",
)  # fmt: skip
FEATURES = (*WEAR, *RESERVE, *PASSAGE, *THERMAL)
RECORD = (*WEAR, *THERMAL, "ratio", "run")
"""Features that do not depend on the message's rule."""
FALLING = ("reserve_", "left_linear_", "passage_median")
RISING = ("passage_", "overheat_", "hot_share_", "full_open_")
RISES = tuple(-1 if name.startswith(FALLING) else 1 if name.startswith(RISING) else 0 for name in FEATURES)
"""How the hazard may follow each feature: less in reserve, or hotter flights, never make a message less likely."""
UNITS_AT_ONCE, ROWS_AT_ONCE = 64, 8_192
"""Units and flights computed at once, so that memory does not grow with the fleet."""
HOT_K = 3.0
"""A flight whose hottest fifth is this far above its level was hot: twice the scatter of a sound one. [K]"""
_EDGES = np.array([0.0, 10.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0])
_FAR = 1000.0


@dataclass(frozen=True, slots=True)
class Panel:
    """Units side by side, arrays (units, flights): NaN where unknown, before the first and after the last flight.

    Attributes
    ----------
    level, sd : ndarray
        Health loss, forward filled, and its standard deviation. [-]
    age : ndarray
        Flights since installation; NaN where the unit was already flying when the record began. [flight]
    ratio : ndarray
        Ln of the conductance ratio, in the same unit as demand. [-]
    overheat_k, overheat_half_k, full_open : ndarray
        Outlet above its set point in the hottest fifth and in half of a flight's high samples [K]; share of them with
        the ram door full open [-].
    day : ndarray
        Day of the year. [day]
    """

    level: Array
    sd: Array
    age: Array
    ratio: Array
    overheat_k: Array
    overheat_half_k: Array
    full_open: Array
    day: Array


def record_rows(panel: Panel, at: tuple[Index, Index]) -> Array:
    """Compute features that depend on the record alone at some flights. (n, q), columns `RECORD`.

    Parameters
    ----------
    panel : Panel
        Units and their flights.
    at : tuple of array
        Unit and flight of each row, as the panel counts them.
    """
    unit, flight = at
    values = np.empty((len(unit), len(RECORD)))
    for first in range(0, len(panel.level), UNITS_AT_ONCE):
        rows = (unit >= first) & (unit < first + UNITS_AT_ONCE)
        chunk = Panel(*(getattr(panel, f.name)[first : first + UNITS_AT_ONCE] for f in fields(Panel)))
        for column, along in enumerate(_along(chunk)):
            values[rows, column] = along[unit[rows] - first, flight[rows]]
    return values


def _along(panel: Panel) -> list[Array]:
    """Compute `RECORD` at every flight of some units. (units, flights) each"""
    start = _segment_start(panel.level)
    n_flights = np.asarray(np.arange(panel.level.shape[1]) - start + 1.0, dtype=float)
    along = _wear(panel, start) | _thermal_features(panel) | {"ratio": panel.ratio, "run": n_flights}
    return [along[name] for name in RECORD]


def feature_rows(record: Array, critical: Array, place: tuple[Index, Index]) -> Array:
    """Compute features of some flights. (n, p), columns `FEATURES`, NaN where undefined.

    Parameters
    ----------
    record : array, shape (n, q)
        From `record_rows`.
    critical : array, shape (packs, flights)
        Demand of each flight of a pack, whichever unit flew. See `conditions.demand_quantiles`.
    place : tuple of array
        Pack and flight of each row, as `critical` counts them.
    """
    values = np.empty((len(record), len(FEATURES)))
    for first in range(0, len(record), ROWS_AT_ONCE):
        chunk = slice(first, first + ROWS_AT_ONCE)
        values[chunk] = _features(record[chunk], critical, (place[0][chunk], place[1][chunk]))
    return values


def _features(record: Array, critical: Array, place: tuple[Index, Index]) -> Array:
    rows = dict(zip(RECORD, record.T, strict=True))
    demand = demand_quantiles(critical, *place)
    ratio = rows["ratio"]
    rows |= {name.replace("asked", "reserve"): ratio - demand[name] for name in QUANTILES}
    rows["asked_trend"] = demand["asked_trend"]
    # losses are fractions, reserves are in ln: the same step weighs more the smaller the remaining ratio
    slope = {n: rows[f"slope_{n}"] / np.maximum(1.0 - rows["level"], 0.2) for n in ("30", "100", "segment")}
    for name, s in slope.items():  # flights to a reserve of 0, extrapolated linearly
        flights = np.clip(rows["reserve_95"] / np.maximum(s, 1e-6), 0.0, _FAR)
        rows[f"left_linear_{name}"] = np.where(s > 1e-6, flights, _FAR)
    rate = wear_rate(slope["100"], rows["run"])
    rows |= _passages(ratio, np.stack([demand[name] for name in DEMAND_NAMES[: len(LEVELS)]], axis=1), *rate)
    return np.stack([rows[name] for name in FEATURES], axis=1)


def _wear(panel: Panel, start: Index) -> dict[str, Array]:
    """Compute `WEAR`; `start` is the first flight of the segment. (units, flights) each"""
    level = panel.level
    k = np.broadcast_to(np.arange(level.shape[1]), level.shape)
    slope: dict[str, Array] = {f"slope_{h}": _slope(level, np.maximum(start, k - h + 1)) for h in HORIZONS}
    jump = np.nan_to_num(level - _lag(level, 3))
    peak = np.asarray(np.fmax.accumulate(level, axis=1))
    largest = np.asarray(np.maximum.accumulate(jump, axis=1))
    entry = np.broadcast_to(np.asarray(level[:, :5].mean(axis=1, keepdims=True)), level.shape)
    jump_total = np.cumsum(np.maximum(jump - 0.02, 0.0), axis=1) / 3.0
    return {
        "level": level,
        "level_sd": panel.sd,
        "peak": peak,
        "age_flights": panel.age,
        "seen_flights": np.asarray(k + 1.0, dtype=float),
        "entry_level": np.asarray(np.where(k < 5, level, entry)),
        **slope,
        "slope_segment": _slope(level, start),
        "slope_life": _slope(level, np.zeros_like(start)),
        "bend": slope["slope_30"] - slope["slope_100"],
        "roughness": _roughness(level),
        "jump_10": _rolling_max(jump, 10),
        "jump_largest": largest,
        "jump_share": jump_total / np.maximum(peak, 0.02),
    }


def _passages(ratio: Array, demand: Array, rate: Array, rate_sd: Array) -> dict[str, Array]:
    """Compute the physical forecast at each flight; see `first_passage`."""
    by = passage(ratio, np.full(rate.size, RATIO_SD), demand, rate, rate_sd, _EDGES)
    within = dict(zip(PASSAGE[:-1], by[:, np.searchsorted(_EDGES, PASSAGE_AHEAD)].T, strict=True))
    return within | {"passage_median": np.array([float(np.interp(0.5, p, _EDGES)) for p in by])}


def _thermal_features(panel: Panel) -> dict[str, Array]:
    """Compute `THERMAL`; those of a flight without a value are the last flight's with one. (units, flights) each"""
    angle = 2.0 * np.pi * panel.day / 365.25
    hot = np.where(np.isnan(panel.overheat_k), np.nan, panel.overheat_k > HOT_K)
    thermal = {
        "overheat_10": _mean_finite(panel.overheat_k, 10),
        "overheat_40": _mean_finite(panel.overheat_k, 40),
        "overheat_most_40": _rolling_max(np.nan_to_num(panel.overheat_k), 40) + 0.0 * panel.overheat_k,
        "overheat_half_40": _mean_finite(panel.overheat_half_k, 40),
        "hot_share_40": _mean_finite(hot, 40),
        "full_open_10": _mean_finite(panel.full_open, 10),
        "full_open_40": _mean_finite(panel.full_open, 40),
    }
    last_known = _last_known(panel.overheat_k)
    carried = {name: np.take_along_axis(values, last_known, axis=1) for name, values in thermal.items()}
    return carried | {"season_sin": np.sin(angle), "season_cos": np.cos(angle)}


def _last_known(values: Array) -> Index:
    """Return for each flight the last one up to it with a finite value; the first where there is none."""
    flights = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.asarray(np.maximum.accumulate(flights, axis=1))


def _lag(values: Array, flights: int) -> Array:
    """Shift values by some flights; the first value fills."""
    return values[:, np.maximum(np.arange(values.shape[1]) - flights, 0)]


def _segment_start(level: Array) -> Index:
    """Return the flight on which the current segment began: entry, or the last drop (a wash, a change not logged)."""
    k = np.broadcast_to(np.arange(level.shape[1]), level.shape)
    is_drop = np.nan_to_num(_lag(level, DROP_FLIGHTS) - level) > DROP
    return np.asarray(np.maximum.accumulate(np.where(is_drop, k, 0), axis=1))


def _slope(level: Array, start: Index) -> Array:
    """Fit a least-squares slope over flights `start`..k, per flight; 0 with fewer than five flights."""
    k = np.broadcast_to(np.arange(level.shape[1], dtype=float), level.shape)
    y = np.nan_to_num(level)
    n = k - start + 1.0
    mean_k = 0.5 * (k + start)
    sum_y = _span_sum(y, start)
    sum_ky = _span_sum(k * y, start)
    sum_squares = n * (n**2 - 1.0) / 12.0
    return np.asarray(np.where(n >= 5, (sum_ky - mean_k * sum_y) / np.maximum(sum_squares, 1.0), 0.0), dtype=float)


def _span_sum(values: Array, start: Index) -> Array:
    """Sum values over flights `start`..k, per flight."""
    total = np.cumsum(values, axis=1)
    return np.asarray(total - np.take_along_axis(total - values, start, axis=1))


def _rolling_max(values: Array, flights: int) -> Array:
    with_lead = np.concatenate([np.repeat(values[:, :1], flights - 1, axis=1), values], axis=1)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(with_lead, flights, axis=1).max(axis=-1))


def _roughness(level: Array) -> Array:
    """Compute the root mean square of the flight-to-flight change over 30 flights. [-]"""
    change = np.nan_to_num(np.diff(level, axis=1, prepend=level[:, :1])) ** 2
    k = np.broadcast_to(np.arange(level.shape[1]), level.shape)
    start = np.maximum(k - 29, 0)
    return np.asarray(np.sqrt(np.maximum(_span_sum(change, start), 0.0) / (k - start + 1.0)))


def _mean_finite(values: Array, flights: int) -> Array:
    """Average the finite values of the last flights; NaN without any."""
    k = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    start = np.maximum(k - flights + 1, 0)
    is_finite = np.isfinite(values)
    total = _span_sum(np.where(is_finite, values, 0.0), start)
    count = _span_sum(is_finite.astype(float), start)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1.0), np.nan))
