"""Transfer between types: the message of one type predicted by models of others, `python -m benchmarks.held_out`.

    python -m benchmarks.held_out --fleet NAME HOME TRUTH [--fleet ...] [--write]

Claim: the margin carries from type to type and the loss alone does not. One learner, taught by one fleet with its truth
and asked about another type, with four kinds of input: the loss and its trends; the margin, what flights asked and what
was seen with the door full open; both; both with the true loss in place of the estimate. Beside them the product, whose
base saw neither: simulated lives, and what the asked fleet's other tails taught. Each censored
life counts by the chance that a life like it is still under observation then. `--write` puts the table into
docs/prognosis.md.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
from sksurv.metrics import brier_score, concordance_index_ipcw
from sksurv.nonparametric import kaplan_meier_estimator
from sksurv.util import Surv

from benchmarks import chain
from benchmarks.contestants import Cases, Learner, rows_of
from benchmarks.fleets import read_record, read_truth, true_lives
from benchmarks.harness import arguments, markdown, show
from benchmarks.prognosis import PAGE
from hdt_core.prognosis.history import FEATURES, WEAR
from hdt_core.prognosis.metrics import join_outcomes, score_prognoses

HORIZON = 100.0
END = 300.0
"""Flights that are told; what is left beyond counts as left at the end."""


def censored_scores(prognoses: pl.DataFrame, risk: str) -> dict[str, float]:
    """Concordance of the risk with what came, and its Brier score at `HORIZON` flights over that of one risk for all.

    Parameters
    ----------
    prognoses : DataFrame
        `remaining`, `failed`, and in the column `risk` the probability of the message within `HORIZON` flights.

    References
    ----------
    .. [1] H. Uno et al., On the C-statistics for evaluating overall adequacy of risk prediction procedures with
       censored survival data, Statistics in Medicine 30, 2011.
    .. [2] E. Graf et al., Assessment and comparison of prognostic classification schemes for survival data, Statistics
       in Medicine 18, 1999.
    """
    rows = prognoses.drop_nulls(risk)
    left = np.minimum(rows["remaining"].to_numpy(), END)
    survival = Surv.from_arrays(rows["failed"].to_numpy() & (rows["remaining"].to_numpy() < END), left)
    risks = rows[risk].to_numpy()
    concordant = concordance_index_ipcw(survival, survival, risks, tau=END - 1.0)[0]
    both = (risks, np.full(risks.size, _by(survival)))
    brier, same = (float(brier_score(survival, survival, 1.0 - p, [HORIZON])[1][0]) for p in both)
    return {"c_index": float(concordant), "brier_100_skill": 1.0 - brier / same}


def _by(survival: np.ndarray) -> float:
    """Share of rows with the message within `HORIZON`, by Kaplan and Meier."""
    time, alive = kaplan_meier_estimator(survival["event"], survival["time"])
    return 1.0 - float(alive[np.searchsorted(time, HORIZON, side="right") - 1])


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
    tables = chain.run(read_record(home) | read_truth(folder))
    return tables | {"lives": true_lives(tables["features"], tables["truth"], tables["events"])}


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
