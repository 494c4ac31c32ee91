"""The paper's coefficients H_h and H_c of equations (7) and (8), on the flights that identify them."""

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.exchanger import BIAS_SD
from hdt_core.physics.heat_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K
from hdt_core.tracking.flight_panel import health_rows

ACROSS_SD_K = float(np.hypot(BIAS_SD["hx_out_k"], BIAS_SD["ram_out_k"]))
"""Of the difference of the outlet temperatures: calibration of both sensors, which a flight can't average out."""
MOST_RELATIVE_SD = 0.25
RAM_FLOW_SD = 0.08
"""Of the ram flow by the clean duct's map, as a fraction."""


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
