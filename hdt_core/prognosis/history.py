"""What a health track says about its own future: causal features, one row a unit, one column a flight.

Every feature at flight k is a function of flights up to k of that unit. Losses are divided by the loss at which the
aircraft speaks (the limit), so that one model serves exchangers and compressors, and fleets with other limits.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int_]

HORIZONS = (10, 30, 100)
FEATURES = (
    "level",
    "level_sd",
    "peak",
    "age_flights",
    "seen_flights",
    "entry_level",
    *(f"slope_{h}" for h in HORIZONS),
    "slope_segment",
    "slope_life",
    "bend",
    "roughness",
    "jump_10",
    "jump_largest",
    "jump_share",
    "left_linear_30",
    "left_linear_100",
    "left_linear_segment",
    "left_power",
    "full_open_10",
    "full_open_40",
)
_FAR = 1000.0
_DROP = 0.08  # of the limit: larger than any noise of a filtered track over three flights


def history(level: Array, sd: Array, age: Array, full_open: Array) -> dict[str, Array]:
    """Features of health tracks.

    Parameters
    ----------
    level : array, shape (units, flights)
        Health loss over its limit, forward filled; NaN before the first and after the last flight. [-]
    sd : array, shape (units, flights)
        Its standard deviation on the same scale. [-]
    age : array, shape (units, flights)
        Flights since installation; NaN where the unit was already flying when the record began. [flight]
    full_open : array, shape (units, flights)
        Share of the cruise with the ram door full open, where there is one; NaN where unknown. [-]

    Returns
    -------
    dict of str to array
        One (units, flights) array for each of `FEATURES`; slopes per flight, NaN where undefined.
    """
    flights = level.shape[1]
    k = np.broadcast_to(np.arange(flights), level.shape)
    start = _segment_start(level)
    slope: dict[str, Array] = {f"slope_{h}": _slope(level, np.maximum(start, k - h + 1)) for h in HORIZONS}
    segment, life = _slope(level, start), _slope(level, np.zeros_like(start))
    jump = np.nan_to_num(level - _back(level, 3))
    peak = np.asarray(np.fmax.accumulate(level, axis=1))
    largest = np.asarray(np.maximum.accumulate(jump, axis=1))
    entry = np.broadcast_to(np.asarray(level[:, :5].mean(axis=1, keepdims=True)), level.shape)
    risen = np.cumsum(np.maximum(jump - 0.05, 0.0), axis=1) / 3.0
    return {
        "level": level,
        "level_sd": sd,
        "peak": peak,
        "age_flights": age,
        "seen_flights": np.asarray(k + 1.0, dtype=float),
        "entry_level": np.asarray(np.where(k < 5, level, entry)),
        **slope,
        "slope_segment": segment,
        "slope_life": life,
        "bend": slope["slope_30"] - slope["slope_100"],
        "roughness": _roughness(level),
        "jump_10": _rolling_max(jump, 10),
        "jump_largest": largest,
        "jump_share": risen / np.maximum(peak, 0.05),
        "left_linear_30": _left_linear(level, slope["slope_30"]),
        "left_linear_100": _left_linear(level, slope["slope_100"]),
        "left_linear_segment": _left_linear(level, segment),
        "left_power": _left_power(
            level, np.asarray(k - start + 1.0, dtype=float), slope["slope_100"], np.minimum(k - start, 99.0)
        ),
        "full_open_10": _mean_known(full_open, 10),
        "full_open_40": _mean_known(full_open, 40),
    }


def _back(values: Array, flights: int) -> Array:
    """Values some flights earlier; the first value before that."""
    return np.concatenate([np.repeat(values[:, :1], flights, axis=1), values[:, :-flights]], axis=1)[
        :, : values.shape[1]
    ]


def _segment_start(level: Array) -> Index:
    """Flight on which the current stretch began: entry, or the last clear drop (a wash, a change not yet logged)."""
    k = np.broadcast_to(np.arange(level.shape[1]), level.shape)
    dropped = np.nan_to_num(_back(level, 3) - level) > _DROP
    return np.asarray(np.maximum.accumulate(np.where(dropped, k, 0), axis=1))


def _slope(level: Array, start: Index) -> Array:
    """Least-squares slope over flights `start`..k, per flight; 0 while fewer than five are seen, NaN-free."""
    k = np.broadcast_to(np.arange(level.shape[1], dtype=float), level.shape)
    y = np.nan_to_num(level)
    n = k - start + 1.0
    mean_k = 0.5 * (k + start)
    sum_y, sum_ky = _span_sum(y, start), _span_sum(k * y, start)
    spread = n * (n**2 - 1.0) / 12.0
    return np.asarray(np.where(n >= 5, (sum_ky - mean_k * sum_y) / np.maximum(spread, 1.0), 0.0), dtype=float)


def _span_sum(values: Array, start: Index) -> Array:
    total = np.cumsum(values, axis=1)
    before = np.take_along_axis(total - values, start, axis=1)
    return np.asarray(total - before)


def _rolling_max(values: Array, flights: int) -> Array:
    padded = np.concatenate([np.repeat(values[:, :1], flights - 1, axis=1), values], axis=1)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, flights, axis=1).max(axis=-1))


def _roughness(level: Array) -> Array:
    """Root mean square of the flight-to-flight change over 30 flights, per limit."""
    change = np.nan_to_num(np.diff(level, axis=1, prepend=level[:, :1])) ** 2
    k = np.broadcast_to(np.arange(level.shape[1]), level.shape)
    start = np.maximum(k - 29, 0)
    return np.asarray(np.sqrt(np.maximum(_span_sum(change, start), 0.0) / (k - start + 1.0)))


def _mean_known(values: Array, flights: int) -> Array:
    """Mean of what is known of the last flights; NaN where nothing is."""
    k = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    start = np.maximum(k - flights + 1, 0)
    count = _span_sum(np.isfinite(values).astype(float), start)
    total = _span_sum(np.nan_to_num(values), start)
    return np.asarray(np.where(count > 0.5, total / np.maximum(count, 1.0), np.nan))


def _left_linear(level: Array, slope: Array) -> Array:
    """Flights until the limit on a straight line through the present; `_FAR` when it doesn't rise."""
    return np.asarray(np.clip((1.0 - level) / np.maximum(slope, 1.0 / _FAR / 2.0), 0.0, _FAR), dtype=float)


def _left_power(level: Array, n: Array, slope: Array, span: Array) -> Array:
    """Flights until the limit on x ~ n^p, the exponent p = x'n/x read in the middle of the last `span` flights."""
    n_mid, x_mid = n - 0.5 * span, np.maximum(level - 0.5 * span * slope, 0.02)
    p = np.clip(slope * n_mid / x_mid, 0.3, 4.0)
    x = np.clip(level, 0.02, 1.0)
    return np.asarray(np.clip(n * (x ** (-1.0 / p) - 1.0), 0.0, _FAR))
