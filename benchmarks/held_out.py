"""Transfer between types: the message of one type predicted by models of others, `python -m benchmarks.held_out`.

    python -m benchmarks.held_out --fleets NAME HOME TRUTH [NAME HOME TRUTH ...] [--write]

Claim: the margin carries from type to type and the loss alone does not. One learner, taught by one fleet with its truth
and asked about another type, with four kinds of input: the loss and its trends; the margin, what flights asked and what
was seen with the door full open; both; both with the true loss in place of the estimate. Beside them the product, whose
base saw neither: simulated lives, and what the asked fleet's other tails taught. Each censored
life counts by the chance that a life like it is still under observation then. `--write` puts the table into
docs/prognosis.md.

The contestants are predictors of a message, from raw signals to the truth, through one learner: hazard, interval
levels, alert. Each learns from fleets of its own and is asked about others. They differ in their inputs alone.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.isotonic import IsotonicRegression
from sksurv.metrics import brier_score, concordance_index_ipcw
from sksurv.nonparametric import kaplan_meier_estimator
from sksurv.util import Surv

from benchmarks import chain
from benchmarks.fleets import Frames, read_record, read_truth, true_lives
from benchmarks.harness import DOCS, Texts, markdown, run
from hdt_core.prognosis.feature_rows import PRIOR_RULES, fleet_rows, tracks
from hdt_core.prognosis.hazard import EDGES, event_by, fit_hazard, hazards, quantile
from hdt_core.prognosis.history import FEATURES, WEAR
from hdt_core.prognosis.metrics import join_outcomes, score_prognoses
from hdt_core.prognosis.recalibrate import Levels, learn_levels

Array = NDArray[np.float64]

RAW = (
    "hx_out_cruise_k", "hx_in_cruise_k", "pack_flow_cruise_kg_s", "tat_cruise_k", "altitude_cruise_m", "mach_cruise",
    "cc_speed_cruise_rad_s", "door_median", "door_full_open_share",
)  # fmt: skip
RESIDUALS = (
    "hx_out_sensor_minus_dsm_k", "ram_out_sensor_minus_dsm_k", "cc_effective_diameter_sensor_minus_dsm_m",
    "cc_flow_sensor_minus_dsm_kg_s",
)  # fmt: skip
SETS = ("raw sensors", "+ DSM residuals", "+ health parameters", "truth as ceiling")
THIN = 5
"""Of a life's flights one in so many teaches."""


@dataclass(frozen=True)
class Cases:
    """Rows of some fleets: key, true loss, what became of each, and inputs by contestant."""

    frame: pl.DataFrame
    inputs: dict[str, Array]
    remaining: Array
    failed: NDArray[np.bool_]
    life: NDArray[np.int_]


def rows_of(fleet: Frames) -> Cases:
    """Build each contestant's inputs for all flights of a fleet."""
    lives = fleet["lives"]
    loss = 1.0 - pl.min_horizontal("ua_ratio", "apparent_ua_ratio")
    truth = fleet["truth"].select("tail", "flight_id", "pack", "index", loss=loss)
    features = fleet["features"].join(truth, on=["tail", "flight_id", "pack"], how="left")
    measured = tracks(features, lives, "HX")
    true_ratio = (1.0 - pl.col("loss")).log()
    truly = features.with_columns(hx_fouling="loss", hx_fouling_sd=pl.lit(0.002), hx_ln_ua_ratio=true_ratio)
    ceiling = tracks(truly, lives, "HX")
    inputs_of = features.drop("operator", "departed_at")
    frame = measured.keys.join(inputs_of, on=["tail", "flight_id", "pack"], how="left", maintain_order="left")
    raw = _columns(frame, RAW)
    compared = _columns(frame, RESIDUALS)
    health, true = (fleet_rows(t, PRIOR_RULES["HX"]).features for t in (measured, ceiling))
    inputs = dict(zip(SETS, (raw, np.hstack([raw, compared]), np.hstack([raw, compared, health]), true), strict=True))
    keys = frame.select("tail", "flight_id", "pack", "index", "loss", "life_id")
    every = inputs | {"health": health, "health parameters alone": health}
    return Cases(keys, every, measured.remaining, measured.failed, measured.at[:, 0])


