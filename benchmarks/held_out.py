"""Transfer between types: the message of one type predicted by models of others, `python -m benchmarks.held_out`.

    python -m benchmarks.held_out --fleet NAME HOME TRUTH [--fleet ...] [--write]

Claim: the margin carries from type to type and the loss alone does not. One learner, taught by one fleet with its truth
and asked about another type, with four kinds of input: the loss and its trends; the margin, what flights asked and what
was seen with the door full open; both; both with the true loss in place of the estimate. Beside them the product, whose
base saw neither: simulated lives, and what the asked fleet's other tails taught. `--write` puts the table into
docs/prognosis.md.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks import chain, samples
from benchmarks.contestants import Cases, Learner, rows_of
from benchmarks.harness import arguments, markdown, show
from benchmarks.prognosis import PAGE
from benchmarks.survival import censored_scores
from hdt_core.prognosis.history import FEATURES, WEAR
from hdt_core.prognosis.metrics import join_outcomes, score_prognoses

SCORES = ("auc", "brier_skill", "c_index", "brier_100_skill", "interval_skill", "coverage", "mae_flights")
INPUTS = ("loss and trends", "margin", "both", "both, true loss")


def by_input(cases: Cases) -> Cases:
    """The same rows with the inputs of this comparison."""
    health, truth = cases.inputs["health"], cases.inputs["truth as ceiling"]
    wear = np.array([name in WEAR for name in FEATURES] + [True] * (health.shape[1] - len(FEATURES)))
    parts = (health[:, wear], health[:, ~wear], health, truth)
    return replace(cases, inputs=dict(zip(INPUTS, parts, strict=True)))


def read(home: Path, folder: Path) -> chain.Tables:
    """Run one fleet through the chain and add its true lives."""
    tables = chain.run(samples.record(home) | samples.truth(folder))
    return tables | {"lives": samples.true_lives(tables["features"], tables["truth"], tables["events"])}


def line(scored_on: str, taught: str, inputs: str, scored: pl.DataFrame) -> list[str]:
    """One row: `scored` holds in `risk` the probability of a message within 100 flights."""
    scores = score_prognoses(scored) | censored_scores(scored, "risk")
    return [scored_on, taught, inputs, *(f"{scores.get(name, np.nan):.3g}" for name in SCORES)]


def table(fleets: dict[str, chain.Tables]) -> str:
    """Score every training fleet on every other fleet."""
    rows = {name: by_input(rows_of(tables)) for name, tables in fleets.items()}
    lines = [["asked", "taught by", "inputs", "AUC, 50", "Brier skill, 50", "C-index", "Brier skill, 100"]]
    lines[0] += ["interval skill", "coverage", "error [flights]"]
    for name, tables in fleets.items():
        for taught, teacher in rows.items():
            for inputs in INPUTS if taught != name else ():
                forecasts = Learner.fit(teacher, inputs).predict(rows[name], inputs)
                lines.append(line(name, taught, inputs, forecasts.filter(pl.col("remaining") >= 1)))
        product = join_outcomes(tables["prognoses"], tables["features"], tables["lives"])
        product = product.with_columns(risk="p_event_100")
        lines.append(line(name, "simulated lives, own other tails", "the product", product))
    return markdown(lines)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--fleet", nargs=3, action="append", required=True, metavar=("NAME", "HOME", "TRUTH"))
    options = parser.parse_args()
    fleets = {name: read(Path(home), Path(folder)) for name, home, folder in options.fleet}
    show("held out", table(fleets), PAGE, write=options.write)


if __name__ == "__main__":
    main()
