"""The paper's comparison on its own parts: `python -m benchmarks.methods [--seeds N]`.

Heat exchanger and compressor of simulated packs are calibrated on twelve flights and tracked over the next eighteen by
each method by name, as a declared component is: the design with its declared priors, then every flight's loss, then
the filter of wear. `alone` is the method's own answer, `polished` ends with least squares. Truth is the simulator's.
"""

import argparse
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.chain import admit_fleet
from benchmarks.harness import markdown
from benchmarks.legs import fleet_of
from benchmarks.promise import unpolished
from hdt_core.calibration.arrays import complete_air_data, cruise_samples, flights_of
from hdt_core.components import Component
from hdt_core.components.compressor import CC
from hdt_core.components.exchanger import HX
from hdt_core.estimation import Estimator, estimators
from hdt_core.records.keys import FLIGHT_PACK, IN_ORDER, PACK
from hdt_core.robust import Z_90
from hdt_core.simulate.design import FleetSettings
from hdt_core.tracking.component import calibrate_component, track_component
from hdt_core.tracking.component_units import design_offset
from hdt_core.tracking.sequential import flight_by_flight

METHODS = ("nls", "pso", "ekf", "ukf", "pinn")
SIZE = FleetSettings(operators=1, tails=1, flights=30, cpl_share=0.0)
CALIBRATED_ON = 12
KEY = ["tail", "flight_id", "pack"]
TRUTH = {"HX": 1.0 - pl.col("apparent_ua_ratio"), "CC": pl.col("cc_eff_loss")}


class Pack(NamedTuple):
    """One part: its declaration, cruise samples, log and true loss by flight."""

    component: Component
    samples: pl.DataFrame
    log: pl.DataFrame
    truth: pl.DataFrame


class Result(NamedTuple):
    """Errors of the tracked loss and their standard deviations, (flights,); processor seconds a flight."""

    error: np.ndarray
    sd: np.ndarray
    seconds: float


def packs(seed: int) -> Iterator[Pack]:
    """Yield the parts of a simulated aircraft whose loss its record shows."""
    fleet = fleet_of(seed, SIZE)
    legs = admit_fleet(fleet.legs, fleet.samples, fleet.maintenance, fleet.messages)
    cruise = cruise_samples(fleet.samples.join(legs.filter("admitted"), on=FLIGHT_PACK, how="semi"))
    for component, samples in ((HX, complete_air_data(cruise)), (CC, cruise)):
        inputs, outputs = ([s.name for s in side] for side in (component.model.inputs, component.model.outputs))
        truth = fleet.truth.select(*KEY, truth=TRUTH[component.code])
        for pack, own in samples.drop_nulls(inputs).group_by(PACK, maintain_order=True):
            recorded = [name for name in outputs if own[name].is_not_null().any()]
            if component is HX or "cc_out_k" in recorded:
                log = fleet.maintenance.filter(tail=pack[1], pack=pack[2])
                yield Pack(component, own.drop_nulls(recorded).drop(set(outputs) - set(recorded)), log, truth)


def follow(method: Estimator, pack: Pack) -> Result:
    """Calibrate on the first flights and track the others; compare with the truth."""
    flights = flights_of(pack.samples).select(*FLIGHT_PACK, "departed_at").sort(IN_ORDER)
    first = pack.samples.join(flights.head(CALIBRATED_ON), on=FLIGHT_PACK, how="semi")
    component, started = pack.component, time.process_time()
    dsm, _ = calibrate_component(component.model, first, method)
    losses = [p.name for p in component.model.free("health")]
    estimates = flight_by_flight(pack.samples, dsm, losses, estimator=method)
    health = track_component(estimates, component, pack.log, design_offset(pack.samples, dsm, component))
    seconds = time.process_time() - started
    later = health.filter(parameter=component.loss).join(flights.slice(CALIBRATED_ON), on=FLIGHT_PACK, how="semi")
    rows = later.drop_nulls("value").join(pack.truth, on=KEY, validate="1:1")
    return Result((rows["value"] - rows["truth"]).to_numpy(), rows["sd"].to_numpy(), seconds / flights.height)


def row(component: str, method: str, ending: str, results: list[Result]) -> list[str]:
    """Format the errors of one method on one part."""
    error, sd = (np.concatenate(parts) for parts in zip(*((r.error, r.sd) for r in results), strict=True))
    covered, seconds = (np.abs(error) < Z_90 * sd).mean(), np.mean([r.seconds for r in results])
    return [component, f"{method}, {ending}", f"{np.abs(error).mean():.4f}", f"{sd.mean():.4f}", f"{covered:.2f}",
            f"{1e3 * seconds:.0f}"]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    options = parser.parse_args()
    parts = [pack for seed in range(102, 102 + options.seeds) for pack in packs(seed)]
    lines = [["part", "method", "error of the loss", "its sd", "coverage of 90 %", "CPU a flight [ms]"]]
    for component in (HX, CC):
        own = [pack for pack in parts if pack.component is component]
        for name in METHODS:
            method = estimators()[name]
            for ending, estimator in (("alone", unpolished(method)), ("polished", method)):
                if ending == "polished" or estimator != method:
                    lines.append(row(component.name, name, ending, [follow(estimator, pack) for pack in own]))
    note = (
        f"{len(parts)} parts of {options.seeds} aircraft; errors are means over {SIZE.flights - CALIBRATED_ON} flights."
    )
    print(f"{markdown(lines)}\n\n{note}")


if __name__ == "__main__":
    main()