def together(parts: list[Cases]) -> Cases:
    """Rows of many fleets, lives numbered through."""
    first = np.cumsum([0, *(int(p.life.max()) + 1 for p in parts[:-1])])
    life = np.concatenate([p.life + k for p, k in zip(parts, first, strict=True)])
    frame = pl.concat([p.frame for p in parts]).with_columns(life_id=pl.Series(life))
    inputs = {name: np.vstack([p.inputs[name] for p in parts]) for name in parts[0].inputs}
    left, failed = (np.concatenate([getattr(p, name) for p in parts]) for name in ("remaining", "failed"))
    return Cases(frame, inputs, left, failed, life)


@dataclass(frozen=True)
class Learner:
    """Hazard and the quantile levels of its 90 % interval and middle."""

    model: HistGradientBoostingClassifier
    levels: Levels
    informative: NDArray[np.bool_]

    @classmethod
    def fit(cls, cases: Cases, name: str, seed: int = 0) -> "Learner":
        """Fit the hazard on two thirds of the tails and the interval levels on the rest."""
        # a probe that no taught aircraft carries tells nothing
        use = (cases.remaining >= 1) & (np.arange(cases.remaining.size) % THIN == 0)
        tails = cases.frame["tail"].to_numpy()
        calibrating = np.isin(tails, np.unique(tails)[::3])
        informative = np.isfinite(cases.inputs[name][use & ~calibrating]).any(axis=0)
        x = np.where(informative, cases.inputs[name], 0.0)
        fitted = use & ~calibrating
        model = fit_hazard(x[fitted], cases.remaining[fitted], cases.failed[fitted], seed)
        check = use & calibrating
        by = event_by(hazards([model], x[check]))
        left, failed, life = (v[check] for v in (cases.remaining, cases.failed, cases.life))
        return cls(model, learn_levels(by, left, failed, life, prior_lives=5.0), informative)

    def predict(self, cases: Cases, name: str) -> pl.DataFrame:
        """Predict every row in the columns of `prognoses`, with the risk of a message within 100 flights."""
        by = event_by(hazards([self.model], np.where(self.informative, cases.inputs[name], 0.0)))
        low, middle, high = (quantile(by, level) for level in self.levels)
        return outcome(cases).with_columns(
            rul_flights=pl.Series(middle),
            rul_low=pl.Series(np.minimum(low, middle)),
            rul_high=pl.Series(np.maximum(high, middle)),
            p_event_50=pl.Series(by[:, EDGES.tolist().index(50.0)]),
            risk=pl.Series(by[:, EDGES.tolist().index(100.0)]),
        )


def extrapolated(taught: Cases, cases: Cases) -> pl.DataFrame:
    """The contestant without a learner: the middle of the first passage, its error as taught fleets show."""

    def left(rows: Cases) -> Array:
        middle = rows.inputs["health"][:, FEATURES.index("passage_median")]
        return np.clip(np.nan_to_num(middle, nan=EDGES[-1]), 1.0, EDGES[-1])

    has_ended = (taught.remaining >= 1) & (taught.failed | (taught.remaining >= EDGES[-1]))
    factor = np.quantile(np.minimum(taught.remaining, EDGES[-1])[has_ended] / left(taught)[has_ended], [0.05, 0.95])
    decided = (taught.remaining >= 1) & (taught.failed | (taught.remaining > 50))
    hit = taught.failed & (taught.remaining <= 50)
    rule = IsotonicRegression(increasing=False, out_of_bounds="clip")
    odds = rule.fit(left(taught)[decided], hit[decided].astype(float))
    middle_left = left(cases)
    low, high = np.sort(np.clip(np.outer(factor, middle_left), 0.0, 300.0), axis=0)
    return outcome(cases).with_columns(
        rul_flights=pl.Series(middle_left),
        rul_low=pl.Series(low),
        rul_high=pl.Series(high),
        p_event_50=pl.Series(odds.predict(middle_left)),
        risk=pl.Series(-middle_left),
    )


