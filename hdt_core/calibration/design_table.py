"""Tabulate the design parameters of the Digital System Model with their uncertainty."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.compressor_fit import BLADE_ANGLE_RAD, BLADE_ANGLE_SD_RAD, HUB_RATIO, inlet_geometry
from hdt_core.calibration.dsm import Dsm
from hdt_core.estimation.panel import forward_differences
from hdt_core.physics.heat_exchanger import REFERENCE_HOT_FLOW_KG_S, REFERENCE_RAM_FLOW_KG_S
from hdt_core.physics.installed_exchanger import core_values
from hdt_core.physics.model import Array
from hdt_core.tables.calibration import CalibrationDesign

_AT_REFERENCE = f"W/K at {REFERENCE_HOT_FLOW_KG_S} kg/s hot, {REFERENCE_RAM_FLOW_KG_S} kg/s ram"


def design_parameters(dsm: Dsm) -> pl.DataFrame:
    """Build the table of design parameters: one row a scope, component and parameter."""
    rows = [*_exchanger_rows(dsm), *_compressor_rows(dsm), *_inlet_rows(dsm)]
    rows += [*_level_rows(dsm), *_pack_rows(dsm)]
    schema = CalibrationDesign.types("dsm_version")
    return pl.DataFrame(rows, schema=schema, orient="row").with_columns(dsm_version=pl.lit(dsm.dsm_version))


def _exchanger_rows(dsm: Dsm) -> list[tuple[Any, ...]]:
    sd = np.sqrt(np.diag(np.array(dsm.exchanger_cov)))
    value = dict(zip(hx.NAMES, dsm.exchanger, strict=True))
    error = dict(zip(hx.NAMES, sd, strict=True))
    prior = dict(zip(hx.NAMES, hx.SD, strict=True))
    reference = float(np.exp(value["ln_ua_reference"] + dsm.clean_level))
    rows: list[tuple[str, float, float, str, str]] = [
        ("hx_ua_reference_w_k", reference, reference * error["ln_ua_reference"], _AT_REFERENCE, "ln_ua_reference"),
        ("ram_area_closed_m2", *_exponential(value, error, "ln_door_closed"), "m2", "ln_door_closed"),
        ("ram_area_open_m2", *_exponential(value, error, "ln_door_open"), "m2", "ln_door_open"),
        ("ram_rest_area_m2", *_exponential(value, error, "ln_rest_area"), "m2", "ln_rest_area"),
    ]
    rows += [(n, value[n], error[n], "-", n) for n in hx.NAMES if not n.startswith("ln_")]
    return [
        ("fleet", None, None, None, "HX", name, v, s, unit, dsm.n_flights, bool(error[key] < 0.5 * prior[key]))
        for name, v, s, unit, key in rows
    ] + _elasticity_rows(dsm)


def elasticities(dsm: Dsm) -> tuple[Array, Array]:
    """Compute d ln UA / d ln flow of the hot and ram side in the middle of the baseline, with standard deviations.

    An exponent enters only as its product with its film's share of the resistance, which cruise data determine.
    """
    values, slopes = _with_slopes(dsm.design, dsm.cruise_flows_kg_s)
    return values, np.sqrt(np.diag(slopes @ np.array(dsm.exchanger_cov) @ slopes.T))


def _elasticity_rows(dsm: Dsm) -> list[tuple[Any, ...]]:
    hot, ram = dsm.cruise_flows_kg_s
    unit = f"- at {hot:.2f} kg/s hot, {ram:.2f} kg/s ram"
    slopes = _with_slopes(hx.MEAN, dsm.cruise_flows_kg_s)[1]
    prior = np.sqrt(np.diag((slopes * hx.SD**2) @ slopes.T))
    estimates = zip(("hx_flow_elasticity_hot", "hx_flow_elasticity_cold"), *elasticities(dsm), prior, strict=True)
    return [
        ("fleet", None, None, None, "HX", name, float(v), float(s), unit, dsm.n_flights, bool(s < 0.5 * p))
        for name, v, s, p in estimates
    ]


def _compressor_rows(dsm: Dsm) -> list[tuple[Any, ...]]:
    c = dsm.compressor
    rows = [
        ("cc_diameter_vda_intercept", c.intercept_m, c.intercept_sd_m, "m"),
        ("cc_diameter_vda_slope", c.slope_m_per_count, c.slope_sd_m_per_count, "m/count"),
        ("cc_diameter_vda_scatter_m", c.scatter_m, None, "m"),
        ("cc_diameter_vda_mae_m", c.mae_m, None, "m"),
        ("cc_diameter_vda_r_squared", c.r_squared, None, "-"),
        ("cc_area_diameter_tan_beta_m3", c.group_m3, c.group_sd_m3, "m3"),
        ("cc_flow_group_m3_per_count", c.group_slope_m3_per_count, c.group_slope_sd_m3_per_count, "m3/count"),
        ("cc_efficiency", c.efficiency, c.efficiency_sd, "-"),
    ]
    return [
        ("fleet", None, None, None, "CC", n, v, s, u, c.n_flights, s is None or s < 0.1 * abs(v)) for n, v, s, u in rows
    ]


def _inlet_rows(dsm: Dsm) -> list[tuple[Any, ...]]:
    """Build rows of inlet area, eye diameter and blade angle with their prior: the group determines none of them."""
    c = dsm.compressor
    inlet = inlet_geometry(c.group_m3, c.group_sd_m3)
    angle, angle_sd = np.rad2deg(BLADE_ANGLE_RAD), np.rad2deg(BLADE_ANGLE_SD_RAD)
    condition = f"given a blade angle of {angle:.0f} ± {angle_sd:.0f} degrees and a hub of {HUB_RATIO:g} eye diameters"
    units = {"cc_inlet_area_m2": "m2", "cc_eye_diameter_m": "m", "cc_blade_angle_rad": "rad"}
    return [
        ("fleet", None, None, None, "CC", n, *inlet[n], f"{u}, {condition}", c.n_flights, False)
        for n, u in units.items()
    ]


def _level_rows(dsm: Dsm) -> list[tuple[Any, ...]]:
    units = {
        "cc_area_diameter_tan_beta_m3": ("CC", "m3"),
        "cc_efficiency": ("CC", "-"),
        "hx_ua_reference_w_k": ("HX", _AT_REFERENCE),
    }
    return [
        ("operator" if v.tail is None else "tail", v.operator, v.tail, v.pack, units[v.parameter][0], v.parameter,
         v.value, v.sd, units[v.parameter][1], v.n_flights, v.sd < 0.1 * v.value)
        for v in (*dsm.compressor.levels, *dsm.levels)
    ]  # fmt: skip


def _pack_rows(dsm: Dsm) -> list[tuple[Any, ...]]:
    return [
        ("tail", p.operator, p.tail, p.pack, "HX", f"bias_{name}", value, sd, unit, p.n_flights, False)
        for p in dsm.packs
        for name, value, sd, unit in zip(hx.BIASES, p.bias, hx.BIAS_SDS, ("-", "K", "K", "K", "-", "K"), strict=True)
    ]


def flow_elasticities(design: Array, hot_flow_kg_s: float, ram_flow_kg_s: float) -> Array:
    """Compute d ln UA / d ln flow of hot and ram side at these flows: exponent times the film's share. (2, ...) [-]"""
    p = core_values(design)
    hot_share = p["hx_hot_share"]
    hot = hot_share * (hot_flow_kg_s / REFERENCE_HOT_FLOW_KG_S) ** -p["hx_exponent_hot"]
    cold = (1.0 - hot_share - p["hx_wall_share"]) * (ram_flow_kg_s / REFERENCE_RAM_FLOW_KG_S) ** -p["hx_exponent_cold"]
    total = hot + p["hx_wall_share"] + cold
    return np.array([p["hx_exponent_hot"] * hot / total, p["hx_exponent_cold"] * cold / total])


def _with_slopes(design: Array, flows_kg_s: tuple[float, float]) -> tuple[Array, Array]:
    """Compute elasticities and their derivatives by the design vector, (2,) and (2, p)."""
    values, step = flow_elasticities(design, *flows_kg_s), np.full(design.size, hx.STEP)
    return values, forward_differences(lambda d: flow_elasticities(d, *flows_kg_s), design, values, step)


def _exponential(value: Mapping[str, float], error: Mapping[str, float], name: str) -> tuple[float, float]:
    centre = float(np.exp(value[name]))
    return centre, centre * error[name]
