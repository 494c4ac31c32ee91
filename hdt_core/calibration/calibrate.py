"""Calibrate the Digital System Model from nominal flights."""

from dataclasses import replace

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import (
    Array,
    Points,
    correct_inputs,
    cruise_samples,
    flights_of,
    level_points,
    to_points,
)
from hdt_core.calibration.baseline_wear import entry_posterior, first_levels, fleet_levels
from hdt_core.calibration.component_fit import CLOSED_FORM, has_closed_form
from hdt_core.calibration.compressor import compressor_samples, fit_compressor
from hdt_core.calibration.dsm import Dsm, SensorBiases, version_of
from hdt_core.calibration.exchanger import exchanger_panel
from hdt_core.calibration.exchanger_by_method import design_by_method
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.calibration.inlet_law import learn_inlet
from hdt_core.calibration.missing_physics import coefficients
from hdt_core.calibration.pooling import PooledLevel, levels_of
from hdt_core.calibration.sensor_biases import probe_corrections, sensor_prior
from hdt_core.components import Component
from hdt_core.components.pack import PARTS, Parts
from hdt_core.estimation import Estimate
from hdt_core.estimation.panel import Panel, PanelLeastSquares
from hdt_core.flight.legs import baseline_flights
from hdt_core.flight.quality import flow_steps
from hdt_core.physics.heat_exchanger import REFERENCE_HOT_FLOW_KG_S, REFERENCE_RAM_FLOW_KG_S
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.physics.terms import within
from hdt_core.records.keys import FLIGHT, FLIGHT_PACK, IN_ORDER, PACK, of_each_aircraft
from hdt_core.robust import median_error

TERM_ROUNDS = 3


def calibrate(
    samples: pl.DataFrame,
    legs: pl.DataFrame,
    maintenance: pl.DataFrame,
    terms: tuple[str, ...] = (),
    parts: Parts = PARTS,
) -> Dsm:
    """Calibrate the Digital System Model from the baseline flights among `samples`.

    Parameters
    ----------
    samples, legs : DataFrame
        Of the leg filter; admitted legs calibrate, monitored samples of the others do not.
    maintenance : DataFrame
        `operator, tail, done_on, pack, component, action`; exchanger replacements split a pack's baseline into units.
    terms : tuple of str
        Physical terms accepted by name (`physics.terms`); coefficient and design are estimated in turn.
    parts : Parts
        The pack's parts, each with the estimator of its design. Levels are of the closed form's flight estimates.

    Returns
    -------
    Dsm
        Depends on the data set alone. With no usable flight it holds the priors and their standard deviations.

    Raises
    ------
    ValueError
        No installed package has a method that a part names.
    """
    model = _calibrate(samples, legs, maintenance, parts, dict.fromkeys(terms, 0.0))
    for _ in range(TERM_ROUNDS if terms else 0):
        estimates = estimate_flights(baseline_samples(samples), model)
        changes = coefficients(estimates, model, terms)
        values = {n: within(n, model.terms[n] + changes[n]) for n in terms}
        model = _calibrate(samples, legs, maintenance, parts, values)
    return model


def baseline_samples(samples: pl.DataFrame) -> pl.DataFrame:
    """Select samples of the baseline's flights, of worn packs too: changes from flight to flight are not wear."""
    return samples.filter(pl.col("flight_id").is_in(baseline_flights(flights_of(samples))))


def _calibrate(
    samples: pl.DataFrame, legs: pl.DataFrame, maintenance: pl.DataFrame, parts: Parts, terms: dict[str, float]
) -> Dsm:
    draft = _draft_model(samples, legs, terms, parts)
    estimates = of_each_aircraft(baseline_samples(samples), lambda pack_samples: estimate_flights(pack_samples, draft))
    steps = flow_steps(baseline_samples(samples))
    model = fleet_levels(estimates, maintenance, draft, steps.filter(pl.col("pack_flow_step_ln") > 0.0))
    return replace(model, levels=exchanger_levels(estimates, model))


