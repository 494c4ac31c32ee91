"""Sensitivity and specificity of the missing-physics assistant: `python -m benchmarks.terms [--seeds N ...] [--write]`.

Whole nights over simulated fleets, each as it is and with water sprayed at the ram inlet, which the model lacks. Where
a term is proposed it is accepted and the night made again. The table: what is proposed; the residual from flight to
flight, on the flights after the commissioning window, which no calibration sees; and the bias and error of the loss
against the truth, before and after. The fleet as it is shows what no model can do away with: sensors, weather, wear.
`--write` puts the table into docs/theory.md.
"""

import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.harness import DOCS, Texts, markdown, run
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

SPRAY = 0.2
"""Share of what saturating the ram air with water would cool it. [-]"""


class Outcome(NamedTuple):
    """Of a night: residual of flights held out, bias and mean absolute error of the loss, terms that it proposes."""

    residual: float
    bias: float
    error: float
    proposed: str


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


def night(folder: Path) -> tuple[Outcome, list[str]]:
    """Run a night; return its outcome and the names of the proposed terms."""
    home = folder / "home"
    nightly.run_night(folder / "landing", home, Silent())
    store = Store(home)
    dsm = Dsm.from_dict(json.loads(store.read_table("calibration_dsm")["model"][0]))
    proposed = propose_terms(home, dsm).filter("proposed")
    rows = proposed.select("term", "value", "sd").iter_rows()
    words = ", ".join(f"{name} {value:.3f} ± {sd:.3f}" for name, value, sd in rows)
    now = Outcome(residual(home), *errors(store, folder / "truth"), words or "none")
    return now, proposed["term"].to_list()


def fleet(seed: int, missing: dict[str, float], size: FleetSettings) -> list[Outcome]:
    """One fleet: night, proposal, and the night again where a term was accepted."""
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        list(write_fleet(folder, seed, replace(size, missing=missing)))
        outcome, terms = night(folder)
        if not terms:
            return [outcome]
        accept_terms(folder / "home", terms)
        return [outcome, night(folder)[0]]


def compare(seed: int, size: FleetSettings) -> list[str]:
    """Compare a fleet as it is with one that has a term the model lacks; a row of the table."""
    floor = fleet(seed, {}, size)[0]
    lacking = fleet(seed, {"water_spray": SPRAY}, size)
    outcomes = lacking[0], lacking[-1], floor
    figures = [f"{outcome.residual:.4f}" for outcome in outcomes]
    biases = ", ".join(f"{outcome.bias:+.3f}" for outcome in outcomes)
    mean_errors = ", ".join(f"{outcome.error:.3f}" for outcome in outcomes)
    return [f"{seed}", lacking[0].proposed, floor.proposed, *figures, biases, mean_errors]


def main(seeds: tuple[int, ...] = (1, 2, 3), tails: int = 3, flights: int = 200) -> Texts:
    """Fleets of these seeds; aircraft of an operator and their flights."""
    size = FleetSettings(operators=2, tails=tails, flights=flights)
    head = ["fleet", "proposed", "where nothing is missing", "residual before", "accepted", "nothing missing"]
    triple = "before, accepted, nothing missing"
    lines = [[*head, f"bias of the loss {triple}", f"error of the loss {triple}"]]
    yield "terms", markdown(lines + [compare(seed, size) for seed in seeds])


if __name__ == "__main__":
    run(main, page=DOCS / "theory.md")
