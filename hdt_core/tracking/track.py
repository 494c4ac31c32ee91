"""Track health flight by flight: each flight's estimate, filtered along each pack, with standard deviations."""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.dsm import Dsm
from hdt_core.records.keys import IN_ORDER, LEG_AT, PACK
from hdt_core.tracking.checkpoints import checkpoint_rows, from_first_flight, read_checkpoints
from hdt_core.tracking.compressor_tracking import compressor_parameters
from hdt_core.tracking.flight_panel import FILTERED, build_panel, fingerprints, health_rows
from hdt_core.tracking.lumped_coefficients import lumped_coefficients
from hdt_core.tracking.segments import SEGMENT_FLIGHTS, filter_segments
from hdt_core.tracking.sensor_shifts import Corrections, corrections
from hdt_core.tracking.wear_model import Settings

SMOOTHED = "kalman_smoothed"
LOSS, LOSS_SMOOTHED = "hx_fouling", "hx_fouling_smoothed"


class TrackResult(NamedTuple):
    """Health parameters, table `twin_health`, and the checkpoints from which the next night goes on."""

    health: pl.DataFrame
    checkpoints: pl.DataFrame


def track(
    twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, previous: TrackResult | None = None, seal: str = ""
) -> TrackResult:
    """Track the health parameters of every flight and pack; only those called smoothed use later flights.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights`; any subset of whole packs, all their flights so far.
    maintenance : DataFrame
        `operator, tail, pack, component, action, done_on`; entries count from the day they name.
    dsm : Dsm
        The model of the flight estimates.
    previous : TrackResult, optional
        Result of an earlier call for the same packs, or for some of them: packs whose earlier flights are unchanged
        continue from it.
    seal : str
        Further inputs of the track, the version of the code; results under another are not used.
    """
    flights = twin_flights.sort(IN_ORDER)
    health, checkpoints = _exchanger(flights, maintenance, dsm, previous, f"{seal}|{dsm.dsm_version}")
    rows = [health, lumped_coefficients(flights), compressor_parameters(flights, maintenance, dsm)]
    valid = _null_invalid(pl.concat(rows))
    return TrackResult(valid.sort(*PACK, "departed_at", "flight_id", "component", "parameter"), checkpoints)


def _null_invalid(rows: pl.DataFrame) -> pl.DataFrame:
    """Null values and sds where either is not finite or the sd is negative; their status is `no_number`."""
    value, sd = pl.col("value"), pl.col("sd")
    is_invalid = (~value.is_finite() | ~sd.is_finite() | (sd < 0)).fill_null(False)
    status = pl.when(is_invalid).then(pl.lit("no_number")).otherwise("status").alias("status")
    return rows.with_columns(pl.when(~is_invalid).then(value), pl.when(~is_invalid).then(sd), status)


def _exchanger(
    flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, previous: TrackResult | None, seal: str
) -> TrackResult:
    faults = corrections(flights)
    map_sd = np.nan_to_num(flights["ln_ua_ratio_map_sd"].to_numpy().astype(float))
    panel = build_panel(flights, faults, maintenance, dsm)
    names = flights.select(pl.concat_str("flight_id", "status", separator="="))[:, 0].to_list()
    digests = fingerprints(panel, [map_sd, faults.variance, faults.fault], names, seal, SEGMENT_FLIGHTS)
    packs = flights.select(PACK).unique(maintain_order=True)
    restart = (
        from_first_flight(packs.height) if previous is None else read_checkpoints(previous.checkpoints, packs, digests)
    )
    settings = Settings(dsm.clean_level, dsm.clean_level_sd, dsm.offset_sd)
    result = filter_segments(panel, settings, restart.begin, restart.checkpoints)
    is_new = pl.Series(np.isfinite(result.tracks[0]))
    tracks = ((LOSS, FILTERED, result.tracks[:2]), (LOSS_SMOOTHED, SMOOTHED, result.tracks[2:]))
    health = pl.concat(
        _rows(flights, name, estimator, track[0], track[1], map_sd, faults).filter(is_new)
        for name, estimator, track in tracks
    )
    if previous is not None and not is_new.all():
        old_rows = previous.health.filter(pl.col("parameter").is_in([LOSS, LOSS_SMOOTHED])).select(health.columns)
        old_rows = old_rows.join(flights.filter(~is_new).select(LEG_AT), on=LEG_AT, how="semi")
        if old_rows.height != len(tracks) * (~is_new).sum():  # rows before the checkpoints have been removed
            return _exchanger(flights, maintenance, dsm, None, seal)
        health = pl.concat([old_rows, health])
    return TrackResult(health, checkpoint_rows(packs, digests, restart, result.checkpoints))


def _rows(
    flights: pl.DataFrame, name: str, estimator: str, level: Array, sd: Array, map_sd: Array, faults: Corrections
) -> pl.DataFrame:
    value, value_sd = loss_of(level, np.sqrt(sd**2 + map_sd**2 + faults.variance))
    status = (
        pl.when(pl.col("ln_ua_ratio").is_null()).then(pl.lit("predicted"))
        .when(pl.Series(faults.fault)).then(pl.lit("sensor_corrected"))
        .otherwise("status")
    )  # fmt: skip
    return health_rows(flights, ("HX", name, "-", estimator), value, value_sd, status)


def loss_of(level: Array, sd: Array) -> tuple[Array, Array]:
    """Convert ln loss and its sd to a loss and its sd."""
    ratio = np.exp(-level)
    return 1.0 - ratio, ratio * sd
