"""Lead, diagnosis and remaining life on simulated fleets: `python -m benchmarks.prognosis [--fleets N] [--write]`.

Claims: alerts come before the message and seldom without a cause; intervals of the remaining life cover 90 %; health
parameters foretell better than raw sensors. The fleets that score are flown by the raw-signal simulator with seeds and
designs of their own, through the whole chain; the base learned from tracks drawn by the episode simulator, and saw
none of them. Both share the shapes of wear. Figures pool the fleets; ranges are 5 to 95 % over tails drawn anew.
`--write` puts the tables into docs/prognosis.md.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.alerts import ALERT_GOALS, alert_figures, confusion, tally
from benchmarks.augment import augmented, own_rows
from benchmarks.contestants import SETS, Learner, extrapolated, lead_at_budget, rows_of, together
from benchmarks.fleets import Frames, flown
from benchmarks.harness import arguments, markdown, show
from hdt_core.prognosis.metrics import (
    alpha_lambda,
    calibration,
    interval_score,
    judge,
    prognostic_horizon,
    score_prognoses,
)
from hdt_core.prognosis.model import Prognosis, fit_prognosis, out_of_fold, predict_prognosis
from hdt_core.prognosis.unit_lives import episodes
from hdt_core.simulate.design import FleetSettings
from pipelines.learned import shipped_base

PAGE = Path(__file__).parent.parent / "docs" / "prognosis.md"
SCORED, TAUGHT = 9000, 6000
"""First seeds of the fleets that score, and of those that teach the contestants."""
SIZE = FleetSettings(operators=2, tails=5, flights=400, cpl_share=0.0)
EPISODES = (0, 1, 5, 20)


LIFE_GOALS = {
    "RUL, whole lives, mean absolute error [flights]": "50",
    "RUL 90 % interval, coverage": "0.88-0.92",
    "RUL 90 % interval, coverage in the last 100 flights": "",
    "RUL interval score below a constant interval's by": "0.30",
    "alpha-lambda, 20 %, last 100 flights": "",
    "p_event_50, Brier skill": "0.25",
    "p_event_50, AUC": "0.95",
    "RUL 90 % interval, mean width [flights]": "",
    "prognostic horizon, +-30 flights, median [flights]": "",
}


def life_figures(judged: pl.DataFrame) -> list[float]:
    """Figures in the order of `LIFE_GOALS` over judged prognoses."""
    scores = score_prognoses(judged)
    names = ("mae_flights", "coverage", "coverage_last_100", "interval_skill", "alpha_lambda_20", "brier_skill", "auc")
    width = (judged["rul_high"] - judged["rul_low"]).mean()
    return [*(scores.get(n, np.nan) for n in names), float(np.nan if width is None else width), _horizon(judged)]


def _horizon(judged: pl.DataFrame) -> float:
    ended = judged.filter(pl.col("failed") & pl.col("rul_flights").is_not_null())
    lives = ended.partition_by("tail", "life")
    return float(np.median([prognostic_horizon(x["left"], x["rul_flights"], 30.0) for x in lives])) if lives else np.nan


def figures(
    frame: pl.DataFrame, goals: dict[str, str], formula: Callable[[pl.DataFrame], list[float]], draws: int
) -> str:
    """Goal, value and range over tails of each figure."""
    rng = np.random.default_rng(0)
    parts = frame.partition_by("tail")
    drawn = [formula(pl.concat([parts[i] for i in rng.integers(0, len(parts), len(parts))])) for _ in range(draws)]
    low, high = np.nanquantile(np.array(drawn), [0.05, 0.95], axis=0)
    lines = [["figure", "goal", "measured", "5-95 %"]]
    for (name, goal), value, a, b in zip(goals.items(), formula(frame), low, high, strict=True):
        lines.append([name, goal, f"{value:.3g}", f"{a:.3g} - {b:.3g}"])
    return markdown(lines)


def by_horizon(judged: pl.DataFrame) -> str:
    """RUL error and interval by how much life was left."""
    lines = [["flights left", "rows", "mean absolute error", "bias", "within 20 %", "coverage", "width", "score"]]
    ended = judged.filter(pl.col("failed") & pl.col("rul_flights").is_not_null())
    for low, high in ((0, 25), (25, 50), (50, 100), (100, 200), (200, 300)):
        part = ended.filter((pl.col("left") > low) & (pl.col("left") <= high))
        if part.height:
            t, s, a, b = (part[c].to_numpy() for c in ("left", "rul_flights", "rul_low", "rul_high"))
            cells = [np.abs(s - t).mean(), (s - t).mean(), alpha_lambda(t, s), ((a <= t) & (t <= b)).mean()]
            cells += [(b - a).mean(), interval_score(t, a, b).mean()]
            lines.append([f"{low}-{high}", str(part.height), *(f"{c:.3g}" for c in cells)])
    return markdown(lines)


def calibrated(judged: pl.DataFrame) -> str:
    """What `p_event_50` said against what came."""
    asked = judged.filter(pl.col("event_50").is_not_null() & pl.col("p_event_50").is_not_null())
    table = calibration(asked["event_50"].to_numpy(), asked["p_event_50"].to_numpy())
    return markdown([["said", "came", "rows"], *([f"{a:.3f}", f"{b:.3f}", str(n)] for a, b, n in table.iter_rows())])


def product(fleets: list[Frames], base: Prognosis) -> pl.DataFrame:
    """Judged out-of-fold prognoses of each fleet: its own other tails correct the base."""
    parts = []
    for fleet in fleets:
        said = out_of_fold(fleet["features"], fleet["lives"], base=base)
        parts.append(judge(said, fleet["features"], fleet["lives"]))
    return pl.concat(parts)


def with_episodes(fleets: list[Frames], base: Prognosis) -> str:
    """The product and learners without a simulated base, taught by a few failed lives."""
    lines = [["episodes", "taught by", "mean absolute error", "interval skill", "coverage", "Brier skill", "AUC"]]
    for count in EPISODES:
        said: dict[str, list[pl.DataFrame]] = {}
        for k, fleet in enumerate(fleets):
            others = [f for j, f in enumerate(fleets) if j != k]
            for half in (0, 1):
                for name, judged in _taught_by(fleet, others, half, count, base):
                    said.setdefault(name, []).append(judged)
        for name, parts in said.items():
            lines.append([str(count), name, *_cells(pl.concat(parts))])
    return markdown(lines)


def _taught_by(fleet: Frames, others: list[Frames], half: int, count: int, base: Prognosis):
    """Prognoses of one half of a fleet's tails after `count` failures: of the other half, then of other fleets."""
    tails = fleet["features"]["tail"].unique().sort().to_list()
    asked = tails[half::2]
    teachers = [*((fleet, t) for t in tails[1 - half :: 2])]
    teachers += [(f, t) for f in others for t in f["features"]["tail"].unique().sort().to_list()]
    features, lives = _first(teachers, count)
    model = fit_prognosis(features, lives, base=base)
    own = fleet["features"].filter(pl.col("tail").is_in(asked))
    own_lives = episodes(own, fleet["messages"], fleet["maintenance"])
    yield "simulated base, corrected", judge(predict_prognosis(model, own, own_lives), own, own_lives)
    if count >= 5:
        rows, asked_rows = own_rows(features, lives), own_rows(own, own_lives)
        for name, taught in (
            ("these alone", rows),
            ("these and faults on nominal legs", augmented(features, lives)),
        ):
            yield name, Learner.fit(taught, "health").say(asked_rows, "health").filter(pl.col("left") >= 1)


