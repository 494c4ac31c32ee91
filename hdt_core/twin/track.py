"""Health flight by flight: what each flight said, filtered along each pack, with its certainty."""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.twin import histories
from hdt_core.twin.crossing import IN_ORDER, PACK, Array
from hdt_core.twin.dsm import Dsm
from hdt_core.twin.hindsight import looking_back
from hdt_core.twin.lumped import lumped_coefficients
from hdt_core.twin.machine import compressor_parameters
from hdt_core.twin.renewals import log_flags
from hdt_core.twin.wear import Observation, Settings
from hdt_core.twin.witness import Corrections, corrections

FILTERED, SMOOTHED = "kalman_filtered", "kalman_smoothed"
BLOCK_FLIGHTS = 8_000
"""Flights of packs that advance side by side: looking back keeps all their beliefs, some 15 kB a flight."""
KEYS = ["operator", "tail", "flight_id", "pack", "departed_at"]


def track(twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Health parameters of every flight and pack; what is not called smoothed takes nothing from later flights.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights`; any subset of whole packs, all their flights so far.
    maintenance : DataFrame
        `operator, tail, pack, component, action, done_on`; entries count from the day they name.
    dsm : Dsm
        The model the flights were judged by.

    Returns
    -------
    DataFrame
        Long form: `KEYS`, component, parameter, value, sd, unit, status, estimator.
    """
    flights = twin_flights.sort(IN_ORDER)
    exchanger = fouling(flights, maintenance, dsm)
    rows = [exchanger, lumped_coefficients(flights), compressor_parameters(flights, maintenance, dsm)]
    return pl.concat(rows).sort(*PACK, "departed_at", "flight_id", "component", "parameter")


class Wave(NamedTuple):
    """Flights of all packs side by side, (flights, packs); `row` is the row in the frame, -1 where a pack has no
    more."""

    row: Array
    ratio: Array
    variance: Array
    exposure: Array
    log_open: Array
    log_due: Array

    @property
    def n_rows(self) -> int:
        """Rows of the frame."""
        return int((self.row >= 0).sum())

    def flight(self, k: int, packs: slice) -> Observation:
        """Flight k of some packs."""
        return Observation(*(values[k, packs] for values in self[1:]))


def fouling(flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, *, literal: bool = False) -> pl.DataFrame:
    """`hx_fouling` of every row of `flights` (in order), and `hx_fouling_smoothed`, which also knows later flights.

    `literal` walks pack by pack, flight by flight, and does not look back.
    """
    faults = corrections(flights)
    wave = _side_by_side(flights, faults, maintenance, dsm)
    settings = Settings(dsm.clean_level, dsm.clean_level_sd, dsm.offset_sd)
    map_sd = np.nan_to_num(flights["ln_ua_ratio_map_sd"].to_numpy().astype(float))
    if literal:
        return _rows(flights, "hx_fouling", FILTERED, *one_by_one(wave, settings), map_sd, faults)
    filtered, smoothed = all_at_once(wave, settings)
    tracks = (("hx_fouling", FILTERED, filtered), ("hx_fouling_smoothed", SMOOTHED, smoothed))
    return pl.concat(_rows(flights, name, how, *track, map_sd, faults) for name, how, track in tracks)


def _rows(
    flights: pl.DataFrame, name: str, how: str, level: Array, sd: Array, map_sd: Array, faults: Corrections
) -> pl.DataFrame:
    value, value_sd = loss_of(level, np.sqrt(sd**2 + map_sd**2 + faults.variance))
    status = (
        pl.when(pl.col("ln_ua_ratio").is_null())
        .then(pl.lit("predicted"))
        .when(pl.Series(faults.fault))
        .then(pl.lit("sensor_corrected"))
        .otherwise(pl.col("status"))
    )
    return flights.select(
        *KEYS,
        pl.lit("HX").alias("component"),
        pl.lit(name).alias("parameter"),
        pl.Series("value", value),
        pl.Series("sd", value_sd),
        pl.lit("-").alias("unit"),
        status.alias("status"),
        pl.lit(how).alias("estimator"),
    )


def all_at_once(wave: Wave, settings: Settings) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Filtered and smoothed (mean, sd) of ln loss after each flight, packs advancing together. (rows of the frame,)"""
    found = np.empty((4, wave.n_rows))
    side_by_side = max(1, BLOCK_FLIGHTS // max(1, wave.row.shape[0]))
    for first in range(0, wave.row.shape[1], side_by_side):
        packs = slice(first, min(first + side_by_side, wave.row.shape[1]))
        n, beliefs, passages = packs.stop - packs.start, [], []
        belief = histories.start(n, settings)
        for k in range(wave.row.shape[0]):
            belief, passage = histories.step(belief, wave.flight(k, packs), settings)
            beliefs.append(belief)
            passages.append(passage)
        summaries = np.array([histories.wear_summary(b, n) for b in beliefs])
        back = looking_back(beliefs, passages, n)
        here = wave.row[:, packs] >= 0
        for j, track in enumerate((summaries[:, 0], summaries[:, 1], *back)):
            found[j, wave.row[:, packs][here]] = track[here]
    return (found[0], found[1]), (found[2], found[3])


def one_by_one(wave: Wave, settings: Settings) -> tuple[Array, Array]:
    """Return the filtered track by the literal recursion: flight k of a pack starts from what is known after k - 1."""
    level, sd = np.empty(wave.n_rows), np.empty(wave.n_rows)
    for pack in range(wave.row.shape[1]):
        belief = histories.start(1, settings)
        for k, row in enumerate(wave.row[:, pack]):
            if row >= 0:
                belief, _ = histories.step(belief, wave.flight(k, slice(pack, pack + 1)), settings)
                mean, spread = histories.wear_summary(belief, 1)
                level[row], sd[row] = mean[0], spread[0]
    return level, sd


def loss_of(level: Array, sd: Array) -> tuple[Array, Array]:
    """Loss as a fraction and its standard deviation, from ln loss and its own."""
    left = np.exp(-level)
    return 1.0 - left, left * sd


def _side_by_side(flights: pl.DataFrame, faults: Corrections, maintenance: pl.DataFrame, dsm: Dsm) -> Wave:
    pack = flights.select(pl.struct(PACK).rank("dense"))[:, 0].to_numpy().astype(np.int64) - 1
    n_packs = int(pack.max()) + 1 if len(pack) else 0
    start = np.searchsorted(pack, np.arange(n_packs))
    turn = np.arange(len(pack)) - start[pack] if len(pack) else np.zeros(0, dtype=np.int64)
    shape = (int(turn.max()) + 1 if len(turn) else 0, n_packs)
    index = np.full(shape, -1)
    index[turn, pack] = np.arange(len(pack))
    ratio = flights["ln_ua_ratio"].to_numpy().astype(float) - faults.shift
    sampling = flights["ln_ua_ratio_sd"].to_numpy().astype(float)
    variance = np.where(np.isfinite(ratio), np.nan_to_num(sampling) ** 2 + dsm.flight_sd**2 + faults.variance, 1.0)
    exposure = np.nan_to_num(flights["ua_expected_w_k"].to_numpy().astype(float) / dsm.reference_ua_w_k, nan=1.0)
    log_open, log_due = log_flags(flights, maintenance, "HX")

    def spread(values: Array, empty: float) -> Array:
        return np.where(index >= 0, values[np.maximum(index, 0)], empty)

    return Wave(
        index,
        spread(ratio, np.nan),
        spread(variance, 1.0),
        spread(exposure, 1.0),
        spread(log_open, 0),
        spread(log_due, 0),
    )
