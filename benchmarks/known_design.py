"""One simulated fleet calibrated and held against the design it was flown with: law, compressor and health."""

from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.chain import admit_fleet
from benchmarks.fleets import fleet_of
from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples, flights_of
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.compressor import compressor_samples, fit_compressor
from hdt_core.calibration.dsm import Dsm, elasticities, flow_elasticities
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.calibration.sensor_biases import probe_corrections
from hdt_core.flight.legs import baseline_flights
from hdt_core.physics.compressor import inlet_flow_kg_s
from hdt_core.physics.installed_exchanger import ln_clean_conductance
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.simulate.design import (
    CLIMB_S,
    FleetSettings,
    PackDesign,
    conditions,
    draw_design,
    draw_operators,
    draw_schedule,
)
from hdt_core.simulate.packs import clean, outlets
from hdt_core.simulate.signals import demand
from hdt_core.tracking.track import track

KEY = ["tail", "flight_id", "pack"]
FLOW_BIAS, FLOW_NOISE = 0.015, 0.02
TRUTH = {"hx_exponent_hot", "hx_exponent_cold", "hx_wall_share", "ram_door_low", "ram_door_high", "ram_recovery"}
SIZE = FleetSettings(operators=2, tails=4, flights=170, cpl_share=0.0)


class Envelope(NamedTuple):
    """A clean mean unit over the envelope of cruises and door positions: noise-free signals, ram flow and UA."""

    signals: dict[str, np.ndarray]
    ram_kg_s: np.ndarray
    ua_w_k: np.ndarray


def envelope_of(seed: int) -> tuple[PackDesign, Envelope]:
    draw, rng = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    design, operators = draw_design(draw), draw_operators(draw, SIZE)
    parts = []
    for operator in operators:
        schedule = draw_schedule(rng, operator, 200)
        now = conditions(rng, schedule, np.arange(200), CLIMB_S + 0.5 * schedule.cruise_s)
        wanted_air, door = demand(rng, design, now), rng.uniform(0.15, 0.75, 200)
        out, ram_out, ram, ua = outlets(design, now, wanted_air, door, clean(now.mach))
        signals = {n: getattr(now, n) for n in ("altitude_m", "mach", "tat_k", "total_pressure_pa")}
        signals |= {"hx_in_k": wanted_air.hot_in_k, "hx_out_k": out, "ram_door_open": door, "ram_out_k": ram_out}
        parts.append((signals | {"pack_flow_kg_s": wanted_air.flow_kg_s}, ram, ua))
    joined = {n: np.concatenate([p[0][n] for p in parts]) for n in parts[0][0]}
    return design, Envelope(joined, np.concatenate([p[1] for p in parts]), np.concatenate([p[2] for p in parts]))


def design_vector(design: PackDesign) -> np.ndarray:
    """Truth in the estimator's coordinates; NaN where its model has no such constant."""
    share = design.hx_hot_share / (1.0 - design.hx_wall_share)
    rest = (design.ram_core_area_m2**-2 + design.ram_exit_area_m2**-2) ** -0.5
    values = {n: getattr(design, n) for n in TRUTH} | {
        "ln_ua_reference": np.log(design.hx_ua_reference_w_k), "hot_share_logit": np.log(share / (1.0 - share)),
        "ln_door_closed": np.log(design.ram_area_closed_m2), "ln_door_open": np.log(design.ram_area_open_m2),
        "ln_rest_area": np.log(rest), "film_temperature_exponent": 0.25,
    }  # fmt: skip
    return np.array([values[n] for n in hx.NAMES])


def law_errors(dsm: Dsm, at: Envelope) -> dict[str, float]:
    """Error of ln UA over the envelope, at the true flows and as used with the duct's map: level, and shape about
    it."""
    level = dsm.clean_level
    here = ln_clean_conductance(at.signals, at.ram_kg_s, dsm.design) + level - np.log(at.ua_w_k)
    used = level - hx.ln_conductance_ratio(at.signals, dsm.design, np.zeros((len(hx.BIASES), 1)))
    errors = {}
    for name, error in (("law", here), ("used", used)):
        errors |= {f"{name}_level": abs(float(error.mean())), f"{name}_shape": float(error.std())}
        errors |= {f"{name}_within": float((np.abs(error - error.mean()) < 0.02).mean())}
    return errors


def naive_shape(samples: pl.DataFrame, legs: pl.DataFrame, maintenance: pl.DataFrame, at: Envelope) -> float:
    """The peer: the same fit with health held at zero and flights compared as they come."""
    step, hx.HEALTH_STEP = hx.HEALTH_STEP, 1e-6
    try:
        dsm = calibrate(samples, legs, maintenance)
    finally:
        hx.HEALTH_STEP = step
    return law_errors(dsm, at)["used_shape"]


