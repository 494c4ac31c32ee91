"""Calibration against known truth: `python -m benchmarks.calibration [--fleets N] [--workers N] [--write]`.

Claims: the conductance law within 2 % over the envelope; flow exponents within 0.03; the compressor's group within
0.5 %; the effective diameter as well as its scatter allows; a 95 % interval of equation (6)'s slope that covers; 90 %
intervals of the joint fit that cover; a replacement found without the log; 50 aircraft of 2,000 flights in a minute.

Fleets are simulated (`hdt_core.simulate`), each with constants, climate, recorders and faults of its own: two airlines
of four aircraft, 170 flights each. The peer is one least-squares fit of the same law to the same points with all
health taken as zero, which is what a calibration does that does not estimate both together.
"""

import textwrap
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.chain import admit_fleet
from benchmarks.fleets import fleet_of
from benchmarks.harness import DOCS, Texts, markdown, run
from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples, flights_of
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.component_fit import flight_by_flight
from hdt_core.calibration.compressor import compressor_samples, fit_compressor
from hdt_core.calibration.dsm import Dsm, elasticities, flow_elasticities
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.calibration.sensor_biases import probe_corrections
from hdt_core.estimation import NonlinearLeastSquares
from hdt_core.flight.legs import baseline_flights
from hdt_core.physics.compressor import COMPRESSOR, inlet_flow_kg_s
from hdt_core.physics.installed_exchanger import ln_clean_conductance
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.robust import Z_90
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
    draw = np.random.default_rng(seed)
    rng = np.random.default_rng([seed, 1])
    design = draw_design(draw)
    operators = draw_operators(draw, SIZE)
    parts = []
    for operator in operators:
        schedule = draw_schedule(rng, operator, 200)
        now = conditions(rng, schedule, np.arange(200), CLIMB_S + 0.5 * schedule.cruise_s)
        wanted_air = demand(rng, design, now)
        door = rng.uniform(0.15, 0.75, 200)
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
    step = hx.HEALTH_STEP
    hx.HEALTH_STEP = 1e-6
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


def one_fleet(seed: int, size: FleetSettings) -> dict[str, float]:
    """Every measure of one fleet."""
    fleet = fleet_of(seed, size)
    legs = admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages)
    dsm = calibrate(fleet.samples, legs, fleet.maintenance)
    design, at = envelope_of(seed)
    out: dict[str, float] = {"ram_seen": float(dsm.ram_balance_seen)} | law_errors(dsm, at)
    out["naive_shape"] = naive_shape(fleet.samples, legs, fleet.maintenance, at)
    true = design_vector(design)
    sd = np.sqrt(np.diag(np.array(dsm.exchanger_cov)))
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


PAGE = DOCS / "calibration.md"
Z95 = 1.960


def replicate_fleet(frame: pl.DataFrame, times: tuple[str, ...], tails: int, turns: int) -> pl.DataFrame:
    """Replicate flights `turns` times in time and over `tails` aircraft."""
    copies = pl.concat(
        frame.with_columns(
            flight_id=pl.col("flight_id") + f"_{k:02d}", **{t: pl.col(t) + pl.duration(days=200 * k) for t in times}
        )
        for k in range(turns)
    )
    names = frame["tail"].unique().sort().to_list()
    whole = [names[j % len(names)] for j in range(tails)]
    return pl.concat(
        copies.filter(pl.col("tail") == n).with_columns((f"{j}-" + pl.col(c)).alias(c) for c in ("tail", "flight_id"))
        for j, n in enumerate(whole)
    )


def speed(size: FleetSettings, tails: int, flights: int = 2000) -> str:
    """Calibration of a fleet of so many aircraft, and the health of all its flights."""
    fleet = fleet_of(1, replace(size, flights=200))
    legs = admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages)
    turns = flights // 200
    samples = replicate_fleet(fleet.samples, ("time_utc",), tails, turns)
    judgements = replicate_fleet(legs, ("departed_at",), tails, turns)
    wall = time.perf_counter()
    cpu = time.process_time()
    dsm = calibrate(samples, judgements, fleet.maintenance.clear())
    calibrated = time.perf_counter() - wall, time.process_time() - cpu
    wall = time.perf_counter()
    cpu = time.process_time()
    estimate_flights(samples, dsm)
    estimated = time.perf_counter() - wall, time.process_time() - cpu
    n = samples["flight_id"].n_unique()
    whole = f"calibration, {tails} aircraft, {n:,} flights, {samples.height:,} samples"
    timed = ((whole, calibrated), ("health of each of these flights from the model", estimated))
    rows = ([name, f"{wall:.0f}", f"{cpu:.0f}"] for name, (wall, cpu) in timed)
    return markdown([["", "wall [s]", "CPU [s]"], *rows])