def _first(teachers: list[tuple[Frames, str]], count: int) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Features and lives of tails, one after another, until they hold `count` failures."""
    frames, lives, failures = [], [], 0
    for fleet, tail in teachers:
        if failures >= count:
            break
        frames.append(fleet["features"].filter(pl.col("tail") == tail))
        lives.append(episodes(frames[-1], fleet["messages"], fleet["maintenance"]))
        failures += lives[-1].filter((pl.col("component") == "HX") & pl.col("failed")).height
    if not frames:
        empty = teachers[0][0]["features"].clear()
        return empty, episodes(empty, teachers[0][0]["messages"].clear(), teachers[0][0]["maintenance"].clear())
    return pl.concat(frames, how="diagonal_relaxed"), pl.concat(lives)


def ablation(taught: list[Frames], scored: list[Frames]) -> str:
    """The same learner on more and more of the twin."""
    learn, asked = together([rows_of(f) for f in taught]), together([rows_of(f) for f in scored])
    said = {name: Learner.fit(learn, name).say(asked, name) for name in (*SETS, "health parameters alone")}
    said["physics extrapolation, no learner"] = extrapolated(learn, asked)
    head = ["inputs", "mean absolute error", "interval skill", "coverage", "Brier skill", "AUC"]
    lines = [[*head, "interval score", "lead, median", "lead, 10th", "early in 1,000"]]
    for name, frame in said.items():
        judged = frame.filter(pl.col("left") >= 1)
        lead = [f"{v:.3g}" for v in lead_at_budget(judged)]
        lines.append([name, *_cells(judged), f"{score_prognoses(judged)['interval_score_flights']:.3g}", *lead])
    return markdown(lines)


def _cells(judged: pl.DataFrame) -> list[str]:
    scores = score_prognoses(judged)
    names = ("mae_flights", "interval_skill", "coverage", "brier_skill", "auc")
    return [f"{scores.get(n, np.nan):.3g}" for n in names]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--fleets", type=int, default=8, help="fleets that score, and as many that teach")
    parser.add_argument("--draws", type=int, default=200, help="bootstrap draws")
    given = parser.parse_args()
    scored = list(flown(SCORED, given.fleets, SIZE))
    base = shipped_base()
    counted = pl.concat([tally(f) for f in scored])
    judged = product(scored, base)
    flights = int(counted.filter(pl.col("what") == "flights")["value"].sum())
    failures = counted.filter(pl.col("what") == "lead_HX").height
    size = f"{given.fleets} fleets, {flights:,} flights of two packs, {failures} exchanger failures."
    parts: dict[str, Callable[[], str]] = {
        "evaluation": lambda: (
            f"{size}\n\n{figures(counted, ALERT_GOALS, alert_figures, given.draws)}\n\n"
            f"{figures(judged, LIFE_GOALS, life_figures, given.draws)}"
        ),
        "confusion": lambda: confusion(scored),
        "horizon": lambda: by_horizon(judged),
        "calibration": lambda: calibrated(judged),
        "ablation": lambda: ablation(list(flown(TAUGHT, given.fleets, SIZE)), scored),
        "episodes": lambda: with_episodes(scored, base),
    }
    for mark, made in parts.items():
        show(mark, made(), PAGE, write=given.write)


if __name__ == "__main__":
    main()