def compressor_baseline(samples: pl.DataFrame, legs: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Cruise samples of the admitted baseline flights, and the packs' probe corrections."""
    every = flights_of(samples)
    base = every.filter(pl.col("flight_id").is_in(baseline_flights(every)))
    admitted = base.join(legs.filter("admitted"), on=FLIGHT_PACK, how="semi")
    flying_samples = cruise_samples(samples.join(admitted, on=FLIGHT_PACK, how="semi"), monitored=False)
    return flying_samples, probe_corrections(flying_samples, every.select(PACK).unique().sort(PACK))


def slope_z(samples: pl.DataFrame, legs: pl.DataFrame, design: PackDesign) -> float:
    fit = fit_compressor(compressor_samples(*compressor_baseline(samples, legs)))
    return (fit.slope_m_per_count - design.diameter_slope_m_per_count) / fit.slope_sd_m_per_count


def group_error(cruise: pl.DataFrame, corrections: pl.DataFrame, seed: int) -> float:
    """Relative error of the group where the flow follows equations (2)-(4)."""
    rng = np.random.default_rng([seed, 2])
    group = 7.6e-4 * float(np.exp(0.1 * rng.standard_normal()))
    pack = cruise.select(pl.struct(PACK).rank("dense"))[:, 0].to_numpy().astype(int)
    bias = FLOW_BIAS * rng.standard_normal(pack.max() + 1)
    flow = inlet_flow_kg_s(group, *(cruise[c].to_numpy() for c in ("cc_in_pa", "cc_in_k", "cc_speed_rad_s")))
    metered = flow * (1.0 + bias[pack] + FLOW_NOISE * rng.standard_normal(len(flow)))
    metered_flow = cruise.with_columns(cc_flow_kg_s=pl.Series(metered).fill_nan(None))
    fit = fit_compressor(compressor_samples(metered_flow, corrections))
    return fit.group_m3 / group - 1.0


def renewals(samples: pl.DataFrame, maintenance: pl.DataFrame, truth: pl.DataFrame, dsm: Dsm) -> dict[str, int]:
    """Replacements of worn units, and how many are within 0.05 ten flights later, with the log and without it."""
    alone = estimate_flights(samples, dsm)
    loss = (1.0 - pl.col("apparent_ua_ratio")).alias("loss")
    true = truth.select(*KEY, "index", loss, "hx_unit", "icing", "door_fault", "sensor_fault")
    sound = ~pl.col("icing") & ~pl.col("door_fault") & (pl.col("sensor_fault") == "")
    results = {}
    for name, log in (("logged", maintenance), ("silent", maintenance.clear())):
        fouling = track(alone, log, dsm).health.filter(parameter="hx_fouling")
        health = fouling.join(true, on=KEY).sort("tail", "pack", "index")
        off = (pl.col("value") - pl.col("loss")).abs()
        unit = ["tail", "pack", "hx_unit"]
        since = pl.col("index") - pl.col("index").min().over(unit)
        last = health.group_by(unit).agg(pl.col("loss").last().alias("gone"))
        removed = last.with_columns(hx_unit=pl.col("hx_unit") + 1)
        after = health.with_columns(since.alias("since")).join(removed, on=unit)
        after = after.filter((pl.col("gone") > 0.15) & (pl.col("since") == 10) & sound)
        results[f"renewed_{name}"] = after.select((off < 0.05).sum()).item()
        results[f"renewals_{name}"] = after.height
    return results


def one_fleet(seed: int) -> dict[str, float]:
    """Every measure of one fleet."""
    fleet = fleet_of(seed, SIZE)
    legs = admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages)
    dsm = calibrate(fleet.samples, legs, fleet.maintenance)
    design, at = envelope_of(seed)
    out: dict[str, float] = {"ram_seen": float(dsm.ram_balance_seen)} | law_errors(dsm, at)
    out["naive_shape"] = naive_shape(fleet.samples, legs, fleet.maintenance, at)
    true, sd = design_vector(design), np.sqrt(np.diag(np.array(dsm.exchanger_cov)))
    flows = dsm.cruise_flows_kg_s
    elastic, elastic_sd = elasticities(dsm)
    elastic_off = elastic - flow_elasticities(true, *flows)
    for name, off, spread in zip(hx.NAMES, dsm.design - true, sd, strict=True):
        out |= {f"off_{name}": float(off), f"z_{name}": float(off / spread)}
    for name, off, spread in zip(("hot", "cold"), elastic_off, elastic_sd, strict=True):
        out |= {f"off_elastic_{name}": float(off), f"z_elastic_{name}": float(off / spread)}
    cruise, corrections = compressor_baseline(fleet.samples, legs)
    out["group"] = group_error(cruise, corrections, seed)
    c = dsm.compressor
    out |= {"mae": c.mae_m, "scatter": design.diameter_scatter_m, "r2": c.r_squared, "constant": c.forms[0].cv_mae_m}
    out["richer"] = min(f.cv_mae_m for f in c.forms[2:])
    out["slope_z"] = (c.slope_m_per_count - design.diameter_slope_m_per_count) / c.slope_sd_m_per_count
    out["slope"] = c.slope_m_per_count / design.diameter_slope_m_per_count - 1.0
    for k, part in enumerate(fleet.samples.partition_by("operator")):
        out[f"slope_z_{k}"] = slope_z(part, legs, design)
    return out | renewals(fleet.samples, fleet.maintenance, fleet.truth, dsm)
