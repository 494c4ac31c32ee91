"""Truth of each flight and pack, against which estimates are scored."""

from datetime import timedelta

import numpy as np
import polars as pl

from hdt_core.robust import Array
from hdt_core.simulate.flight_conditions import Conditions
from hdt_core.simulate.packs import loss_ratios
from hdt_core.simulate.signals import Plan
from hdt_core.simulate.unit_histories import PackHistory

UTC_US = pl.Datetime("us", "UTC")


def health_truth(
    plan: Plan, now: Conditions, true: dict[str, Array], *, history: PackHistory, pack: int, has_arrived: Array
) -> pl.DataFrame:
    """Return the truth of one pack, one row a flight.

    `ua_ratio`, `apparent_ua_ratio`, `ram_flow_ratio` at the reference cruise; the rest are medians of the cruise.
    `nominal`: level cruise, loss below 8 %, nothing wrong. `contaminant`: loss above 15 % or something wrong.
    """
    flights = has_arrived.size
    ratio, apparent, ram = loss_ratios(plan.design, history.wear)
    loss = 1.0 - np.minimum(ratio, apparent)
    door_fault = ~np.isnan(history.door_stuck) | (history.door_reach < 1.0)
    wrong = history.icing | history.pack_off | door_fault | (history.sensor != "")
    departed_at = [plan.start + timedelta(seconds=float(s)) for s in plan.schedule.departed_s]
    return pl.DataFrame(
        {
            "operator": plan.operator.name,
            "tail": plan.tail,
            "flight_id": plan.ids,
            "pack": pack,
            "index": np.arange(flights),
            "departed_at": departed_at,
            "arrived": has_arrived,
            "arrives_on": [d.date() for d in departed_at],
            "ua_ratio": ratio,
            "apparent_ua_ratio": apparent,
            "ram_flow_ratio": ram,
            "blockage": history.blockage,
            "area_loss": history.area_loss,
            "film_k_w": history.film_k_w,
            "true_ua_w_k": _cruise_median(now, true["ua_w_k"], flights),
            "ram_flow_kg_s": _cruise_median(now, true["ram_flow_kg_s"], flights),
            "door_true_pct": 100.0 * _cruise_median(now, true["door"], flights),
            "unmet_k": _cruise_median(now, true["unmet_k"], flights),
            "cc_eff_diameter_m": _cruise_median(now, true["diameter_m"], flights),
            "cc_eff_loss": history.cc_loss,
            "icing": history.icing,
            "pack_off": history.pack_off,
            "door_fault": door_fault,
            "sensor_fault": history.sensor,
            "nominal": ~wrong & (loss < 0.08),
            "contaminant": wrong | (loss > 0.15),
            "hx_unit": history.hx_unit,
            "cc_unit": history.cc_unit,
        },
        schema_overrides={"departed_at": UTC_US, "pack": pl.Int64, "index": pl.Int64},
    )


def _cruise_median(now: Conditions, values: Array, flights: int) -> Array:
    rows = pl.DataFrame({"flight": now.flight[now.cruise], "v": values[now.cruise]})
    medians = rows.group_by("flight").agg(pl.col("v").median()).sort("flight")
    out = np.full(flights, np.nan)
    out[medians["flight"].to_numpy()] = medians["v"].to_numpy()
    return out