def recursion(size: FleetSettings) -> str:
    """Figure 10: warm against cold, and how far the answers are apart."""
    fleet = fleet_of(1, replace(size, tails=1))
    legs = admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages)
    cruise = cruise_samples(fleet.samples.join(legs.filter("admitted"), on=FLIGHT_PACK, how="semi"))
    free = ("cc_area_diameter_tan_beta_m3", "cc_diameter_vda_intercept")
    outputs = ("cc_flow_kg_s", "cc_out_pa")
    one_by_one = SimpleNamespace(name="nls", estimate=NonlinearLeastSquares().estimate)
    warm, cold = (flight_by_flight(cruise, COMPRESSOR, free, outputs=outputs, estimator=e) for e in (one_by_one, None))
    apart = max(float((warm[c] / cold[c] - 1.0).abs().max()) for c in free)
    summary = (
        f"Figure 10 taken literally, {warm.height} flights and packs: {warm['n_evals'].mean():.1f} model evaluations a "
        f"flight from the flight before, {cold['n_evals'].mean():.1f} from the middle of the bounds; both end within "
        f"{apart:.0e} of each other."
    )
    return textwrap.fill(summary, 118)


def table(fleets: pl.DataFrame) -> str:
    """Return the table of measures, goals and results."""
    metered = fleets.filter(pl.col("ram_seen") == 1.0)
    blind = fleets.filter(pl.col("ram_seen") == 0.0)

    def rms(frame: pl.DataFrame, column: str) -> float:
        return float(np.sqrt((frame[column].to_numpy() ** 2).mean())) if frame.height else np.nan

    def within(columns: list[str], limit: float, frame: pl.DataFrame = fleets) -> float:
        return float((np.abs(frame.select(columns).to_numpy()) < limit).mean())

    def both(column: str, scale: float = 100.0) -> str:
        return " / ".join(f"{scale * np.mean(f[column].to_numpy()):.2f}" if f.height else "-" for f in (metered, blind))

    def rms_both(column: str) -> str:
        return f"{rms(metered, column):.3f} / {rms(blind, column):.3f}"

    slopes = [c for c in fleets.columns if c.startswith("slope_z_")]
    designs = [f"z_{n}" for n in hx.NAMES]
    silent, logged = (
        fleets[f"renewed_{n}"].sum() / max(fleets[f"renewals_{n}"].sum(), 1) for n in ("silent", "logged")
    )
    renewed = f"{logged:.2f} / {silent:.2f} of {fleets['renewals_silent'].sum():.0f}"
    mae, scatter, constant, richer = (1e3 * fleets[c].mean() for c in ("mae", "scatter", "constant", "richer"))
    allowed = np.sqrt(2.0 / np.pi) * scatter
    slopes_of = f"({fleets.height} fleets; {2 * fleets.height} airlines)"
    covered = f"{within(['slope_z'], Z95):.2f}; {within(slopes, Z95):.2f}"
    rows = [
        ("conductance law at the true flows, shape over the envelope, sd [%]", "2", both("law_shape")),
        ("the same, share of the envelope within 2 %", "1", both("law_within", 1.0)),
        ("the same, level [%]", "2", both("law_level")),
        ("law with the duct's map as the twin uses it, shape, sd [%]", "2", both("used_shape")),
        ("the same, level [%]", "2", both("used_level")),
        ("the same, shape, health held at zero (peer) [%]", "", both("naive_shape")),
        ("flow exponent hot, rms error", "0.03", rms_both("off_hx_exponent_hot")),
        ("flow exponent cold, rms error", "0.03", rms_both("off_hx_exponent_cold")),
        ("flow elasticity hot (exponent times share), rms error", "0.03", rms_both("off_elastic_hot")),
        ("flow elasticity cold, rms error", "0.03", rms_both("off_elastic_cold")),
        ("compressor group, rms error [%]", "0.5", f"{100 * rms(fleets, 'group'):.2f}"),
        ("compressor group, fleets within 0.5 %", "", f"{within(['group'], 0.005):.2f}"),
        ("equation (6), error on flights left out [mm]", f"{allowed:.2f} (scatter), 5.5 (paper)", f"{mae:.2f}"),
        ("the same, a constant / richer forms [mm]", "", f"{constant:.2f} / {richer:.2f}"),
        ("R² of equation (6)", "", f"{fleets['r2'].min():.2f} to {fleets['r2'].max():.2f}"),
        (f"slope's 95 % interval covers {slopes_of}", "0.95", covered),
        ("slope, rms error [%]", "", f"{100 * rms(fleets, 'slope'):.1f}"),
        ("90 % intervals of the joint fit cover: design", "0.88-0.92", f"{within(designs, Z_90):.3f}"),
        ("the same: elasticities", "0.88-0.92", f"{within(['z_elastic_hot', 'z_elastic_cold'], Z_90):.3f}"),
        ("ten flights after a replacement, share within 0.05: log / no log", "", renewed),
    ]
    note = (
        f"{fleets.height} fleets, {metered.height} with a ram outlet sensor on some aircraft / {blind.height} without"
    )
    return f"{note} any.\n\n{markdown([('measure', 'goal', 'measured'), *rows])}"


def main(
    fleets: int = 40,
    first: int = 101,
    workers: int = 2,
    tails: int = SIZE.tails,
    flights: int = SIZE.flights,
    large: int = 50,
) -> Texts:
    """Fleets of seeds from `first` on; aircraft of an operator and their flights; aircraft of the one that is timed."""
    size = replace(SIZE, tails=tails, flights=flights)
    measure = partial(one_fleet, size=size)
    with ProcessPoolExecutor(workers) as pool:
        rows = list(pool.map(measure, range(first, first + fleets)))
    yield "bars", table(pl.DataFrame(rows))
    yield "recursion", recursion(size)
    yield "speed", speed(size, large)


if __name__ == "__main__":
    run(main, page=PAGE)
