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
from types import SimpleNamespace

import numpy as np
import polars as pl

from benchmarks.chain import admit_fleet
from benchmarks.fleets import fleet_of
from benchmarks.harness import DOCS, Texts, markdown, run
from benchmarks.known_design import SIZE, one_fleet
from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.estimation import NonlinearLeastSquares
from hdt_core.physics.compressor import COMPRESSOR
from hdt_core.records.keys import FLIGHT_PACK
from hdt_core.robust import Z_90
from hdt_core.tracking.component import flight_by_flight

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


def speed(tails: int = 50, flights: int = 2000) -> str:
    """Calibration of a large fleet; its estimates of all flights; Figure 10's recursion against the closed form."""
    fleet = fleet_of(1, replace(SIZE, flights=200))
    legs = admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages)
    turns = flights // 200
    samples = replicate_fleet(fleet.samples, ("time_utc",), tails, turns)
    judgements = replicate_fleet(legs, ("departed_at",), tails, turns)
    wall, cpu = time.perf_counter(), time.process_time()
    dsm = calibrate(samples, judgements, fleet.maintenance.clear())
    calibrated = time.perf_counter() - wall, time.process_time() - cpu
    wall, cpu = time.perf_counter(), time.process_time()
    estimate_flights(samples, dsm)
    estimated = time.perf_counter() - wall, time.process_time() - cpu
    n = samples["flight_id"].n_unique()
    whole = f"calibration, {tails} aircraft, {n:,} flights, {samples.height:,} samples"
    timed = ((whole, calibrated), ("health of each of these flights from the model", estimated))
    rows = ([name, f"{wall:.0f}", f"{cpu:.0f}"] for name, (wall, cpu) in timed)
    return markdown([["", "wall [s]", "CPU [s]"], *rows])


def recursion() -> str:
    """Figure 10: warm against cold, and how far the answers are apart."""
    fleet = fleet_of(1, replace(SIZE, tails=1))
    legs = admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages)
    cruise = cruise_samples(fleet.samples.join(legs.filter("admitted"), on=FLIGHT_PACK, how="semi"))
    free, outputs = ("cc_area_diameter_tan_beta_m3", "cc_diameter_vda_intercept"), ("cc_flow_kg_s", "cc_out_pa")
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
    metered, blind = fleets.filter(pl.col("ram_seen") == 1.0), fleets.filter(pl.col("ram_seen") == 0.0)

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
    mae, allowed = 1e3 * fleets["mae"].mean(), 1e3 * np.sqrt(2.0 / np.pi) * fleets["scatter"].mean()  # type: ignore[operator]
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
        (
            "the same, a constant / richer forms [mm]",
            "",
            f"{1e3 * fleets['constant'].mean():.2f} / {1e3 * fleets['richer'].mean():.2f}",
        ),  # type: ignore[operator]
        ("R² of equation (6)", "", f"{fleets['r2'].min():.2f} to {fleets['r2'].max():.2f}"),
        (
            f"slope's 95 % interval covers ({fleets.height} fleets; {2 * fleets.height} airlines)",
            "0.95",
            f"{within(['slope_z'], Z95):.2f}; {within(slopes, Z95):.2f}",
        ),
        ("slope, rms error [%]", "", f"{100 * rms(fleets, 'slope'):.1f}"),
        ("90 % intervals of the joint fit cover: design", "0.88-0.92", f"{within(designs, Z_90):.3f}"),
        ("the same: elasticities", "0.88-0.92", f"{within(['z_elastic_hot', 'z_elastic_cold'], Z_90):.3f}"),
        (
            "ten flights after a replacement, share within 0.05: log / no log",
            "",
            f"{logged:.2f} / {silent:.2f} of {fleets['renewals_silent'].sum():.0f}",
        ),
    ]
    note = (
        f"{fleets.height} fleets, {metered.height} with a ram outlet sensor on some aircraft / {blind.height} without"
    )
    return f"{note} any.\n\n{markdown([('measure', 'goal', 'measured'), *rows])}"


def main(fleets: int = 40, first: int = 101, workers: int = 2, no_speed: bool = False) -> Texts:
    """Fleets of seeds from `first` on."""
    with ProcessPoolExecutor(workers) as pool:
        rows = list(pool.map(one_fleet, range(first, first + fleets)))
    yield "bars", table(pl.DataFrame(rows))
    yield "recursion", recursion()
    if not no_speed:
        yield "speed", speed()


if __name__ == "__main__":
    run(main, PAGE)
