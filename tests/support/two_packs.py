"""A two-pack aircraft simple enough to know what its witnesses must say."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure

PHASES = ["climb"] * 8 + ["cruise"] * 14 + ["descent"] * 8
ALTITUDE_M = np.concatenate([np.linspace(800, 10000, 8), np.full(14, 10600.0), np.linspace(9800, 900, 8)])
MACH = np.concatenate([np.linspace(0.35, 0.8, 8), np.full(14, 0.835), np.linspace(0.78, 0.35, 8)])
START = datetime(2024, 3, 1, 6, tzinfo=UTC)


def flight_id(tail: str, flight: int) -> str:
    return f"{tail}_{START + timedelta(days=flight // 4):%Y%m%d}_{flight % 4 + 1:02d}"


def _pack(rng: np.random.Generator, tail: str, flight: int, pack: int, day_k: float, trim_k: float) -> dict[str, Any]:
    n = len(PHASES)
    tat = 292.0 + day_k - 0.0043 * ALTITUDE_M
    target = 296.0 + 0.6 * np.maximum(tat - 252.0, 0.0) + trim_k
    total = standard_pressure_pa(ALTITUDE_M) * total_to_static_pressure(MACH)
    door = 0.12 + 0.012 * np.maximum(ALTITUDE_M / 1000.0 - 2.0, 0.0) * (1.0 + 0.05 * day_k / 5.0)
    flow = 0.80 + 0.02 * rng.standard_normal()
    start = START + timedelta(days=flight // 4, hours=5 * (flight % 4))
    return {
        "operator": ["TST"] * n,
        "tail": [tail] * n,
        "flight_id": [flight_id(tail, flight)] * n,
        "pack": [pack] * n,
        "time_utc": [start + timedelta(minutes=5 * i) for i in range(n)],
        "source": ["acms"] * n,
        "phase": PHASES,
        "altitude_m": ALTITUDE_M,
        "mach": MACH,
        "tat_k": tat,
        "total_pressure_pa": total,
        "hx_in_k": 400.0 + 0.5 * rng.standard_normal(n),
        "hx_out_k": target + 0.4 * rng.standard_normal(n) + (0.8 if pack == 1 else -0.5),
        "ram_door_open": door + 0.005 * rng.standard_normal(n),
        "pack_flow_kg_s": flow * (1.0 + 0.01 * rng.standard_normal(n)),
        "ram_out_k": [None] * n,
        "cc_speed_rad_s": 3400.0 * (1.0 + 0.02 * rng.standard_normal(n)),
        "cc_in_k": tat + 0.4 + 0.4 * rng.standard_normal(n),
        "cc_in_pa": 0.95 * total * (1.0 + 0.003 * rng.standard_normal(n)),
        "cc_out_k": 360.0 + 0.5 * rng.standard_normal(n),
        "cc_out_pa": 93000.0 * (1.0 + 0.004 * rng.standard_normal(n)),
        "cc_flow_kg_s": flow * 1.04 * (1.0 + 0.015 * rng.standard_normal(n)),
        "vda_counts": 400.0 + 50.0 * rng.standard_normal(n),
    }


def fly_two_packs(flights: int, seed: int = 0, tail: str = "T-AAA") -> pl.DataFrame:
    """Samples of `flights` flights of one aircraft, both packs, sound sensors and doors, no wear."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(flights):
        day_k = 5.0 * rng.standard_normal()
        trim_k = 1.5 * rng.standard_normal()
        parts += [pl.DataFrame(_pack(rng, tail, k, p, day_k, trim_k), strict=False) for p in (1, 2)]
    typed = {"pack": pl.Int32, "time_utc": pl.Datetime("us", "UTC"), "ram_out_k": pl.Float64}
    return pl.concat(parts, how="vertical_relaxed").cast(typed)
