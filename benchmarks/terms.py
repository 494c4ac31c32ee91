"""Does the missing-physics assistant find what is missing, and only that: `python -m benchmarks.terms [seeds ...]`.

Whole nights over simulated fleets, each as it is and with water sprayed at the ram inlet, which the model lacks. Where
a term is proposed it is accepted and the night made again. Printed: what is proposed, the change of the residual from
flight to flight, and the bias and error of the loss against the truth, before and after.
"""

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl

from benchmarks.scale import Silent
from hdt_core.simulate.design import FleetSettings
from hdt_core.twin.crossing import IN_ORDER, PACK
from hdt_core.twin.dsm import Dsm
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import nightly
from pipelines.orchestration.terms import accept, proposals
from pipelines.storage.store import Store

KEY = ["operator", "tail", "flight_id", "pack"]


def scatter(store: Store) -> float:
    """Robust sd of the change of ln conductance from flight to flight: what the model leaves unexplained."""
    flights = store.read("twin_flights").drop_nulls("ln_ua_ratio").sort(IN_ORDER)
    change = flights.select(pl.col("ln_ua_ratio").diff().over(PACK))["ln_ua_ratio"].drop_nulls().to_numpy()
    return float(1.4826 * np.median(np.abs(change)) / np.sqrt(2.0))


def errors(store: Store, truth: Path) -> tuple[float, float]:
    """Bias and mean absolute error of the loss against what an observer sees who takes the duct for clean."""
    told = store.read("twin_health").filter(parameter="hx_fouling").drop_nulls("value")
    both = told.join(pl.read_parquet(truth / "health.parquet"), on=["tail", "flight_id", "pack"])
    off = (both["value"] - (1.0 - both["apparent_ua_ratio"])).to_numpy()
    return float(off.mean()), float(np.abs(off).mean())


def fleet(seed: int, missing: dict[str, float]) -> None:
    """One fleet: night, proposal, and the night again where a term was accepted."""
    with TemporaryDirectory() as scratch:
        folder, home = Path(scratch), Path(scratch, "home")
        list(write_fleet(folder, seed, FleetSettings(operators=2, tails=3, flights=200, missing=missing)))
        store = Store(home)
        for _ in range(2):
            nightly.run_night(folder / "landing", home, Silent())
            dsm = Dsm.from_dict(json.loads(store.read("calibration_dsm")["model"][0]))
            bias, error = errors(store, folder / "truth")
            print(f"seed {seed}, missing {missing}: has {dsm.terms}, scatter {scatter(store):.4f}, ", end="")
            print(f"loss off by {bias:+.4f}, {error:.4f} absolute", flush=True)
            found = proposals(home, dsm).filter("proposed")
            print("  proposed:", found.select("term", "value", "sd", "bic_gain", "held_out_change").rows(), flush=True)
            if not found.height:
                break
            accept(home, found["term"].to_list())


if __name__ == "__main__":
    for number in map(int, sys.argv[1:] or ["1", "2", "3"]):
        for missing in ({}, {"water_spray": 0.2}):
            fleet(number, missing)
