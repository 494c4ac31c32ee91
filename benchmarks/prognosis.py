"""Lead, diagnosis and remaining life on simulated fleets: `python -m benchmarks.prognosis [--fleets N] [--write]`.

Claims: alerts come before the message and seldom without a cause; intervals of the remaining life cover 90 %; health
parameters foretell better than raw sensors. The fleets that score are flown by the raw-signal simulator with seeds and
designs of their own, through the whole chain; the base learned from tracks drawn by the episode simulator, and saw
none of them. Both share the shapes of wear. Figures pool the fleets; ranges are 5 to 95 % over tails drawn anew.
`--write` puts the tables into docs/prognosis.md.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.augment import augmented, own_rows
from benchmarks.contestants import SETS, Learner, extrapolated, lead_at_budget, rows_of, together
from benchmarks.detection import GROUP
from benchmarks.fleets import Frames, flown
from benchmarks.page import write
from hdt_core.prognosis.lives import episodes
from hdt_core.prognosis.metrics import (
    alpha_lambda,
    calibration,
    interval_score,
    judge,
    prognostic_horizon,
    score_prognoses,
)
from hdt_core.prognosis.model import Prognosis, fit_prognosis, out_of_fold, predict_prognosis
from hdt_core.simulate.design import FleetSettings
from pipelines.learned import shipped_base

PAGE = Path(__file__).parent.parent / "docs" / "prognosis.md"
SCORED, TAUGHT = 9000, 6000
"""First seeds of the fleets that score, and of those that teach the contestants."""
SIZE = FleetSettings(operators=2, tails=5, flights=400, cpl_share=0.0)
EPISODES = (0, 1, 5, 20)
PACK = ["tail", "pack"]
SOON = 300
"""Flights within which an alert of low margin foretells the message."""


def causes(truth: pl.DataFrame) -> pl.DataFrame:
    """What was wrong on or near each flight: one flag a cause, by flight and pack."""

    def near(flag: pl.Expr, before: int, after: int) -> pl.Expr:
        seen = flag.cast(pl.Int8).rolling_max(before + after + 1, min_samples=1).shift(-after)
        return seen.fill_null(strategy="forward").over(*PACK) > 0

    loss = 1.0 - pl.min_horizontal("ua_ratio", "apparent_ua_ratio")
    jump = (pl.col("blockage") - pl.col("blockage").shift(3).over(*PACK)).fill_null(0.0) > 0.08
    rows = truth.sort(*PACK, "index").with_columns(loss=loss, jump=jump)
    return rows.select(
        *PACK,
        "flight_id",
        "index",
        "loss",
        HX=pl.col("loss") >= 0.05,
        CC=pl.col("cc_eff_loss") >= 0.05,
        RAM_DOOR=near(pl.col("door_fault"), 8, 2),
        SENSOR=near(pl.col("sensor_fault") != "", 8, 2),
        ice=near(pl.col("icing"), 3, 0),
        clog=near(pl.col("jump"), 40, 0),
    )


def tally(fleet: Frames) -> pl.DataFrame:
    """Everything the alerts are judged by, long: tail, what, value."""
    about = causes(fleet["truth"])
    alerts = (
        fleet["alerts"]
        .join(about, left_on=[*PACK, "raised_flight_id"], right_on=[*PACK, "flight_id"])
        .with_columns(pl.col("diagnosis").replace_strict(GROUP).alias("group"))
    )
    alerts = alerts.with_columns(low_margin=low_margin_rightly(alerts, fleet["events"]))
    own = pl.any_horizontal([(pl.col("group") == g) & pl.col(g) for g in ("HX", "CC", "RAM_DOOR", "SENSOR")])
    own |= pl.col("low_margin")
    fault = pl.any_horizontal("HX", "CC", "RAM_DOOR", "SENSOR", "ice", "low_margin")
    hx = pl.col("group") == "HX"
    told = alerts.select(
        "tail",
        false=(~fault).cast(pl.Float64),
        false_hx=(~fault & hx).cast(pl.Float64),
        early=(hx & (pl.col("loss") < 0.15) & ~pl.col("low_margin")).cast(pl.Float64),
        not_own=(~own).cast(pl.Float64),
        right=pl.when(fault).then(own.cast(pl.Float64)),
    )
    flights = fleet["truth"].filter("arrived").select("tail", "flight_id").unique().group_by("tail").len("flights")
    parts = [
        told.unpivot(index="tail", variable_name="what").drop_nulls(),
        flights.unpivot(index="tail", variable_name="what").cast({"value": pl.Float64}),
        _found(fleet["events"], alerts),
    ]
    return pl.concat(parts)


def low_margin_rightly(alerts: pl.DataFrame, events: pl.DataFrame) -> pl.Series:
    """Whether a message followed an alert of low margin within `SOON` flights: it speaks of reserve, not of wear."""
    ended = events.filter((pl.col("component") == "HX") & pl.col("message_index").is_not_null())
    ends = {key: own["message_index"].to_numpy() for key, own in ended.group_by(*PACK)}
    said = alerts.select(*PACK, "index", "diagnosis").iter_rows()
    right = [d == "HX_LOW_MARGIN" and any(0 < e - at <= SOON for e in ends.get((t, p), ())) for t, p, at, d in said]
    return pl.Series(right, dtype=pl.Boolean)


def _found(events: pl.DataFrame, alerts: pl.DataFrame) -> pl.DataFrame:
    """Lead of each failure [flight, 0 when missed] and whether each fault was found."""
    rows = []
    for e in events.iter_rows(named=True):
        component, wear = e["component"], e["component"] in ("HX", "CC")
        if e["message_index" if wear else "onset_index"] is None:
            continue
        low = max(e["onset_index"] or 0, e["installed_index"] or 0)
        high = e["message_index"] if wear else (e["removal_index"] or 10**9) + 3
        # little margin may be seen before wear has set in
        since = pl.when(pl.col("diagnosis") == "HX_LOW_MARGIN").then(e["installed_index"] or 0).otherwise(low)
        at = alerts.filter(
            pl.col("tail") == e["tail"], pl.col("pack") == e["pack"], pl.col("group") == component,
            pl.col("index") >= since, pl.col("index") < high,
        )["index"].min()  # fmt: skip
        rows.append((e["tail"], f"found_{component}", float(at is not None)))
        if wear:
            rows.append((e["tail"], f"lead_{component}", 0.0 if at is None else float(high - at)))
    return pl.DataFrame(rows, schema={"tail": pl.String, "what": pl.String, "value": pl.Float64}, orient="row")


ALERT_GOALS = {
    "exchanger failures alerted before the message": "1.00",
    "lead, median [flights]": "180",
    "lead, 10th percentile [flights]": "50",
    "alerts below 15 % loss in 1,000 flights": "2",
    "false alarms in 1,000 flights": "1",
    "false exchanger alarms in 1,000 flights": "0.3",
    "alerts without their own cause in 1,000 flights": "2",
    "compressor failures alerted": "0.95",
    "door faults alerted": "0.80",
    "sensor faults alerted": "0.90",
    "diagnosis right": "0.90",
}


def alert_figures(counted: pl.DataFrame) -> list[float]:
    """Figures in the order of `ALERT_GOALS` over a tally."""
    of = {str(k): v.to_numpy() for (k,), v in ((k, f["value"]) for k, f in counted.group_by("what"))}
    none = np.empty(0)

    def rate(what: str) -> float:
        return 1000.0 * float(of.get(what, none).sum() / of["flights"].sum())

    def mean(what: str) -> float:
        return float(of[what].mean()) if what in of else np.nan

    lead = of.get("lead_HX", np.array([np.nan]))
    rates = [rate(w) for w in ("early", "false", "false_hx", "not_own")]
    shares = [mean(w) for w in ("found_CC", "found_RAM_DOOR", "found_SENSOR", "right")]
    return [mean("found_HX"), float(np.median(lead)), float(np.quantile(lead, 0.1)), *rates, *shares]


def confusion(fleets: list[Frames]) -> str:
    """What was said against what was there, alerts counted."""
    rows = []
    for fleet in fleets:
        about = causes(fleet["truth"])
        alerts = fleet["alerts"].join(about, left_on=[*PACK, "raised_flight_id"], right_on=[*PACK, "flight_id"])
        there = (
            pl.when(pl.col("RAM_DOOR")).then(pl.lit("door"))
            .when(pl.col("SENSOR")).then(pl.lit("sensor"))
            .when(pl.col("clog")).then(pl.lit("clog"))
            .when(pl.col("HX") & (pl.col("diagnosis") != "CC_DEGRADED")).then(pl.lit("fouling"))
            .when(pl.col("CC")).then(pl.lit("compressor"))
            .when(pl.col("HX")).then(pl.lit("fouling"))
            .otherwise(pl.lit("nothing"))
        )  # fmt: skip
        rows.append(alerts.select("diagnosis", there=there))
    counted = pl.concat(rows).group_by("diagnosis", "there").len()
    columns = ("fouling", "clog", "compressor", "door", "sensor", "nothing")
    lines = [["said \\ there", *columns]]
    for said in GROUP:
        own = dict(counted.filter(pl.col("diagnosis") == said).select("there", "len").iter_rows())
        lines.append([said, *(str(own.get(c, 0)) for c in columns)])
    return markdown(lines)


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
        for name, taught in (("these alone", rows), ("these and faults on nominal legs", augmented(features, lives))):
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


def markdown(lines: list[list[str]]) -> str:
    head, *rows = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([head, "| --- |" + " ---: |" * (len(lines[0]) - 1), *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fleets", type=int, default=8, help="fleets that score, and as many that teach")
    parser.add_argument("--draws", type=int, default=200, help="bootstrap draws")
    parser.add_argument("--write", action="store_true", help="update docs/prognosis.md")
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
        text = made()
        print(f"\n## {mark}\n\n{text}", flush=True)
        if given.write:
            write(mark, text, PAGE)


if __name__ == "__main__":
    main()
