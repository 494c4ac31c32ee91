"""A small fleet with known truth, made through the physics functions with design values the priors don't expect."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
from twin_flights import NO_LOG

from hdt_core.calibration import exchanger as hx
from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.compressor import effective_diameter_m, exit_temperature_k, inlet_flow_kg_s, pressure_ratio
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance

GROUP_M3 = 9.1e-4
INTERCEPT_M = 0.169
SLOPE_M = -2.4e-5
SCATTER_M = 0.004
EFFICIENCY = 0.76
DESIGN = {
    "ln_ua_reference": np.log(2100.0), "hx_exponent_hot": 0.55, "hx_exponent_cold": 0.62, "hot_share_logit": -0.2,
    "hx_wall_share": 0.08, "film_temperature_exponent": 0.2, "ln_door_closed": np.log(0.0025),
    "ln_door_open": np.log(0.05), "ram_door_low": 0.38, "ram_door_high": 0.6, "ln_rest_area": np.log(0.021),
    "ram_recovery": 0.85,
}  # fmt: skip
SENSOR_SD = {"pack_flow_kg_s": 0.008, "cc_flow_kg_s": 0.008, "hx_in_k": 0.4, "hx_out_k": 0.4, "tat_k": 0.2}


@dataclass(frozen=True)
class Fleet:
    """Samples, legs, maintenance, fleet table, and the truth: fouling and diameter by flight and pack, design."""

    samples: pl.DataFrame
    legs: pl.DataFrame
    maintenance: pl.DataFrame
    aircraft: pl.DataFrame
    truth: pl.DataFrame
    design: np.ndarray

    def only(self, *tails: str) -> "Fleet":
        """Some of the aircraft."""
        names = ("samples", "legs", "maintenance", "aircraft", "truth")
        return replace(self, **{n: getattr(self, n).filter(pl.col("tail").is_in(tails)) for n in names})


def fleet_with_truth(n_tails: int, n_flights: int, *, packs: int = 2, ram_out: bool = True, seed: int = 7) -> Fleet:
    """Aircraft whose left packs foul at different rates and whose right packs stay clean, under a door controller."""
    rng = np.random.default_rng(seed)
    design = np.array([DESIGN[name] for name in hx.NAMES])
    samples = []
    truth = []
    for tail in range(n_tails):
        tat_bias = rng.normal(0.0, 0.4)
        weather = rng.normal(0.0, 6.0, n_flights)
        level = rng.choice([10058.0, 10668.0, 11278.0, 11887.0], n_flights)
        for pack in range(1, packs + 1):
            offset = rng.normal(0.0, 0.03)
            bias = {s: rng.normal(0.0, b) for s, b in (("pack_flow_kg_s", 0.015), ("hx_in_k", 0.6), ("hx_out_k", 0.5))}
            loss = (0.001 * (tail + 1) * np.arange(n_flights)).clip(0.0, 0.4) if pack == 1 else np.zeros(n_flights)
            flown = _flown(rng, design, loss, offset, weather, level)
            for name, value in flown["sensors"].items():
                noise = rng.normal(0.0, SENSOR_SD.get(name, 0.0), value.shape)
                off = bias.get(name, tat_bias if name == "tat_k" else 0.0)
                relative = name in ("pack_flow_kg_s", "cc_flow_kg_s")
                flown["sensors"][name] = value * np.exp(noise + off) if relative else value + noise + off
            if not ram_out:
                flown["sensors"]["ram_out_k"] = np.full_like(flown["sensors"]["tat_k"], np.nan)
            samples.append(_frame(tail, pack, flown["sensors"]))
            ids = [flight_id(tail, k) for k in range(n_flights)]
            truth.append(
                pl.DataFrame(
                    {"flight_id": ids, "loss": loss, "diameter_m": np.median(flown["diameter_m"], axis=1)}
                ).with_columns(tail=pl.lit(f"T-{tail:02d}"), pack=pl.lit(pack, pl.Int32))
            )
    frame = pl.concat(samples)
    keys = ["operator", "tail", "flight_id", "pack"]
    legs = frame.group_by(keys).agg(pl.col("time_utc").min().alias("departed_at")).with_columns(admitted=pl.lit(True))
    aircraft = frame.select("operator", "tail").unique().with_columns(packs=pl.lit(packs))
    return Fleet(frame, legs, NO_LOG, aircraft, pl.concat(truth), design)


def flight_id(tail: int, k: int) -> str:
    return f"T-{tail:02d}_{departure(k):%Y%m%d}_01"


def departure(k: int) -> datetime:
    return datetime(2024, 1, 1, 6, tzinfo=UTC) + timedelta(days=int(k))


def _flown(rng, design, loss, offset, weather, level, n=8):
    """Eight steady cruise samples a flight; the door is found by bisection so that the exit holds its target."""
    shape = (len(loss), n)
    altitude = np.repeat(level[:, None], n, axis=1)
    mach = 0.84 + rng.normal(0.0, 0.003, shape)
    static = standard_pressure_pa(altitude)
    tat = 216.65 * (1.0 + 0.2 * mach**2) + weather[:, None] + rng.normal(0.0, 0.5, shape)
    flow = 0.8 + 0.05 * rng.normal(0.0, 1.0, (len(loss), 1)) + rng.normal(0.0, 0.005, shape)
    s = {
        "altitude_m": altitude, "mach": mach, "tat_k": tat,
        "total_pressure_pa": static * total_to_static_pressure(mach),
        "hx_in_k": 404.0 + 0.5 * weather[:, None] + (altitude - 11000.0) / 100.0, "pack_flow_kg_s": flow,
    }  # fmt: skip
    target = 296.0 + rng.normal(0.0, 1.5, (len(loss), 1))
    low = np.full(shape, 0.02)
    high = np.ones(shape)
    for _ in range(40):
        s["ram_door_open"] = 0.5 * (low + high)
        ram = clean_ram_flow_kg_s(s, design)
        ua = np.exp(ln_clean_conductance(s, ram, design) + offset) * (1.0 - loss[:, None])
        hot, cold = outlets_k(flow, ram, s["hx_in_k"], tat, ua)
        low = np.where(hot > target, s["ram_door_open"], low)
        high = np.where(hot > target, high, s["ram_door_open"])
    s |= {"hx_out_k": hot, "ram_out_k": cold}
    vda = rng.uniform(300.0, 600.0, shape)
    diameter = INTERCEPT_M + SLOPE_M * vda + rng.normal(0.0, SCATTER_M, shape)
    inlet = 0.95 * s["total_pressure_pa"]
    # the speed at which this diameter reaches cabin pressure: head is proportional to its square
    speed = effective_diameter_m(inlet, np.full(shape, 94e3), tat, np.ones(shape)) / diameter
    ratio = pressure_ratio(diameter, tat, speed)
    s |= {
        "cc_in_k": tat, "cc_in_pa": inlet, "cc_speed_rad_s": speed, "cc_out_pa": inlet * ratio, "vda_counts": vda,
        "cc_out_k": exit_temperature_k(tat, ratio, EFFICIENCY), "cc_flow_kg_s": flow,
    }  # fmt: skip
    s["cc_speed_rad_s"] = speed
    return {"sensors": s, "diameter_m": diameter}


def group_flow(samples: pl.DataFrame) -> pl.DataFrame:
    """Samples whose compressor flow follows equations (2)-(4) with the group `GROUP_M3`."""
    columns = (samples[c].to_numpy() for c in ("cc_in_pa", "cc_in_k", "cc_speed_rad_s"))
    return samples.with_columns(cc_flow_kg_s=pl.Series(inlet_flow_kg_s(GROUP_M3, *columns)))


def _frame(tail: int, pack: int, sensors: dict[str, np.ndarray]) -> pl.DataFrame:
    n_flights, n = sensors["tat_k"].shape
    times = [departure(k) + timedelta(minutes=40 + 7 * j) for k in range(n_flights) for j in range(n)]
    ids = [flight_id(tail, k) for k in range(n_flights) for _ in range(n)]
    values = {name: value.reshape(-1) for name, value in sensors.items()}
    return pl.DataFrame({"flight_id": ids, "time_utc": times, **values}).with_columns(
        pl.lit("TST").alias("operator"),
        pl.lit(f"T-{tail:02d}").alias("tail"),
        pl.lit(pack, pl.Int32).alias("pack"),
        pl.lit("cruise").alias("phase"),
        pl.lit(True).alias("monitored"),
        pl.lit(True).alias("nominal"),
        pl.lit(1, pl.Int32).alias("n_averaged"),
        pl.lit("acms").alias("source"),
        pl.col("time_utc").cast(pl.Datetime("us", "UTC")),
        pl.col("ram_out_k").fill_nan(None),
    )
