"""The Digital System Model: how the fleet was built, frozen and versioned, and its parameters as a table."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.component_fit import CLOSED_FORM
from hdt_core.calibration.compressor import (
    BLADE_ANGLE_RAD,
    BLADE_ANGLE_SD_RAD,
    HUB_RATIO,
    CompressorFit,
    inlet_geometry,
)
from hdt_core.calibration.diffuser_line import FormFit
from hdt_core.calibration.pooling import PooledLevel
from hdt_core.calibration.sensor_biases import PROBE_BIASES
from hdt_core.components.pack import HX
from hdt_core.estimation.panel import forward_differences
from hdt_core.loading import with_tuples
from hdt_core.physics.heat_exchanger import REFERENCE_HOT_FLOW_KG_S, REFERENCE_RAM_FLOW_KG_S
from hdt_core.physics.installed_exchanger import core_values
from hdt_core.physics.model import Array
from hdt_core.records.keys import PACK
from hdt_core.tables.twin import CalibrationDesign

ROWS_AT_ONCE = 20_000
"""Rows formatted as text at once while hashing."""
_AT_REFERENCE = f"W/K at {REFERENCE_HOT_FLOW_KG_S} kg/s hot, {REFERENCE_RAM_FLOW_KG_S} kg/s ram"


@dataclass(frozen=True, slots=True)
class SensorBiases:
    """Biases of one pack's sensors (`hx.BIASES`, then the compressor's probes), from its baseline flights."""

    operator: str
    tail: str
    pack: int
    n_flights: int
    bias: tuple[float, ...]
    inlet_bias_k: float
    inlet_bias_ln: float
    exit_bias_ln: float


@dataclass(frozen=True, slots=True)
class Dsm:
    """Digital System Model.

    Attributes
    ----------
    exchanger, exchanger_cov
        Design vector in the order of `hx.NAMES` and its covariance.
    exchanger_status : str
        How that estimate ended, a status of `Estimate`.
    exchanger_method : str
        What made it, `Estimate.method`.
    gradient : tuple
        Mean derivative of the ln conductance ratio by design over the baseline: where the model is anchored.
    clean_level, offset_sd : float
        ln conductance ratio of a clean unit: fleet mean, and spread by unit and its sensors.
    flight_sd : float
        Scatter of a flight's ln conductance ratio about the pack's health.
    reference_ua_w_k : float
        Clean conductance at the condition that losses are stated for: a middling cruise of a clean pack.
    cruise_flows_kg_s : tuple
        Hot and ram flow in the middle of the baseline, where the law is known best.
    levels : tuple of PooledLevel
        Conductance of each operator and pack, pooled with the fleet.
    hot_inlet : tuple
        Slopes of the hot inlet's law, in the order of `calibration.inlet_law.TERMS`; empty where it is not known.
    terms : dict
        Coefficient of each physical term that an engineer has accepted (`physics.terms`), by name.
    """

    dsm_version: str
    exchanger: tuple[float, ...]
    exchanger_cov: tuple[tuple[float, ...], ...]
    gradient: tuple[float, ...]
    clean_level: float
    clean_level_sd: float
    offset_sd: float
    flight_sd: float
    reference_ua_w_k: float
    ram_balance_seen: bool
    compressor: CompressorFit
    packs: tuple[SensorBiases, ...]
    n_flights: int
    cruise_flows_kg_s: tuple[float, float] = (REFERENCE_HOT_FLOW_KG_S, REFERENCE_RAM_FLOW_KG_S)
    levels: tuple[PooledLevel, ...] = ()
    hot_inlet: tuple[float, ...] = ()
    terms: dict[str, float] = field(default_factory=dict)
    exchanger_status: str = ""
    exchanger_method: str = HX.estimator

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain numbers, lists and strings, ready for JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "Dsm":
        """Build a model from the result of `to_dict`."""
        values = with_tuples(dict(plain))
        compressor = values["compressor"]
        compressor["forms"] = tuple(FormFit(**f) for f in compressor["forms"])
        compressor["levels"] = tuple(PooledLevel(**v) for v in compressor["levels"])
        values["compressor"] = CompressorFit(**compressor)
        values["packs"] = tuple(SensorBiases(**p) for p in values["packs"])
        values["levels"] = tuple(PooledLevel(**v) for v in values["levels"])
        return cls(**values)

    @property
    def design(self) -> Array:
        """Return the design vector in the order of `hx.NAMES`."""
        return np.array(self.exchanger)

    def pack_table(self) -> pl.DataFrame:
        """Tabulate packs: `PACK`, compressor probe corrections and sensor biases as `bias_<signal>`."""
        columns = (*PACK, *PROBE_BIASES)
        rows = [(*(getattr(p, name) for name in columns), *p.bias) for p in self.packs]
        schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32}
        schema |= dict.fromkeys((*PROBE_BIASES, *(f"bias_{name}" for name in hx.BIASES)), pl.Float64)
        return pl.DataFrame(rows, schema=schema, orient="row")

    def bias_of(self, frame: pl.DataFrame) -> Array:
        """Look up sensor biases of each row's pack, 0 for an unknown pack. (6, n)"""
        columns = [f"bias_{name}" for name in hx.BIASES]
        rows = frame.select(PACK).join(self.pack_table(), on=PACK, how="left", maintain_order="left", validate="m:1")
        return rows.select(pl.col(columns).fill_null(0.0)).to_numpy().T


