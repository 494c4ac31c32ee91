"""Predict the exchanger's hot inlet from compressor discharge and the ram air behind the core.

Air on its way from the compressor to this inlet gives part of its heat to the same ram air, downstream of the core. So
the inlet follows the discharge and the ram outlet, by an effectiveness that both flows set. The core's film has
hardly an effect: a departure from this law means an error of the inlet's sensor, the discharge's or the door's (from
which the ram flow is computed), or a ram flow that is not the clean duct's.
"""

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Array
from hdt_core.calibration.sensor_biases import DOOR_FREE
from hdt_core.physics.compressor import exit_temperature_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.robust import huber_slopes

NOMINAL_EFFICIENCY = 0.75
"""Efficiency assumed for a compressor without recorded discharge temperature; its error is a constant of the pack."""
TERMS = ("discharge", "ram_outlet", "ln_ram", "ln_flow", "apart_by_ln_ram", "apart_by_ln_flow")
"""Effectiveness of the exchange, linear in the logarithms of both flows, times the two streams' difference."""
MOST_EFFECTIVE = 0.8
"""Largest credible effectiveness; beyond it a law fitted to noise is clipped."""
HUBER_STEPS = 8
FEWEST = 200
RIDGE = 1e-4


def learn_inlet(cruise: pl.DataFrame, design: Array, bias: Array) -> tuple[float, ...]:
    """Fit slopes of the hot inlet's law by `TERMS`, by Huber regression about each pack's medians; empty with too few
    samples.

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
    x = _terms(cruise, design, bias)
    y = cruise["hx_in_k"].to_numpy().astype(float)
    free = cruise["ram_door_open"].is_between(*DOOR_FREE).fill_null(False).to_numpy()
    usable = np.isfinite(x).all(axis=1) & np.isfinite(y) & free
    if usable.sum() < FEWEST:
        return ()
    columns = pl.concat([cruise.select(PACK), pl.DataFrame(np.column_stack([x, y]))], how="horizontal")
    values = pl.exclude(PACK)
    deviations = columns.filter(pl.Series(usable)).select(values - values.median().over(PACK)).to_numpy()
    x = deviations[:, :-1]
    y = deviations[:, -1]
    scale = np.maximum(x.std(axis=0), 1e-9)
    ridge = RIDGE * len(y) * np.eye(len(scale))
    return tuple(map(float, huber_slopes(x / scale, y, ridge, HUBER_STEPS) / scale))


def inlet_above_law(cruise: pl.DataFrame, slopes: tuple[float, ...], design: Array, bias: Array) -> pl.DataFrame:
    """Compute the hot inlet's residual of each flight and pack, with the pack's own constant: `FLIGHT_PACK`,
    `inlet_apart_k`."""
    if not slopes:
        return cruise.select(FLIGHT_PACK).unique().with_columns(inlet_apart_k=pl.lit(None, pl.Float64))
    excess = cruise["hx_in_k"].to_numpy().astype(float) - _terms(cruise, design, bias) @ np.array(slopes)
    rows = cruise.select(*FLIGHT_PACK, "ram_door_open").with_columns(pl.Series("inlet_apart_k", excess).fill_nan(None))
    rows = rows.filter(pl.col("ram_door_open").is_between(*DOOR_FREE))
    return rows.group_by(FLIGHT_PACK).agg(pl.col("inlet_apart_k").median())


def full_open_inlet_k(
    rows: pl.DataFrame, slopes: tuple[float, ...], design: Array, bias: Array, held_k: Array
) -> Array:
    """Predict the hot inlet with the ram door full open and the outlet at its level. (n,) [K]

    An opening door brings more ram air, which leaves the core cooler and cools what comes from the compressor: a sound
    exchanger, its door half shut, meets hotter air than the same one at the end of its life. As recorded where the law
    or the discharge is not known.

    Parameters
    ----------
    rows : DataFrame
        Samples with `hx.SIGNALS` and the compressor's columns, any phase.
    slopes : tuple
        From `learn_inlet`.
    design, bias : array
        As there.
    held_k : array
        Level that the controller holds the outlet at, without sensor bias, (n,). [K]
    """
    inlet_k = rows["hx_in_k"].to_numpy().astype(float)
    if not slopes:
        return inlet_k
    signals = _signals(rows, bias)
    discharge_k = _discharge_k(rows)
    inlet_bias = bias[hx.BIASES.index("hx_in_k")]
    full = signals | {"ram_door_open": np.ones_like(inlet_k)}
    with np.errstate(all="ignore"):
        ram, full_ram = (clean_ram_flow_kg_s(of, design) for of in (signals, full))
        now = _by_stream(discharge_k, _ram_outlet_k(signals, ram), ram, signals) @ np.array(slopes)
        # linear in the ram outlet, which is itself linear in the inlet
        at_tat, per_k = (_by_stream(discharge_k, signals["tat_k"] + rise_k, full_ram, signals) for rise_k in (0.0, 1.0))
        share = np.clip((per_k - at_tat) @ np.array(slopes), 0.0, MOST_EFFECTIVE)
        above_held = inlet_k - inlet_bias + at_tat @ np.array(slopes) - now - held_k
        full_open_k = above_held / (1.0 - share * (signals["pack_flow_kg_s"] / full_ram)) + held_k + inlet_bias
    return np.where(np.isfinite(full_open_k), full_open_k, inlet_k)


def _signals(rows: pl.DataFrame, bias: Array) -> dict[str, Array]:
    return hx.without_bias({name: rows[name].to_numpy().astype(float) for name in hx.SIGNALS}, bias)


def _terms(cruise: pl.DataFrame, design: Array, bias: Array) -> Array:
    """Compute the regressors in the order of `TERMS`. (n, 6); NaN where a reading is missing"""
    signals = _signals(cruise, bias)
    with np.errstate(all="ignore"):
        ram = clean_ram_flow_kg_s(signals, design)
        return _by_stream(_discharge_k(cruise), _ram_outlet_k(signals, ram), ram, signals)


def _ram_outlet_k(signals: dict[str, Array], ram: Array) -> Array:
    """Compute the ram air behind the core by the heat balance. (n,) [K]"""
    heated_k = signals["pack_flow_kg_s"] / ram * (signals["hx_in_k"] - signals["hx_out_k"])
    return np.asarray(signals["tat_k"] + heated_k)


def _by_stream(discharge_k: Array, ram_outlet_k: Array, ram: Array, signals: dict[str, Array]) -> Array:
    with np.errstate(all="ignore"):
        ln_ram = np.log(ram)
        ln_flow = np.log(signals["pack_flow_kg_s"])
    apart_k = discharge_k - ram_outlet_k
    terms = np.column_stack([discharge_k, ram_outlet_k, ln_ram, ln_flow, apart_k * ln_ram, apart_k * ln_flow])
    return np.where(np.isfinite(terms), terms, np.nan)


def _discharge_k(cruise: pl.DataFrame) -> Array:
    """Return compressor exit temperature as recorded, on flights without any by the pressure ratio. (n,) [K]"""
    inlet_k, inlet_pa, exit_pa = (cruise[c].to_numpy().astype(float) for c in ("tat_k", "cc_in_pa", "cc_out_pa"))
    with np.errstate(all="ignore"):
        by_ratio_k = exit_temperature_k(inlet_k, exit_pa / inlet_pa, np.full(len(inlet_k), NOMINAL_EFFICIENCY))
    is_unrecorded = cruise.select((pl.col("cc_out_k").count() == 0).over(FLIGHT_PACK))[:, 0].to_numpy()
    return np.asarray(np.where(is_unrecorded, by_ratio_k, cruise["cc_out_k"].to_numpy().astype(float)))
