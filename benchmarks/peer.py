"""From stored samples to conductance per flight: ours against a pandas and SciPy loop, `python -m benchmarks.peer`.

The peer is what an analyst would write: pandas reads the Parquet, a loop takes each flight and pack, SciPy
finds the conductance of each cruise sample by root search and Huber's location of a flight by minimisation. It uses
the same physics by the same functions, sample by sample, and the same calibrated model, so the answers must agree.
Steady cruise is marked in the samples for both. Needs the extra `benchmark`.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import polars as pl
from scipy.optimize import brentq, minimize_scalar

from benchmarks.harness import Texts, race_table, run
from benchmarks.scale import Silent
from hdt_benchmark.timing import Candidate, Claim, race
from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import SAMPLE_SD, estimate_flights
from hdt_core.physics.effectiveness import crossflow_effectiveness
from hdt_core.physics.heat_exchanger import capacity_rates
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.records.keys import FLIGHT_PACK
from hdt_core.robust import HUBER_K
from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import nightly
from pipelines.storage.store import Store

PEER_FLIGHTS = 100
GOAL = 15.0


def conductance_w_k(flow_kg_s: float, ram_kg_s: float, hot_in_k: float, hot_out_k: float, cold_in_k: float) -> float:
    """UA of one sample, by root search."""
    capacity, ratio = map(float, capacity_rates(flow_kg_s, ram_kg_s, hot_in_k, hot_out_k, cold_in_k))
    effectiveness = (hot_in_k - hot_out_k) / (hot_in_k - cold_in_k)

    def off(ntu: float) -> float:
        return float(crossflow_effectiveness(np.array(ntu), np.array(ntu * ratio))) - effectiveness

    try:
        return capacity * brentq(off, 1e-6, 60.0, xtol=1e-10)
    except ValueError:  # no exchanger shows these temperatures
        return np.nan


def location(values: np.ndarray) -> float:
    """Huber's location about the scale that ours takes, by minimisation."""
    centre = np.median(values)
    count = len(values)
    spread2 = ((1.4826 * np.median(np.abs(values - centre))) ** 2 * count + SAMPLE_SD**2 * 5.0) / (count + 5.0)
    limit = HUBER_K * np.sqrt(spread2)

    def loss(at: float) -> float:
        away = np.abs(values - at)
        return float(np.where(away < limit, 0.5 * away**2, limit * (away - 0.5 * limit)).sum())

    return float(minimize_scalar(loss, bracket=(centre - 0.1, centre + 0.1), tol=1e-9).x)


def by_loop(path: Path, dsm: Dsm) -> np.ndarray:
    """Ln conductance ratio of each flight and pack, in order of `FLIGHT_PACK`."""
    samples = pd.read_parquet(path).dropna(subset=list(hx.SIGNALS))
    packs = dsm.pack_table()
    keys = packs.select("operator", "tail", "pack").rows()
    biases = dsm.bias_of(packs).T[:, :, None]
    bias = dict(zip(keys, biases, strict=True))
    return np.array([_of_flight(own, bias[key[:3]], dsm) for key, own in samples.groupby(FLIGHT_PACK, sort=True)])


def _of_flight(own: pd.DataFrame, bias: np.ndarray, dsm: Dsm) -> float:
    ratios = []
    for row in own.to_dict("records"):
        one = {name: np.array([float(row[name])]) for name in hx.SIGNALS}
        s = hx.without_bias(one, bias)
        ram = clean_ram_flow_kg_s(s, dsm.design)
        ends = (float(s[name][0]) for name in ("hx_in_k", "hx_out_k", "tat_k"))
        measured = conductance_w_k(float(s["pack_flow_kg_s"][0]), float(ram[0]), *ends)
        ratios.append(np.log(measured) - ln_clean_conductance(s, ram, dsm.design)[0])
    values = np.array(ratios)
    values = values[np.isfinite(values)]
    return location(values) if len(values) else np.nan


def main(rounds: int = 5, flights: int = 250) -> Texts:
    """The claim, on so many flights of each aircraft."""
    with TemporaryDirectory() as scratch:
        home = Path(scratch, "home")
        list(write_fleet(Path(scratch), 11, FleetSettings(operators=2, tails=2, flights=flights)))
        nightly.run_night(Path(scratch, "landing"), home, Silent())
        store = Store(home)
        dsm = Dsm.from_dict(json.loads(store.read_table("calibration_dsm")["model"][0]))
        cruise = cruise_samples(store.read_table("legs_samples")).sort(FLIGHT_PACK)
        first = cruise.select(FLIGHT_PACK).unique(maintain_order=True).head(PEER_FLIGHTS)
        some = cruise.join(first, on=FLIGHT_PACK, maintain_order="left")
        whole = Path(scratch, "whole.parquet")
        part = Path(scratch, "part.parquet")
        cruise.write_parquet(whole)
        some.write_parquet(part)
        yield "", race_table([_claim(whole, part, dsm, rounds)], ("numpy", "polars", "pandas", "scipy"))


def _claim(whole: Path, part: Path, dsm: Dsm, rounds: int) -> Claim:
    def ours(path: Path) -> np.ndarray:
        estimates = estimate_flights(pl.read_parquet(path), dsm).sort(FLIGHT_PACK)["ln_ua_ratio"]
        return estimates.to_numpy()

    runs = {
        "ours, Polars and NumPy": Candidate(lambda: ours(whole), _flights(whole)),
        "pandas and SciPy, a loop": Candidate(lambda: by_loop(part, dsm), _flights(part)),
    }
    return race(
        "samples of a flight and pack to its conductance", runs, rounds, goals={"pandas and SciPy, a loop": GOAL}
    )


def _flights(path: Path) -> int:
    return pl.scan_parquet(path).select(FLIGHT_PACK).unique().collect().height


if __name__ == "__main__":
    run(main)