def version_of(*frames: pl.DataFrame, methods: tuple[str, ...] = ()) -> str:
    """Hash methods, and the values of frames in the order of their rows: twelve hexadecimal digits."""
    digest = hashlib.sha256("|".join(methods).encode())
    for frame in frames:
        digest.update("|".join(frame.columns).encode())
        digest.update(frame.clear().write_csv().encode())
        for rows in frame.iter_slices(ROWS_AT_ONCE):
            digest.update(rows.write_csv(float_precision=9, include_header=False).encode())
    return digest.hexdigest()[:12]


def design_parameters(dsm: Dsm) -> pl.DataFrame:
    """Build the table of design parameters: one row a scope, component and parameter."""
    of_compressor = pooled(dsm.compressor.method)
    parts = [
        (_exchanger_rows(dsm), dsm.exchanger_method),
        (_compressor_rows(dsm), of_compressor),
        (_inlet_rows(dsm), of_compressor),
        (_level_rows(dsm.compressor.levels), of_compressor),
        (_level_rows(dsm.levels), pooled(CLOSED_FORM)),
        (_pack_rows(dsm), CLOSED_FORM),
    ]
    rows = [(*row, dsm.dsm_version, method) for of_part, method in parts for row in of_part]
    return pl.DataFrame(rows, schema=CalibrationDesign.types(), orient="row")


def pooled(method: str) -> str:
    """Name the estimator of a value that was drawn from each pack's own."""
    return f"{method}, pooled"


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
    angle = np.rad2deg(BLADE_ANGLE_RAD)
    angle_sd = np.rad2deg(BLADE_ANGLE_SD_RAD)
    condition = f"given a blade angle of {angle:.0f} ± {angle_sd:.0f} degrees and a hub of {HUB_RATIO:g} eye diameters"
    units = {"cc_inlet_area_m2": "m2", "cc_eye_diameter_m": "m", "cc_blade_angle_rad": "rad"}
    return [
        ("fleet", None, None, None, "CC", n, *inlet[n], f"{u}, {condition}", c.n_flights, False)
        for n, u in units.items()
    ]


def _level_rows(levels: Iterable[PooledLevel]) -> list[tuple[Any, ...]]:
    units = {
        "cc_area_diameter_tan_beta_m3": ("CC", "m3"),
        "cc_efficiency": ("CC", "-"),
        "hx_ua_reference_w_k": ("HX", _AT_REFERENCE),
    }
    return [
        ("operator" if v.tail is None else "tail", v.operator, v.tail, v.pack, units[v.parameter][0], v.parameter,
         v.value, v.sd, units[v.parameter][1], v.n_flights, v.sd < 0.1 * v.value)
        for v in levels
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
    values = flow_elasticities(design, *flows_kg_s)
    step = np.full(design.size, hx.STEP)
    return values, forward_differences(lambda d: flow_elasticities(d, *flows_kg_s), design, values, step)


def _exponential(value: Mapping[str, float], error: Mapping[str, float], name: str) -> tuple[float, float]:
    centre = float(np.exp(value[name]))
    return centre, centre * error[name]
