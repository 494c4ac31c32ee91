"""The five methods by name: `python -m benchmarks.methods parts [--seeds N] [--write]`, on the paper's own parts.

Heat exchanger and compressor of simulated packs are calibrated on twelve flights and tracked over the next eighteen by
each method by name, as a declared component is: the design with its declared priors, then every flight's loss, then
the filter of wear. `alone` is the method's own answer, `polished` ends with least squares; `chain` is what the night
does on the same flights, with sensor biases and design of all packs estimated together. Truth is the simulator's.

    python -m benchmarks.methods missing-force [--seeds N] [--write]

On physics that lacks a force: the spring-mass-damper of section 3.2 carries a cubic spring of 6 N/m3 that the model
does not have; the amplitude of the drive sets how much of it the record shows. Truth: damping 0.5 N s/m, stiffness
2 N/m at rest.
"""

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from benchmarks.chain import admit_fleet
from benchmarks.fleets import fleet_of
from benchmarks.harness import Texts, markdown, run
from benchmarks.promise import unpolished
from hdt_benchmark.oscillator_kernels import oscillator_kernels
from hdt_benchmark.spring_mass_damper import DT_S, SIGMA_M, SPRING_MASS_DAMPER, TRUTH, WRONG_GUESS, force_n
from hdt_core.calibration.arrays import complete_air_data, cruise_samples, flights_of
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.component_fit import calibrate_component, flight_by_flight
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.components import Component
from hdt_core.components.pack import CC, HX
from hdt_core.estimation import Estimate, Estimator, estimators
from hdt_core.estimation.compiled import COMPILED
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.problem import Problem
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT_PACK, IN_ORDER, PACK
from hdt_core.robust import Z_90
from hdt_core.simulate.design import FleetSettings
from hdt_core.tracking.component import track_component
from hdt_core.tracking.sisters import design_offset
from hdt_core.tracking.track import track

SIZE = FleetSettings(operators=1, tails=1, flights=30, cpl_share=0.0)
CALIBRATED_ON = 12
KEY = ["tail", "flight_id", "pack"]
LOSS = {"HX": 1.0 - pl.col("apparent_ua_ratio"), "CC": pl.col("cc_eff_loss")}


class Pack(NamedTuple):
    """One part: its declaration, cruise samples, log and true loss by flight."""

    component: Component
    samples: pl.DataFrame
    log: pl.DataFrame
    truth: pl.DataFrame


class Result(NamedTuple):
    """Tracked loss, its error and standard deviation, (flights,); processor seconds a flight."""

    loss: np.ndarray
    error: np.ndarray
    sd: np.ndarray
    seconds: float


class Aircraft(NamedTuple):
    """A simulated aircraft with its legs as admitted."""

    fleet: Any
    legs: pl.DataFrame


def aircraft(seed: int) -> Aircraft:
    """Simulate an aircraft and admit its legs."""
    fleet = fleet_of(seed, SIZE)
    return Aircraft(fleet, admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages))


def packs(plane: Aircraft) -> Iterator[Pack]:
    """Yield the parts of an aircraft whose loss its record shows."""
    fleet, legs = plane
    cruise = cruise_samples(fleet.samples.join(legs.filter("admitted"), on=FLIGHT_PACK, how="semi"))
    for component, samples in ((HX, complete_air_data(cruise)), (CC, cruise)):
        inputs, outputs = ([s.name for s in side] for side in (component.model.inputs, component.model.outputs))
        truth = fleet.truth.select(*KEY, truth=LOSS[component.code])
        for pack, own in samples.drop_nulls(inputs).group_by(PACK, maintain_order=True):
            recorded = [name for name in outputs if own[name].is_not_null().any()]
            if component is HX or "cc_out_k" in recorded:
                log = fleet.maintenance.filter(tail=pack[1], pack=pack[2])
                yield Pack(component, own.drop_nulls(recorded).drop(set(outputs) - set(recorded)), log, truth)


