"""Sensitivity and specificity of the missing-physics assistant: `python -m benchmarks.terms [--seeds N ...]`.

Whole nights over simulated fleets, each as it is and with water sprayed at the ram inlet, which the model lacks. Where
a term is proposed it is accepted and the night made again. Printed: what is proposed; the residual from flight to
flight, on the flights after the commissioning window, which no calibration sees; and the bias and error of the loss
against the truth, before and after. The fleet as it is shows what no model can do away with: sensors, weather, wear.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.harness import Texts, run
from benchmarks.scale import Silent
from hdt_core.calibration.dsm import Dsm
from hdt_core.records.keys import IN_ORDER, PACK
from hdt_core.robust import spread
from hdt_core.simulate.design import FleetSettings
from pipelines.cli.look import propose_terms
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import nightly
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import accept_terms
from pipelines.storage.store import Store
from pipelines.versions import baseline_cells


class Outcome(NamedTuple):
    """Of a night: residual of flights held out, bias and mean absolute error of the loss."""

    residual: float
    bias: float
    error: float


def residual(home: Path) -> float:
    """Robust sd of the change of ln conductance from flight to flight, of flights after the commissioning window."""
    window = baseline_cells(Ledger(home))["flight_id"].unique()
    flights = Store(home).read_table("twin_flights").drop_nulls("ln_ua_ratio").sort(IN_ORDER)
    held_out = flights.filter(~pl.col("flight_id").is_in(window.implode()))
    change = held_out.select(pl.col("ln_ua_ratio").diff().over(PACK))["ln_ua_ratio"].drop_nulls().to_numpy()
    return spread(change) / 2.0**0.5


def errors(store: Store, truth: Path) -> tuple[float, float]:
    """Bias and mean absolute error of the loss against what an observer sees who takes the duct for clean."""
    health = store.read_table("twin_health").filter(parameter="hx_fouling").drop_nulls("value")
    both = health.join(pl.read_parquet(truth / "health.parquet"), on=["tail", "flight_id", "pack"])
    off = (both["value"] - (1.0 - both["apparent_ua_ratio"])).to_numpy()
    return float(off.mean()), float(np.abs(off).mean())


def night(folder: Path) -> tuple[Outcome, pl.DataFrame]:
    """Run a night; return its outcome and the proposed terms."""
    home = folder / "home"
    nightly.run_night(folder / "landing", home, Silent())
    store = Store(home)
    dsm = Dsm.from_dict(json.loads(store.read_table("calibration_dsm")["model"][0]))
    now = Outcome(residual(home), *errors(store, folder / "truth"))
    terms_proposed = propose_terms(home, dsm).filter("proposed")
    terms = {name: round(value, 3) for name, value in dsm.terms.items()}
    print(f"  has {terms}: residual {now.residual:.4f}, loss off by {now.bias:+.4f}, {now.error:.4f} absolute")
    print("  proposed:", terms_proposed.select("term", "value", "sd", "bic_gain", "held_out_change").rows(), flush=True)
    return now, terms_proposed


def fleet(seed: int, missing: dict[str, float]) -> list[Outcome]:
    """One fleet: night, proposal, and the night again where a term was accepted."""
    print(f"seed {seed}, missing {missing}")
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        list(write_fleet(folder, seed, FleetSettings(operators=2, tails=3, flights=200, missing=missing)))
        outcome, terms_proposed = night(folder)
        if not terms_proposed.height:
            return [outcome]
        accept_terms(folder / "home", terms_proposed["term"].to_list())
        return [outcome, night(folder)[0]]


def compare(seed: int) -> str:
    """Compare a fleet as it is with one that has a term the model lacks."""
    floor, lacking = fleet(seed, {})[0], fleet(seed, {"water_spray": 0.2})
    before, after = lacking[0], lacking[-1]
    left = max(after.residual**2 - floor.residual**2, 0.0)
    explained = 1.0 - np.sqrt(left / (before.residual**2 - floor.residual**2))
    return (
        f"seed {seed}: residual held out {after.residual / before.residual - 1.0:+.0%} ({before.residual:.4f} to "
        f"{after.residual:.4f}, {floor.residual:.4f} where nothing is missing: {explained:.0%} of it explained); "
        f"bias of the loss {before.bias:+.4f} to {after.bias:+.4f} ({floor.bias:+.4f} where nothing is missing), "
        f"error {before.error:.4f} to {after.error:.4f} ({floor.error:.4f})"
    )


def main(seeds: tuple[int, ...] = (1, 2, 3)) -> Texts:
    """Fleets of these seeds."""
    for seed in seeds:
        yield "", compare(seed)


if __name__ == "__main__":
    run(main)
