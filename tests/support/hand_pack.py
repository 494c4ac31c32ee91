"""One pack, its model and its laws, written down number by number; and one flight."""

from datetime import timedelta

import numpy as np
import polars as pl
from known_fleet import departure

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.compressor import CompressorFit
from hdt_core.calibration.dsm import Dsm, SensorBiases
from hdt_core.flight.control_schedules import ControlSchedule, ControlSchedules, SpeedLimit

FIT = CompressorFit(
    0.175, 0.001, -2.8e-5, 1e-6, 0.005, 0.004, 0.2, 9.4e-4, 1e-5, 0.74, 0.01, 430.0, 900,
    group_slope_m3_per_count=3.2e-7, group_slope_sd_m3_per_count=1e-8, vda_widest_counts=850.0,
)  # fmt: skip
BIAS = SensorBiases("TST", "T-00", 1, 20, (0.01, 0.5, -0.4, 0.3, 0.01, 0.2), 0.2, 0.002, 0.003)
N_DESIGN = len(hx.NAMES)
DSM = Dsm(
    "hand", tuple(hx.MEAN), ((0.0,) * N_DESIGN,) * N_DESIGN, (0.0,) * N_DESIGN, clean_level=0.05, clean_level_sd=0.01,
    offset_sd=0.02,
    flight_sd=0.01, reference_ua_w_k=2000.0, ram_balance_seen=True, compressor=FIT, packs=(BIAS,), n_flights=20,
    cruise_flows_kg_s=(0.7, 1.0),
)  # fmt: skip
"""A model that knows one pack's sensors, and no law of its hot inlet."""
OUTLET = ControlSchedule((230.0, 250.0, 300.0), {"": (-10.0, -10.0, 20.0)}, {"": 0.0}, {"": 301.0, "T-00/1": 302.0})
LEVELS = {"": np.log(86e3), "T-00/1": np.log(87e3)}
DELIVERY = ControlSchedule((5000.0, 15_000.0), {"": (0.06, -0.04)}, {"": 0.17}, LEVELS)
LAWS = ControlSchedules(OUTLET, DELIVERY, SpeedLimit(4500.0, at_limit=True))
"""Outlet up by .6 K a kelvin from 250 K on, delivery down by 1e-5 a metre from 11 km, .17 of the flow squared."""
ROWS = [
    {
        "operator": "TST", "tail": "T-00", "pack": 1, "flight_id": "T-00_000",
        "time_utc": departure(0) + timedelta(minutes=j),
        "phase": "cruise", "monitored": True, "altitude_m": 11_000.0 + 200.0 * j, "mach": 0.84 - 0.002 * j,
        "tat_k": 248.0 + 2.0 * j, "total_pressure_pa": 31_500.0 - 300.0 * j, "cc_in_k": 249.0 + 2.5 * j,
        "cc_in_pa": 31_000.0 - 350.0 * j, "cc_out_pa": 95_000.0 - 400.0 * j, "cc_out_k": 380.0,
        "cc_speed_rad_s": 4150.0 + 10.0 * j, "cc_flow_kg_s": 0.78, "vda_counts": 400.0 + 20.0 * j,
        "pack_flow_kg_s": 0.76 + 0.01 * j, "hx_in_k": 400.0 + j, "hx_out_k": 300.0 + 1.5 * j,
        "ram_door_open": (0.3, 0.5, 0.951, 0.96, 0.95, 1.0)[j], "ram_out_k": 330.0 + j,
    }
    for j in range(6)
]  # fmt: skip
FLIGHT = pl.DataFrame(ROWS).cast({"pack": pl.Int32, "time_utc": pl.Datetime("us", "UTC")})
"""Six samples of one flight in cruise, the air thinner and hotter from one to the next."""