def _draft_model(samples: pl.DataFrame, legs: pl.DataFrame, terms: dict[str, float], parts: Parts = PARTS) -> Dsm:
    """Build the model without the fleet's clean level, which needs its flight estimates."""
    flights = flights_of(samples)
    base = flights.filter(pl.col("flight_id").is_in(baseline_flights(flights)))
    nominal = _select_admitted(base, legs).select(FLIGHT_PACK)
    window = baseline_samples(samples)
    cruise = cruise_samples(window).join(nominal, on=FLIGHT_PACK, how="semi")
    packs = flights.select(PACK).unique().sort(PACK)
    levels = level_points(correct_inputs(cruise, terms), flights)
    steps = flow_steps(window)
    levels = levels.join(steps, on=FLIGHT, how="left", maintain_order="left", validate="m:1")
    points = to_points(levels, packs)
    panel = exchanger_panel(points, *sensor_prior(cruise, packs))
    estimate, bias = _exchanger_design(points, panel, parts.exchanger)
    design = estimate.belief.mean
    machine = cruise_samples(window, monitored=False).join(nominal, on=FLIGHT_PACK, how="semi")
    corrections = probe_corrections(machine, packs)
    compressor = fit_compressor(compressor_samples(machine, corrections), parts.compressor)
    counts = base.group_by(PACK).agg(pl.len().alias("n_flights"))
    rows = corrections.join(counts, on=PACK, how="left", maintain_order="left", validate="m:1")
    rows = rows.with_columns(pl.col("n_flights").fill_null(0))
    draft = Dsm(
        dsm_version=version_of(_inputs(window), nominal.sort(FLIGHT_PACK), methods=_methods(parts)),
        exchanger=tuple(design.tolist()),
        exchanger_cov=tuple(map(tuple, estimate.belief.cov.tolist())),
        gradient=tuple(_mean_gradient(points, design, bias).tolist()),
        clean_level=0.0,
        clean_level_sd=0.05,
        offset_sd=0.055,
        flight_sd=0.02,
        reference_ua_w_k=1700.0,
        ram_balance_seen=bool(panel.others),
        compressor=compressor,
        packs=tuple(
            SensorBiases(bias=tuple(own), **row)
            for row, own in zip(rows.iter_rows(named=True), bias.tolist(), strict=True)
        ),
        n_flights=base["flight_id"].n_unique(),
        cruise_flows_kg_s=_middle_flows(points, design),
        terms=terms,
        exchanger_status=estimate.status,
        exchanger_method=estimate.method,
    )
    fine = cruise.join(steps.filter(pl.col("pack_flow_step_ln") > 0.0), on=FLIGHT, how="anti")
    cruise = (fine if fine.height else cruise).sort(*FLIGHT_PACK, "time_utc", "source")
    return replace(draft, hot_inlet=learn_inlet(cruise, draft.design, draft.bias_of(cruise)))


def _exchanger_design(points: Points, panel: Panel, part: Component) -> tuple[Estimate, Array]:
    """Estimate the design by the part's method, and the sensors' biases of each pack by the panel, (packs, 6)."""
    if has_closed_form(part) or not len(points):
        estimate, bias = PanelLeastSquares().estimate(panel)
        return replace(estimate, method=CLOSED_FORM), bias
    fit = PanelLeastSquares().fit(panel)
    return design_by_method(points, panel, fit, part), fit.units


def _mean_gradient(points: Points, design: Array, bias: Array) -> Array:
    """Average the ln conductance ratio's derivative by the design over the points. (p,)"""
    of_point = bias[points.pack].T
    ratio = hx.ln_conductance_ratio(points.signals, design, of_point)
    slopes = hx.design_gradient(points.signals, design, of_point, ratio)
    usable = np.isfinite(slopes).all(axis=1)
    return np.asarray(slopes[usable].mean(axis=0) if usable.any() else np.zeros(len(hx.NAMES)))


def _middle_flows(points: Points, design: Array) -> tuple[float, float]:
    """Compute median hot and ram flow of the points, the reference flows without any. [kg/s]"""
    if not len(points):
        return REFERENCE_HOT_FLOW_KG_S, REFERENCE_RAM_FLOW_KG_S
    ram = clean_ram_flow_kg_s(points.signals, design)
    return float(np.median(points.signals["pack_flow_kg_s"])), float(np.nanmedian(ram))


def exchanger_levels(twin_flights: pl.DataFrame, dsm: Dsm) -> tuple[PooledLevel, ...]:
    """Estimate conductance as built of each operator and pack, pooled with the fleet.

    A pack's own estimate comes from its first flights, corrected for the expected wear at entry.
    """
    packs = first_levels(twin_flights.drop_nulls("ln_ua_ratio").sort(IN_ORDER))
    if not packs.height:
        return ()
    ratio = packs["ln_ua_ratio"].to_numpy()
    error = dsm.flight_sd * median_error(packs["n"].to_numpy())
    posterior = entry_posterior(ratio, error**2, dsm.clean_level, dsm.offset_sd)
    levels = packs.with_columns(
        value=pl.Series(ratio + posterior.wear), error_sd=pl.Series(np.sqrt(error**2 + posterior.wear_var))
    )
    i = hx.NAMES.index("ln_ua_reference")
    ln_ua = dsm.exchanger[i]
    ln_sd = float(np.sqrt(dsm.exchanger_cov[i][i]))
    ln_levels = levels_of(levels, "hx_ua_reference_w_k")[1]
    ua = [float(np.exp(ln_ua + v.value)) for v in ln_levels]
    return tuple(replace(v, value=u, sd=u * float(np.hypot(v.sd, ln_sd))) for v, u in zip(ln_levels, ua, strict=True))


def _methods(parts: Parts) -> tuple[str, ...]:
    """List the parts that are not estimated in closed form, each with its method."""
    return tuple(f"{part.code} {part.estimator}" for part in parts if not has_closed_form(part))


def _inputs(window: pl.DataFrame) -> pl.DataFrame:
    columns = [c for c in (*FLIGHT_PACK, "time_utc", *hx.SIGNALS, "monitored") if c in window.columns]
    return window.select(columns).sort(*FLIGHT_PACK, "time_utc")


def _select_admitted(base: pl.DataFrame, legs: pl.DataFrame) -> pl.DataFrame:
    """Select flights without a leg that is rejected; those without a verdict count."""
    return base.join(legs.filter(~pl.col("admitted")), on=FLIGHT_PACK, how="anti")
