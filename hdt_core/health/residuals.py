"""Residuals of each flight and pack: sensor against digital system model, model against twin, sensor against twin.

The model predicts the unit as built, the twin with the health of this flight. So the first residual holds the fault,
the second the part of it that the health parameters explain, the third the remainder.
"""

from collections.abc import Mapping

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.compressor import compressor_samples
from hdt_core.calibration.dsm import Dsm
from hdt_core.physics.compressor import exit_temperature_k, expected_diameter_m, inlet_flow_kg_s, pressure_ratio
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.physics.model import PhysicsModel
from hdt_core.records.keys import LEG, PACK
from hdt_core.robust import Array
from hdt_core.tables.base import finite
from hdt_core.tables.twin import Residuals

KINDS = ("sensor_minus_dsm", "dsm_minus_twin", "sensor_minus_twin")
SIGNALS = {
    "hx_out_k": ("HX", "K"),
    "ram_out_k": ("HX", "K"),
    "cc_effective_diameter_m": ("CC", "m"),
    "cc_out_pa": ("CC", "Pa"),
    "cc_out_k": ("CC", "K"),
    "cc_flow_kg_s": ("CC", "kg/s"),
}
"""Signals with residuals, and the component and unit of each."""


def residuals(samples: pl.DataFrame, twin_flights: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Compute statistics of every residual over a flight's monitored cruise samples.

    Parameters
    ----------
    samples : DataFrame
        Of the leg filter: signals in SI, `phase`, `monitored`.
    twin_flights : DataFrame
        Of `estimate_flights`: health of each flight from that flight alone.
    dsm : Dsm
        Model in service.

    Returns
    -------
    DataFrame
        Table `residuals`. The model's sensor biases are removed from the sensor's side.
    """
    packs = dsm.pack_table()
    corrections = packs.select(*PACK, "inlet_bias_k", "inlet_bias_ln")
    cruise = compressor_samples(cruise_samples(samples), packs)
    estimates = twin_flights.select(
        *LEG,
        twin_ln_ua="ln_ua_ratio",
        twin_diameter_beyond_m=pl.col("diameter_m") - pl.col("expected_diameter_m"),
        twin_efficiency="efficiency",
        twin_group_m3="group_m3",
    )
    rows = cruise.join(estimates, on=LEG, how="left", maintain_order="left", validate="m:1")
    rows = rows.join(corrections, on=PACK, how="left", maintain_order="left", validate="m:1")
    columns = _exchanger(rows, dsm) | _compressor(rows, dsm)
    return _summarise(rows, columns, SIGNALS)


def component_residuals(
    samples: pl.DataFrame, twin_flights: pl.DataFrame, model: PhysicsModel, component: str
) -> pl.DataFrame:
    """Compute `residuals` of a declared component: every output with a sensor and a record.

    Parameters
    ----------
    samples : DataFrame
        Key and columns named as the model's inputs and outputs; the rows to compare.
    twin_flights : DataFrame
        Key and the health parameters of each flight, as of `flight_by_flight`.
    model : PhysicsModel
        Calibrated: its nominal values are the digital system model.
    component : str
        Code of the component in the tables.
    """
    health = [p.name for p in model.free("health")]
    rows = samples.join(twin_flights.select(*LEG, *health), on=LEG, how="left", maintain_order="left", validate="m:1")
    inputs = {s.name: rows[s.name].to_numpy() for s in model.inputs}
    model_outputs = model.predict({}, inputs)
    twin = model.predict({name: rows[name].cast(pl.Float64).to_numpy() for name in health}, inputs)
    signals = {s.name: (component, s.unit) for s in model.outputs if s.sigma is not None and s.name in rows.columns}
    columns: dict[str, Array] = {}
    for name in signals:
        columns |= _differences(name, rows[name].cast(pl.Float64).to_numpy(), model_outputs[name], twin[name])
    return _summarise(rows, columns, signals)


def _exchanger(rows: pl.DataFrame, dsm: Dsm) -> dict[str, Array]:
    """Return residuals of both outlet temperatures, with the clean duct's ram flow in model and twin alike."""
    signals = {name: rows[name].to_numpy().astype(float) for name in (*hx.SIGNALS, "ram_out_k")}
    clean = hx.without_bias(signals, dsm.bias_of(rows))
    ram = clean_ram_flow_kg_s(clean, dsm.design)
    ln_clean = ln_clean_conductance(clean, ram, dsm.design)
    inputs = clean["pack_flow_kg_s"], ram, clean["hx_in_k"], clean["tat_k"]
    with np.errstate(all="ignore"):
        model = outlets_k(*inputs, np.exp(ln_clean + dsm.clean_level))
        twin = outlets_k(*inputs, np.exp(ln_clean + rows["twin_ln_ua"].to_numpy().astype(float)))
    return _differences("hx_out_k", clean["hx_out_k"], model[0], twin[0]) | _differences(
        "ram_out_k", clean["ram_out_k"], model[1], twin[1]
    )


def _compressor(rows: pl.DataFrame, dsm: Dsm) -> dict[str, Array]:
    """Return residuals of the diameter to equation (6), and of exit and flow by diameter, efficiency and flow group."""
    names = ("cc_in_k", "cc_in_pa", "cc_out_k", "cc_out_pa", "cc_speed_rad_s", "cc_flow_kg_s", "vda_counts")
    s = {c: rows[c].to_numpy().astype(float) for c in (*names, "diameter_m", "inlet_bias_k", "inlet_bias_ln")}
    t = {c: rows[c].to_numpy().astype(float) for c in rows.columns if c.startswith("twin_")}
    fit = dsm.compressor
    inlet_k = s["cc_in_k"] - np.nan_to_num(s["inlet_bias_k"])
    inlet_pa = s["cc_in_pa"] * np.exp(-np.nan_to_num(s["inlet_bias_ln"]))
    model_m = expected_diameter_m(s["vda_counts"], np.array(fit.intercept_m), np.array(fit.slope_m_per_count))
    twin_m = model_m + t["twin_diameter_beyond_m"]
    ratio = s["cc_out_pa"] / inlet_pa
    with np.errstate(all="ignore"):
        exit_pa = [inlet_pa * pressure_ratio(d, inlet_k, s["cc_speed_rad_s"]) for d in (model_m, twin_m)]
        exit_k = [exit_temperature_k(inlet_k, ratio, e) for e in (np.array(fit.efficiency), t["twin_efficiency"])]
        groups = (np.array(fit.group_m3), t["twin_group_m3"])
        flow = [inlet_flow_kg_s(g, inlet_pa, inlet_k, s["cc_speed_rad_s"]) for g in groups]
    return (
        _differences("cc_effective_diameter_m", s["diameter_m"], model_m, twin_m)
        | _differences("cc_out_pa", s["cc_out_pa"], *exit_pa)
        | _differences("cc_out_k", s["cc_out_k"], *exit_k)
        | _differences("cc_flow_kg_s", s["cc_flow_kg_s"], *flow)
    )


def _differences(signal: str, sensor: Array, model: Array, twin: Array) -> dict[str, Array]:
    differences = (sensor - model, model - twin, sensor - twin)
    # all three over the samples with a measurement
    return {
        f"{signal}|{kind}": np.where(np.isfinite(sensor) & np.isfinite(d), d, np.nan)
        for kind, d in zip(KINDS, differences, strict=True)
    }


def _summarise(
    rows: pl.DataFrame, columns: Mapping[str, Array], signals: Mapping[str, tuple[str, str]]
) -> pl.DataFrame:
    """Summarise differences of each row, named `signal|kind`, by flight and pack."""
    wide = finite(rows.select(LEG).with_columns(pl.Series(name, np.asarray(v)) for name, v in columns.items()))
    parts = [_statistics(wide, signal, kind, *signals[signal]) for signal in signals for kind in KINDS]
    return Residuals.conform(finite(pl.concat(parts))).sort(*LEG, "signal", "kind")


def _statistics(wide: pl.DataFrame, signal: str, kind: str, component: str, unit: str) -> pl.DataFrame:
    e = pl.col(f"{signal}|{kind}")
    statistics = (
        wide.filter(e.is_not_null())
        .group_by(LEG)
        .agg(e.mean().alias("mean"), e.std().alias("sd"), (e**2).mean().sqrt().alias("rms"), pl.len().alias("n"))
    )
    labels: Mapping[str, str] = {"component": component, "signal": signal, "kind": kind, "unit": unit}
    return statistics.with_columns(pl.lit(v).alias(k) for k, v in labels.items())
