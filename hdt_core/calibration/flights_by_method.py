"""Estimate the pack's parts from one flight alone by the method that each names.

The declared models stand at the digital system model's design, and what is estimated is each flight's loss. The
default method has a closed form (`flight_estimates`, `compressor`) and does not come here. The closed form's values of
the samples tell spikes, which a method that squares residuals would follow.
"""

from collections.abc import Mapping
from dataclasses import replace

import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.component_fit import (
    LEAST_LOSS,
    WITHOUT_ESTIMATE,
    declared_estimator,
    flight_by_flight,
    is_regular,
)
from hdt_core.calibration.compressor import CompressorFit
from hdt_core.calibration.compressor_by_method import compressor_inputs
from hdt_core.components import Component
from hdt_core.physics.compressor import COMPRESSION
from hdt_core.physics.model import Array, PhysicsModel
from hdt_core.records.keys import FLIGHT_PACK


def exchanger_flights(
    samples: pl.DataFrame, signals: Mapping[str, Array], design: Array, part: Component
) -> pl.DataFrame:
    """Estimate the ln conductance ratio of every flight from the hot outlet by the exchanger's own method.

    Parameters
    ----------
    samples : DataFrame
        `FLIGHT_PACK`, `time_utc`, `departed_at` where there is one, and `ratio`, each sample's ln conductance ratio in
        closed form. (n,)
    signals : mapping of str to array (n,)
        Signals without their sensors' biases, SI.
    design : array (p,)
        Of the digital system model, in the order of `exchanger.NAMES`.
    part : Component
        The heat exchanger, with its estimator.

    Returns
    -------
    DataFrame
        `FLIGHT_PACK`, `ln_ua_ratio` and its random `_sd`, null where the method gives no estimate; `hx_status`, how it
        ended there, else null.
    """
    model = part.model.calibrated(dict(zip(hx.NAMES, design.tolist(), strict=True)))
    names = [*(s.name for s in model.inputs), "hx_out_k"]
    rows = samples.with_columns(pl.Series(name, signals[name]) for name in names).filter(is_regular("ratio"))
    flights = _losses(rows, model, part.loss, "hx_out_k", part)
    left = 1.0 - pl.col(part.loss)
    return flights.select(
        *FLIGHT_PACK,
        left.log().alias("ln_ua_ratio"),
        (pl.col(f"{part.loss}_sd") / left).alias("ln_ua_ratio_sd"),
        pl.col("failure").alias("hx_status"),
    )


def compressor_flights_by_method(samples: pl.DataFrame, fit: CompressorFit, part: Component) -> pl.DataFrame:
    """Estimate diameter and efficiency of every flight by the compressor's own method.

    Parameters
    ----------
    samples : DataFrame
        Of `compressor_samples`. Where the diffuser is not recorded, it counts as in the middle of its positions.
    fit : CompressorFit
        Of the digital system model.
    part : Component
        The compressor, with its estimator.

    Returns
    -------
    DataFrame
        `FLIGHT_PACK`; `diameter_m` [m], `efficiency` [-] and the standard deviation `_se` of each, null where the
        method gives no estimate; `cc_n_samples`, samples behind the diameter; `cc_status`, how the method ended where
        it gives none of one of them, else null.
    """
    rows = compressor_inputs(samples, fit.vda_counts)
    diameter = _diameters(rows.drop_nulls("diameter_m").filter(is_regular("diameter_m")), fit, part)
    efficiency = _efficiencies(rows.drop_nulls("efficiency").filter(is_regular("efficiency")), fit, part)
    flights = diameter.join(efficiency, on=FLIGHT_PACK, how="full", coalesce=True, validate="1:1")
    status = pl.coalesce("failure", "failure_right").alias("cc_status")
    return flights.with_columns(status, pl.col("cc_n_samples").fill_null(0)).drop("failure", "failure_right")


def _diameters(rows: pl.DataFrame, fit: CompressorFit, part: Component) -> pl.DataFrame:
    design = {"cc_diameter_vda_intercept": fit.intercept_m, "cc_diameter_vda_slope": fit.slope_m_per_count}
    losses = _losses(rows, part.model.calibrated(design), "cc_diameter_loss", "cc_out_pa", part)
    medians = rows.group_by(FLIGHT_PACK).agg(pl.col("vda_counts").median(), n=pl.len())
    flights = losses.join(medians, on=FLIGHT_PACK, how="left", maintain_order="left", validate="1:1")
    flights = flights.with_columns(pl.Series("built_m", fit.diameter_m(flights["vda_counts"].to_numpy())))
    return flights.select(
        *FLIGHT_PACK,
        (pl.col("built_m") * (1.0 - pl.col("cc_diameter_loss"))).alias("diameter_m"),
        (pl.col("built_m") * pl.col("cc_diameter_loss_sd")).alias("diameter_m_se"),
        pl.when(pl.col("failure").is_null()).then("n").alias("cc_n_samples"),
        "failure",
    )


def _efficiencies(rows: pl.DataFrame, fit: CompressorFit, part: Component) -> pl.DataFrame:
    model = COMPRESSION.calibrated({"cc_efficiency": fit.efficiency})
    return _losses(rows, model, part.loss, "cc_out_k", part).select(
        *FLIGHT_PACK,
        (fit.efficiency * (1.0 - pl.col(part.loss))).alias("efficiency"),
        (fit.efficiency * pl.col(f"{part.loss}_sd")).alias("efficiency_se"),
        "failure",
    )


def _losses(samples: pl.DataFrame, model: PhysicsModel, loss: str, output: str, part: Component) -> pl.DataFrame:
    """Estimate a loss flight by flight from one output; null where the method gives none, and `failure` says why."""
    wide = replace(model.param(loss), bounds=(LEAST_LOSS, model.param(loss).bounds[1]))
    params = tuple(wide if p.name == loss else p for p in model.params)
    method = declared_estimator(part)
    sd = f"{loss}_sd"
    flights = flight_by_flight(
        samples, replace(model, params=params), [loss], outputs=[output], estimator=method, min_samples=1
    )
    # a method of others may call fine what is no number
    is_number = pl.col(loss).is_finite() & pl.col(sd).is_finite()
    failure = (
        pl.when(pl.col("status").is_in(WITHOUT_ESTIMATE)).then("status")
        .when(~is_number).then(pl.lit("diverged"))
        .alias("failure")
    )  # fmt: skip
    flights = flights.select(*FLIGHT_PACK, loss, sd, failure)
    return flights.with_columns(pl.when(pl.col("failure").is_null()).then(c).alias(c) for c in (loss, sd))