def follow(method: Estimator, pack: Pack) -> Result:
    """Calibrate on the first flights and track the others; compare with the truth."""
    flights = flights_of(pack.samples).select(*FLIGHT_PACK, "departed_at").sort(IN_ORDER)
    first = pack.samples.join(flights.head(CALIBRATED_ON), on=FLIGHT_PACK, how="semi")
    component = pack.component
    started = time.process_time()
    dsm, _ = calibrate_component(component.model, first, method)
    losses = [p.name for p in component.model.free("health")]
    estimates = flight_by_flight(pack.samples, dsm, losses, estimator=method)
    health = track_component(estimates, component, pack.log, design_offset(pack.samples, dsm, component)).health
    seconds = time.process_time() - started
    return _compared(health, pack, seconds / flights.height)


def _compared(health: pl.DataFrame, pack: Pack, seconds: float) -> Result:
    """Compare the pack's filtered loss on the later flights with the truth."""
    later = flights_of(pack.samples).select(*FLIGHT_PACK, "departed_at").sort(IN_ORDER).slice(CALIBRATED_ON)
    rows = health.filter(parameter=pack.component.loss).join(later, on=FLIGHT_PACK, how="semi").sort(IN_ORDER)
    rows = rows.join(pack.truth, on=KEY, validate="1:1", maintain_order="left")
    loss = rows["value"].to_numpy()
    return Result(loss, loss - rows["truth"].to_numpy(), rows["sd"].to_numpy(), seconds)


def chain(plane: Aircraft) -> list[Result]:
    """Calibrate all parts of an aircraft together and track them, as the night does."""
    (fleet, legs), started = plane, time.process_time()
    flights = flights_of(fleet.samples).select("flight_id", "departed_at").unique()
    first = flights.sort("departed_at").head(CALIBRATED_ON)
    samples, admitted = (f.join(first, on="flight_id", how="semi") for f in (fleet.samples, legs))
    dsm = calibrate(samples, admitted, fleet.maintenance)
    estimates = estimate_flights(fleet.samples.join(legs.filter("admitted"), on=FLIGHT_PACK, how="semi"), dsm)
    health = track(estimates, fleet.maintenance, dsm).health
    seconds = (time.process_time() - started) / estimates.height
    return [_compared(health, pack, seconds) for pack in packs(plane)]


def row(component: str, method: str, results: list[Result], optimum: list[Result]) -> list[str]:
    """Format the errors of one method on one part, and its distance from least squares in that one's deviations."""
    loss, error, sd = (np.concatenate(parts) for parts in zip(*(r[:3] for r in results), strict=True))
    best, _error, unit = (np.concatenate(parts) for parts in zip(*(r[:3] for r in optimum), strict=True))
    covered = (np.abs(error) < Z_90 * sd).mean()
    seconds = np.mean([r.seconds for r in results])
    return [component, method, f"{np.abs(error).mean():.4f}", f"{sd.mean():.4f}", f"{covered:.2f}",
            f"{np.abs((loss - best) / unit).max():.3f}", f"{1e3 * seconds:.0f}"]  # fmt: skip


def parts(seeds: int = 4, only: str = "") -> Texts:
    """Both parts of so many aircraft, or `only` HX or CC, by every method and by the chain."""
    fleet = [aircraft(seed) for seed in range(102, 102 + seeds)]
    every = [p for a in fleet for p in packs(a)]
    together = [r for a in fleet for r in chain(a)]
    head = ["part", "method", "error of the loss", "its sd", "coverage of 90 %", "off nls [sd]", "CPU a flight [ms]"]
    lines = [head]
    for component in (c for c in (HX, CC) if only in ("", c.code)):
        own = [k for k, pack in enumerate(every) if pack.component is component]
        optimum = [follow(estimators()["nls"], every[k]) for k in own]
        lines.append(row(component.name, "nls", optimum, optimum))
        for name in METHODS[1:]:
            method = estimators()[name]
            for ending, estimator in ((", alone", unpolished(method)), (", polished", method)):
                if ending == ", polished" or estimator != method:
                    results = [follow(estimator, every[k]) for k in own]
                    lines.append(row(component.name, name + ending * (unpolished(method) != method), results, optimum))
        lines.append(row(component.name, "chain", [together[k] for k in own], optimum))
    note = f"{len(every)} parts of {seeds} aircraft; errors are means over {SIZE.flights - CALIBRATED_ON} flights."
    yield "parts", f"{markdown(lines)}\n\n{note}"


