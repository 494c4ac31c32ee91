"""Track health flight by flight: each flight's estimate, filtered along each pack, with standard deviations."""

import numpy as np
import polars as pl

from hdt_core.calibration.dsm import Dsm
from hdt_core.components.exchanger import HX
from hdt_core.records.keys import IN_ORDER, PACK
from hdt_core.tracking.compressor_tracking import effective_diameter, track_compressor
from hdt_core.tracking.loss_filter import Loss, TrackResult, join_tracks, track_loss
from hdt_core.tracking.lumped_coefficients import lumped_coefficients
from hdt_core.tracking.sensor_shifts import Corrections, corrections
from hdt_core.tracking.wear_model import Settings


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
    flights, seal = twin_flights.sort(IN_ORDER), f"{seal}|{dsm.dsm_version}"
    exchanger = track_loss(flights, maintenance, exchanger_loss(flights, corrections(flights), dsm), previous, seal)
    losses = [exchanger, *track_compressor(flights, maintenance, dsm, previous, seal)]
    tracks = join_tracks(losses)
    valid = _null_invalid(pl.concat([tracks.health, lumped_coefficients(flights), effective_diameter(flights)]))
    return tracks._replace(health=valid.sort(*PACK, "departed_at", "flight_id", "component", "parameter"))


def _null_invalid(rows: pl.DataFrame) -> pl.DataFrame:
    """Null values and sds where either is not finite or the sd is negative; their status is `no_number`."""
    value, sd = pl.col("value"), pl.col("sd")
    is_invalid = (~value.is_finite() | ~sd.is_finite() | (sd < 0)).fill_null(False)
    status = pl.when(is_invalid).then(pl.lit("no_number")).otherwise("status").alias("status")
    return rows.with_columns(pl.when(~is_invalid).then(value), pl.when(~is_invalid).then(sd), status)


def exchanger_loss(flights: pl.DataFrame, faults: Corrections, dsm: Dsm) -> Loss:
    """Build the exchanger's loss from the conductance ratio of each row of `flights` (in order), corrected."""
    ratio = flights["ln_ua_ratio"].to_numpy().astype(float) - faults.shift
    sampling, map_sd = (
        np.nan_to_num(flights[name].to_numpy().astype(float)) for name in ("ln_ua_ratio_sd", "ln_ua_ratio_map_sd")
    )
    variance = np.where(np.isfinite(ratio), sampling**2 + dsm.flight_sd**2 + faults.variance, 1.0)
    exposure = np.nan_to_num(flights["ua_expected_w_k"].to_numpy().astype(float) / dsm.reference_ua_w_k, nan=1.0)
    status = (
        pl.when(pl.col("ln_ua_ratio").is_null()).then(pl.lit("predicted"))
        .when(pl.Series(faults.fault)).then(pl.lit("sensor_corrected"))
        .otherwise("status")
    )  # fmt: skip
    settings = Settings(dsm.clean_level, dsm.clean_level_sd, dsm.offset_sd)
    observations, more_variance = (ratio, variance, exposure), (map_sd**2, faults.variance)
    return Loss(HX, HX.model.param(HX.loss), 1.0, settings, observations, status, more_variance, faults.unchecked)
