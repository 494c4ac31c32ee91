"""Track health flight by flight: each flight's estimate, filtered along each pack, with standard deviations."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.baseline_wear import EntryWear
from hdt_core.calibration.component_fit import has_closed_form
from hdt_core.calibration.compressor import ENTRY_UNIT_SD
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.exchanger import BIAS_SD
from hdt_core.components import Component
from hdt_core.components.pack import PARTS, Parts
from hdt_core.physics.heat_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K
from hdt_core.physics.model import Param
from hdt_core.records.keys import IN_ORDER, PACK
from hdt_core.robust import median_error
from hdt_core.tracking.component import DesignOffset, scatter_by_segment, wear_settings
from hdt_core.tracking.loss_filter import Loss, TrackResult, filtered, health_rows, join_tracks, track_loss
from hdt_core.tracking.sensor_shifts import CORRECTED, Corrections, corrections
from hdt_core.tracking.undone_work import without_undone
from hdt_core.tracking.wear_model import FAULT_CHANCE, Settings

EFFICIENCY_SD, DIAMETER_SD_LN = 0.006, 0.02
"""Scatter of a flight about the machine's state, for packs too young to show their own."""
ENTRY = (EntryWear(0.85, 0.0033, 0.025, True), EntryWear(0.15, 0.083, 0.05, False))
"""Machines at entry lose little for most of their life; wear where failure is the exchanger's."""
PROBE_SD, SAMPLE_SD = 0.0025, 0.003
"""Of a diameter, as a share of it: calibration of the probes (half a per cent of head), and noise of one sample."""
ACROSS_SD_K = float(np.hypot(BIAS_SD["hx_out_k"], BIAS_SD["ram_out_k"]))
"""Of the difference of the outlet temperatures: calibration of both sensors, which a flight can't average out."""
MOST_RELATIVE_SD = 0.25
RAM_FLOW_SD = 0.08
"""Of the ram flow by the clean duct's map, as a fraction."""