METHODS = ("nls", "pso", "ekf", "ukf", "pinn")
CASES = ((1.5, 6.0), (2.0, 6.0), (1.0, 6.0), (1.0, 0.0))
"""Amplitude of the drive [N], cubic stiffness [N/m3]; the last is the complete physics of the paper."""


def position_m(amplitude: float, cubic_n_m3: float) -> Array:
    """Simulate the position from rest by forward Euler. (1001,) [m]"""
    force = amplitude * force_n()
    x = 0.0
    v = 0.0
    position = np.empty(force.size)
    for i, push in enumerate(force):
        position[i] = x
        x, v = x + DT_S * v, v + DT_S * (push - TRUTH[0] * v - TRUTH[1] * x - cubic_n_m3 * x**3)
    return position


def record_of(amplitude: float, cubic_n_m3: float, seed: int) -> Problem:
    """Build the problem of one noisy record; its model has no cubic force."""
    force = amplitude * force_n()
    noise = SIGMA_M * np.random.default_rng(seed).standard_normal(force_n().size)
    measured = position_m(amplitude, cubic_n_m3) + noise
    mass_kg = SPRING_MASS_DAMPER.nominal["mass_kg"]
    return declared_problem(
        SPRING_MASS_DAMPER,
        ("damping_n_s_m", "stiffness_n_m"),
        {"force_n": force},
        {"measured_m": measured},
        prior=WRONG_GUESS,
        dt_s=DT_S,
        kernels=oscillator_kernels(force, measured, SIGMA_M, DT_S, mass_kg) if COMPILED else None,
    )


def force_row(method: str, amplitude: float, cubic_n_m3: float, seeds: int) -> list[str]:
    """Estimate every record by one method; format mean, deviation, coverage, verdicts."""
    estimator = estimators()[method]
    estimates = [estimator.estimate(record_of(amplitude, cubic_n_m3, seed)) for seed in range(seeds)]
    settled = [e for e in estimates if e.status == "converged"]
    return [
        f"{amplitude:g} N, {cubic_n_m3:g} N/m3",
        method,
        *(_parameter(estimates, i) for i in range(2)),
        *(_errors(settled, i) for i in range(2)),
        f"{len(settled)}",
        f"{sum(e.fit.verdict == 'lack_of_fit' for e in estimates)}",
        f"{sum('x1^3 in the rate of x2' in e.method for e in estimates)}",
    ]


def merge_equal(rows: list[list[str]]) -> list[list[str]]:
    """One row for methods that give the same figures in the same case."""
    methods: dict[tuple[str, ...], list[str]] = {}
    for case, method, *figures in rows:
        methods.setdefault((case, *figures), []).append(method)
    return [[case, ", ".join(names), *figures] for (case, *figures), names in methods.items()]


def _parameter(estimates: list[Estimate], i: int) -> str:
    return f"{np.mean([e.belief.mean[i] for e in estimates]):.3f} ± {np.mean([e.belief.sd[i] for e in estimates]):.3f}"


def _errors(estimates: list[Estimate], i: int) -> str:
    """Format coverage of the 90 % interval, and the largest error in deviations, of estimates that converged."""
    z = np.array([abs(e.belief.mean[i] - TRUTH[i]) / e.belief.sd[i] for e in estimates])
    return f"{(z < Z_90).mean():.2f}, {z.max():.1f}" if z.size else "-"


def missing_force(seeds: int = 20) -> Texts:
    """Return the table."""
    head = ["drive, cubic stiffness", "method", "damping", "stiffness", "damping: coverage, worst [sd]",
            "stiffness: coverage, worst [sd]", "`converged`", "`lack_of_fit`", "force named"]  # fmt: skip
    rows = [force_row(method, *case, seeds) for case in CASES for method in METHODS]
    yield "missing force", markdown([head, *merge_equal(rows)])


if __name__ == "__main__":
    run(parts, missing_force)