def outcome(cases: Cases) -> pl.DataFrame:
    """Return each row's outcome in the columns of `score_prognoses`."""
    own = {"remaining": cases.remaining, "failed": cases.failed, "life": cases.life}
    rows = cases.frame.with_columns(pl.Series(name, values) for name, values in own.items())
    hit = pl.col("failed") & pl.col("remaining").is_between(1, 50)
    return rows.with_columns(event_50=pl.when(hit).then(1.0).when(pl.col("remaining") > 50).then(0.0))


def lead_at_budget(forecasts: pl.DataFrame, early_per_1000: float = 2.0) -> tuple[float, float, float]:
    """Lead [flight] of alerts on the risk, median and 10th percentile, and alerts below 15 % loss in 1,000 flights.

    The threshold is the lowest that stays within the budget on the very fleets asked about: the same favour to all.
    An alert holds until the risk falls to half of it.
    """
    life = ["tail", "pack", "life"]
    risk = pl.col("risk").rolling_median(3, min_samples=1).over(life)
    ordered = forecasts.sort(*life, "index").with_columns(risk=risk, first=pl.col("life").is_first_distinct())
    risk, loss, left = (ordered[c].to_numpy() for c in ("risk", "loss", "remaining"))
    first, failed, number = (ordered[c].to_numpy() for c in ("first", "failed", "life"))
    flights = ordered["flight_id"].n_unique()
    lives = np.unique(number[failed & (loss >= 0.05)])
    for threshold in np.unique(np.quantile(risk, np.linspace(0.2, 0.999, 240))):
        raised = _raised(risk, first, float(threshold))
        early = 1000.0 * float((raised & (loss < 0.15)).sum()) / flights
        if early <= early_per_1000:
            hit = raised & failed & (left >= 1) & (loss >= 0.05)
            lead = np.zeros(lives.size)
            np.maximum.at(lead, np.searchsorted(lives, number[hit]), left[hit])
            return float(np.median(lead)), float(np.quantile(lead, 0.1)), early
    return 0.0, 0.0, 0.0


def _raised(risk: Array, first: NDArray[np.bool_], threshold: float) -> NDArray[np.bool_]:
    """Return the flights that raise an alert, with hysteresis below the threshold."""
    out = np.zeros(risk.size, dtype=bool)
    on = False
    clear = threshold * (0.5 if threshold > 0 else 2.0)
    for k in range(risk.size):
        before = on and not first[k]
        on = bool(risk[k] >= threshold or (before and risk[k] >= clear))
        out[k] = on and not before
    return out


def _columns(frame: pl.DataFrame, names: tuple[str, ...]) -> Array:
    """Each column, its means over 10 and 40 flights, and its change over 30, within a unit's life."""
    life = ["tail", "pack", "life_id"]
    columns = [n if n in frame.columns else pl.lit(None, pl.Float64).alias(n) for n in names]
    wide = frame.select(*life, *columns)
    parts = []
    for n in names:
        mean_10 = pl.col(n).rolling_mean(10, min_samples=1)
        change = (mean_10 - mean_10.shift(30)).over(life)
        parts += [pl.col(n), mean_10.over(life).alias(f"{n}_10"), change.alias(f"{n}_change")]
        parts.append(pl.col(n).rolling_mean(40, min_samples=1).over(life).alias(f"{n}_40"))
    age = pl.int_range(pl.len()).over(life).cast(pl.Float64).alias("seen")
    return np.asarray(wide.select(*parts, age).cast(pl.Float64).to_numpy(), dtype=float)


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
    health = cases.inputs["health"]
    truth = cases.inputs["truth as ceiling"]
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


def main(fleets: tuple[str, ...]) -> Texts:
    """Fleets, each by its name, the home of its record and the folder of its truth."""
    threes = zip(*[iter(fleets)] * 3, strict=True)
    yield "held out", table({name: read(Path(home), Path(folder)) for name, home, folder in threes})


if __name__ == "__main__":
    run(main, page=DOCS / "prognosis.md")
