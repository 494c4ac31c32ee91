"""The exchanger's hot inlet, told by what lies before it: compressor discharge and the ram air that has left the core.

Air on its way from the compressor to this inlet gives part of its heat to the same ram air, downstream of the core. So
the inlet follows the discharge and the ram outlet, by an effectiveness that both flows set. The core's film has hardly
a part in it: what leaves this law is the inlet's sensor, the discharge's, the door's (from which the ram flow is
known), or a ram flow that is not the clean duct's.
"""

import numpy as np
import polars as pl

from hdt_core.physics.compressor import exit_temperature_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.robust import huber_weights, spread
from hdt_core.twin import exchanger as hx
from hdt_core.twin.crossing import Array
from hdt_core.twin.sensors import DOOR_FREE

NOMINAL_EFFICIENCY = 0.75
"""Of a compressor whose discharge temperature is not recorded; what it is off by is the pack's own constant."""
TERMS = ("discharge", "ram_outlet", "ln_ram", "ln_flow", "apart_by_ln_ram", "apart_by_ln_flow")
"""Effectiveness of the way there, linear in the logarithms of both flows, times the two streams' difference."""
HUBER_STEPS = 8
FEWEST = 200
RIDGE = 1e-4


def learn_inlet(cruise: pl.DataFrame, design: Array, bias: Array) -> tuple[float, ...]:
    """Slopes of the hot inlet's law by `TERMS`, by Huber regression about each pack's medians; empty where too few
    samples speak.

    Parameters
    ----------
    cruise : DataFrame
        Of `cruise_samples`.
    design, bias : array
        Of the exchanger and the ram duct, in the order of `hx.NAMES`; sensor biases of each row, (6, n).

    Notes
    -----
    Medians of shorter stretches than a pack's whole baseline would leave so little movement of door and discharge
    that the noise of their sensors bends the slopes towards zero.
    """
    x, y = _terms(cruise, design, bias), cruise["hx_in_k"].to_numpy().astype(float)
    free = cruise["ram_door_open"].is_between(*DOOR_FREE).fill_null(False).to_numpy()
    known = np.isfinite(x).all(axis=1) & np.isfinite(y) & free
    if known.sum() < FEWEST:
        return ()
    columns = pl.concat([cruise.select(PACK), pl.DataFrame(np.column_stack([x, y]))], how="horizontal")
    values = pl.exclude(PACK)
    within = columns.filter(pl.Series(known)).select(values - values.median().over(PACK)).to_numpy()
    return tuple(float(v) for v in _huber(within[:, :-1], within[:, -1]))


def inlet_above_law(cruise: pl.DataFrame, slopes: tuple[float, ...], design: Array, bias: Array) -> pl.DataFrame:
    """By how much the hot inlet of each flight and pack leaves the law, a constant of the pack's own included:
    `FLIGHT_PACK`, `inlet_apart_k`."""
    if not slopes:
        return cruise.select(FLIGHT_PACK).unique().with_columns(inlet_apart_k=pl.lit(None, pl.Float64))
    above = cruise["hx_in_k"].to_numpy().astype(float) - _terms(cruise, design, bias) @ np.array(slopes)
    rows = cruise.select(*FLIGHT_PACK, "ram_door_open").with_columns(pl.Series("inlet_apart_k", above).fill_nan(None))
    rows = rows.filter(pl.col("ram_door_open").is_between(*DOOR_FREE))
    return rows.group_by(FLIGHT_PACK).agg(pl.col("inlet_apart_k").median())


def _terms(cruise: pl.DataFrame, design: Array, bias: Array) -> Array:
    """What the hot inlet follows, in the order of `TERMS`. (n, 6); NaN where a reading is missing"""
    signals = hx.without_bias({name: cruise[name].to_numpy().astype(float) for name in hx.SIGNALS}, bias)
    flow, discharge_k = signals["pack_flow_kg_s"], _discharge_k(cruise)
    with np.errstate(all="ignore"):
        ram = clean_ram_flow_kg_s(signals, design)
        ln_ram, ln_flow = np.log(ram), np.log(flow)
        ram_outlet_k = signals["tat_k"] + flow / ram * (signals["hx_in_k"] - signals["hx_out_k"])
    apart_k = discharge_k - ram_outlet_k
    terms = np.column_stack([discharge_k, ram_outlet_k, ln_ram, ln_flow, apart_k * ln_ram, apart_k * ln_flow])
    return np.where(np.isfinite(terms), terms, np.nan)


def _discharge_k(cruise: pl.DataFrame) -> Array:
    """Compressor exit temperature as recorded; on flights without any, what the pressure ratio asks for. (n,) [K]"""
    inlet_k, inlet_pa, exit_pa = (cruise[c].to_numpy().astype(float) for c in ("tat_k", "cc_in_pa", "cc_out_pa"))
    with np.errstate(all="ignore"):
        told = exit_temperature_k(inlet_k, exit_pa / inlet_pa, np.full(len(inlet_k), NOMINAL_EFFICIENCY))
    silent = cruise.select((pl.col("cc_out_k").count() == 0).over(FLIGHT_PACK))[:, 0].to_numpy()
    return np.asarray(np.where(silent, told, cruise["cc_out_k"].to_numpy().astype(float)))


def _huber(x: Array, y: Array) -> Array:
    """Slopes of y by x, both about their packs' medians; a weak ridge keeps a fleet that never moves a term
    solvable."""
    scale = np.maximum(x.std(axis=0), 1e-9)
    unit, weight, slopes = x / scale, np.ones(len(y)), np.zeros(x.shape[1])
    for _ in range(HUBER_STEPS):
        normal = unit.T @ (weight[:, None] * unit) + RIDGE * len(y) * np.eye(len(scale))
        slopes = np.linalg.solve(normal, unit.T @ (weight * y))
        miss = np.abs(y - unit @ slopes)
        weight = huber_weights(miss, spread(miss))
    return np.asarray(slopes / scale)