def track(
    twin_flights: pl.DataFrame,
    maintenance: pl.DataFrame,
    dsm: Dsm,
    previous: TrackResult | None = None,
    seal: str = "",
    parts: Parts = PARTS,
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
    parts : Parts
        The pack's parts, each with the method that made the flight estimates.
    """
    flights = twin_flights.sort(IN_ORDER)
    seal = f"{seal}|{dsm.dsm_version}"
    fouling = exchanger_loss(flights, corrections(flights), dsm, parts.exchanger)
    exchanger = track_loss(flights, maintenance, fouling, previous, seal)
    log = without_undone(maintenance, flights, -fouling.observations[0], exchanger.health, fouling.component)
    if log.height < maintenance.height:
        exchanger = track_loss(flights, log, fouling, previous, seal)
    losses = [exchanger, *track_compressor(flights, maintenance, dsm, previous, seal, parts.compressor)]
    tracks = join_tracks(losses)
    diameter = effective_diameter(flights, parts.compressor)
    valid = _null_invalid(pl.concat([tracks.health, lumped_coefficients(flights), diameter]))
    return tracks._replace(health=valid.sort(*PACK, "departed_at", "flight_id", "component", "parameter"))


def _null_invalid(rows: pl.DataFrame) -> pl.DataFrame:
    """Null values and sds where either is not finite or the sd is negative; their status is `no_number`."""
    value = pl.col("value")
    sd = pl.col("sd")
    is_invalid = (~value.is_finite() | ~sd.is_finite() | (sd < 0)).fill_null(False)
    status = pl.when(is_invalid).then(pl.lit("no_number")).otherwise("status").alias("status")
    return rows.with_columns(pl.when(~is_invalid).then(value), pl.when(~is_invalid).then(sd), status)


def exchanger_loss(flights: pl.DataFrame, faults: Corrections, dsm: Dsm, part: Component = PARTS.exchanger) -> Loss:
    """Build the exchanger's loss from the conductance ratio of each row of `flights` (in order), corrected."""
    ratio = flights["ln_ua_ratio"].to_numpy().astype(float) - faults.shift
    sampling, map_sd = (
        np.nan_to_num(flights[name].to_numpy().astype(float)) for name in ("ln_ua_ratio_sd", "ln_ua_ratio_map_sd")
    )
    variance = np.where(np.isfinite(ratio), sampling**2 + dsm.flight_sd**2 + faults.variance, 1.0)
    exposure = np.nan_to_num(flights["ua_expected_w_k"].to_numpy().astype(float) / dsm.reference_ua_w_k, nan=1.0)
    status = (
        pl.when(pl.col("ln_ua_ratio").is_null()).then(pl.lit("predicted"))
        .when(pl.Series(faults.fault)).then(pl.lit(CORRECTED))
        .otherwise("status")
    )  # fmt: skip
    settings = Settings(dsm.clean_level, dsm.clean_level_sd, dsm.offset_sd)
    observations = (ratio, variance, exposure)
    more_variance = (map_sd**2, faults.variance)
    return Loss(part, part.model.param(part.loss), 1.0, settings, observations, status, more_variance, faults.unchecked)


def track_compressor(
    flights: pl.DataFrame,
    maintenance: pl.DataFrame,
    dsm: Dsm,
    previous: TrackResult | None = None,
    seal: str = "",
    part: Component = PARTS.compressor,
) -> Iterator[TrackResult]:
    """Track `cc_efficiency_loss` and `cc_diameter_loss` of each pack from its first flight with an estimate on.

    Losses count from the fleet's machine as built, so a better one has a negative loss.
    """
    efficiency = np.log(_positive(flights["efficiency"]) / dsm.compressor.efficiency)
    diameter = np.log(_positive(flights["diameter_m"]) / _positive(flights["expected_diameter_m"]))
    built_sd = dsm.compressor.efficiency_sd / dsm.compressor.efficiency
    # the effective diameter is the true one times the root of slip times efficiency
    weak = replace(part, limit=replace(part.limit, mean=1.0 - float(np.sqrt(1.0 - part.limit.mean))))
    for component, name, ln_ratio, level_sd, usual_sd in (
        (part, "cc_efficiency_loss", efficiency, built_sd, EFFICIENCY_SD),
        (weak, "cc_diameter_loss", diameter, 0.0, DIAMETER_SD_LN),
    ):
        estimates = flights.select(PACK).with_columns(n=pl.Series(np.isfinite(ln_ratio)).cast(pl.Int32))
        has_begun = estimates.select(pl.col("n").cum_sum().over(PACK) > 0)[:, 0]
        own = flights.filter(has_begun)
        param = part.model.param(name)
        loss = _loss(own, component, param, ln_ratio[has_begun.to_numpy()], usual_sd)
        # the level's error is all machines' alike, and wear at entry was weighed in it: a pack's own must not shrink it
        loss = loss._replace(more_variance=(np.full(own.height, level_sd**2),))
        result = track_loss(own, maintenance, loss, previous, seal)
        before = flights.filter(~has_begun)
        names = (part.code, name, param.unit, filtered(part.estimator))
        nothing = pl.Series([None] * before.height, dtype=pl.Float64)
        not_recorded = health_rows(before, names, nothing, nothing, pl.lit("not_recorded"))
        yield result._replace(health=pl.concat([not_recorded, result.health]))


def _loss(flights: pl.DataFrame, component: Component, param: Param, ln_ratio: Array, usual_sd: float) -> Loss:
    size, settings = wear_settings(component, param, DesignOffset(0.0, 0.0))
    ratio = ln_ratio / size
    scatter = scatter_by_segment(flights, ratio, np.zeros_like(ratio), usual_sd / size)
    variance = np.where(np.isfinite(ratio), scatter**2, 1.0)
    has_failed = pl.col("cc_status").is_not_null() & ~pl.Series(np.isfinite(ratio))
    is_seen = (pl.col("cc_n_samples") > 0) & ~has_failed
    status = pl.when(is_seen).then(pl.lit("ok")).otherwise(pl.lit("predicted"))
    # a step of its probes is no rarer than one of the exchanger's
    settings = settings._replace(
        entries=ENTRY, fault_chance=FAULT_CHANCE, truncated=False, offset_sd=ENTRY_UNIT_SD / size
    )
    return Loss(component, param, size, settings, (ratio, variance, np.ones_like(ratio)), status)


def effective_diameter(flights: pl.DataFrame, part: Component = PARTS.compressor) -> pl.DataFrame:
    """Build rows of `cc_effective_diameter_m`.

    Scatter from sample to sample is mostly the machine's, and no error of the flight's median; it is one of the level
    that another method fits.
    """
    value = flights["diameter_m"]
    if has_closed_form(part):
        noise = SAMPLE_SD * median_error(np.maximum(flights["cc_n_samples"].to_numpy(), 1.0))
    else:
        noise = (flights["diameter_m_se"] / value).to_numpy()
    sd = (value * pl.Series(np.hypot(PROBE_SD, noise))).set(value.is_null(), None)
    known_status = pl.when(pl.col("cc_n_samples") > 0).then(pl.lit("ok")).otherwise(pl.lit("predicted"))
    why_null = pl.coalesce("cc_status", pl.lit("not_recorded"))
    status = pl.when(value.is_null()).then(why_null).otherwise(known_status)
    return health_rows(flights, (part.code, "cc_effective_diameter_m", "m", part.estimator), value, sd, status)


def _positive(column: pl.Series) -> Array:
    values = column.to_numpy().astype(float)
    return np.where(values > 0.0, values, np.nan)


def lumped_coefficients(flights: pl.DataFrame) -> pl.DataFrame:
    r"""Estimate `hx_h_hot_w_k` and `hx_h_cold_w_k` of every row, null where the flight does not identify them.

    Parameters
    ----------
    flights : DataFrame
        Of `estimate_flights`.

    Notes
    -----
    At steady state each equation gives its coefficient, if the ram outlet is measured:

    .. math:: H_h = W_h C_h \frac{T_{hi} - T_{ho}}{T_{ho} - T_{co}}, \quad
       H_c = W_r C_c \frac{T_{co} - T_{ci}}{T_{ho} - T_{co}}

    An efficient exchanger leaves its ram air warmer than its bleed air: the difference is negative, and no positive
    coefficient explains it. So only worn cores are identified, and few of them: see docs/errata.md.
    """
    k = {c: flights[c].to_numpy().astype(float) for c in ("hx_in_k", "hx_out_k", "ram_out_k", "tat_k")}
    across_k = k["hx_out_k"] - k["ram_out_k"]
    across_k = np.where(across_k > ACROSS_SD_K / MOST_RELATIVE_SD, across_k, np.nan)
    hot_w = flights["pack_flow_kg_s"].to_numpy().astype(float) * CP_HOT_J_KG_K * (k["hx_in_k"] - k["hx_out_k"])
    cold_w = flights["ram_flow_kg_s"].to_numpy().astype(float) * CP_COLD_J_KG_K * (k["ram_out_k"] - k["tat_k"])
    flow_sds = {"hx_h_hot_w_k": (hot_w, BIAS_SD["pack_flow_kg_s"]), "hx_h_cold_w_k": (cold_w, RAM_FLOW_SD)}
    return pl.concat(
        _rows(flights, name, heat_w / across_k, np.hypot(ACROSS_SD_K / across_k, flow_sd))
        for name, (heat_w, flow_sd) in flow_sds.items()
    )


def _rows(flights: pl.DataFrame, name: str, value: Array, relative_sd: Array) -> pl.DataFrame:
    values = pl.Series(value).fill_nan(None)
    status = pl.when(values.is_null()).then(pl.lit("not_identifiable")).otherwise(pl.lit("ok"))
    sd = pl.Series(value * relative_sd).fill_nan(None)
    return health_rows(flights, ("HX", name, "W/K", "closed_form"), values, sd, status)
