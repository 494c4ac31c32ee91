"""Labelled events of machines that are watched all the time: wind turbines (CARE) and heating substations (PreDist).

Both are one question: rows to learn from, rows to judge, and whether a fault was on its way. Scores are those of the
CARE paper (Gueck, Roelofs, Faulstich 2024): by row on faults, accuracy on normal stretches, earliness, and by event
with a counter that rises with every alarm and falls with every row without.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.real.normal_behaviour import Array, Flags, alarms
from benchmarks.real.recipe import Recipe, Result, scored

BETA2 = 0.25
"""F with beta 0.5: a false alarm weighs more than a miss."""
CRITICAL = 72
"""Rows of ten minutes, twelve hours net of those without an alarm, from which an event counts as found."""
FULL_WEIGHT = 0.25
"""Share of an event in which an alarm counts in full; its weight falls to 0 at the end."""
RUNNING = (0, 2)
"""Status of a turbine that runs or idles."""
WATCHED_DAYS, LEARN_DAYS = 7, 730


@dataclass(frozen=True, slots=True)
class Event:
    """A stretch to judge. Alarms count on rows that are `normal` by the machine's own status."""

    fault: bool
    train: Array
    test: Array
    normal: Flags
    within: Flags
    """Rows of the event itself."""
    hours_left: Array
    """To its end: of a fault, to the report."""


@dataclass(frozen=True, slots=True)
class EventScore:
    """What came of one event; `accuracy` of normal ones, `by_row` and `early` of faults."""

    fault: bool
    detected: bool
    accuracy: float
    by_row: float
    early: float
    lead_hours: float


def judge(event: Event, called: Flags) -> EventScore:
    """Scores of one event."""
    truth = ~event.normal | (event.within if event.fault else np.zeros_like(event.within))
    y, alarm = truth[event.normal], called[event.normal]
    level, counter = 0, np.zeros(called.size)
    for k in range(called.size):
        level = max(0, level + (1 if called[k] else -1)) if event.normal[k] else level
        counter[k] = level
    is_detected = counter > CRITICAL
    place = (np.arange(event.within.sum()) + 0.5) / max(event.within.sum(), 1)
    weight = np.minimum(1.0, (1.0 - place) / (1.0 - FULL_WEIGHT))
    early = float((called[event.within] * weight).sum() / weight.sum()) if event.within.any() else np.nan
    lead = float(event.hours_left[is_detected.argmax()]) if is_detected.any() else np.nan
    return EventScore(event.fault, bool(is_detected.any()), float((y == alarm).mean()), f_beta(y, alarm), early, lead)


def f_beta(truth: Flags, alarm: Flags) -> float:
    """F score with beta 0.5; 0 where nothing was right."""
    right, wrong, missed = (truth & alarm).sum(), (~truth & alarm).sum(), (truth & ~alarm).sum()
    return float((1.0 + BETA2) * right / max((1.0 + BETA2) * right + BETA2 * missed + wrong, 1e-12))


def care(scores: list[EventScore]) -> float:
    """The CARE score: coverage, accuracy (twice), reliability and earliness; NaN without both kinds of event."""
    fault, detected = (np.array([getattr(j, name) for j in scores]) for name in ("fault", "detected"))
    if fault.all() or not fault.any():
        return np.nan
    accuracy = np.mean([j.accuracy for j in scores if not j.fault])
    if not detected.any() or accuracy <= 0.5:
        return float(accuracy) if detected.any() else 0.0
    by_row, early = (np.mean([getattr(j, name) for j in scores if j.fault]) for name in ("by_row", "early"))
    return float((by_row + early + f_beta(fault, detected) + 2.0 * accuracy) / 5.0)


def turbines(folder: Path) -> Iterator[Event]:
    """CARE: `Wind Farm X/event_info.csv` and `datasets/<event_id>.csv`, semicolons, a year to learn from in each."""
    for info in sorted(folder.glob("**/event_info.csv")):
        for entry in pl.read_csv(info, separator=";").iter_rows(named=True):
            rows = pl.read_csv(info.parent / "datasets" / f"{entry['event_id']}.csv", separator=";").sort("id")
            sensors = rows.select(c for c in rows.columns if c.endswith("_avg")).cast(pl.Float64).to_numpy()
            normal, number = rows["status_type_id"].is_in(RUNNING).to_numpy(), rows["id"].to_numpy()
            train = (rows["train_test"] == "train").to_numpy()
            within = (entry["event_start_id"] <= number) & (number <= entry["event_end_id"])
            left = (entry["event_end_id"] - number) / 6.0
            yield Event(
                entry["event_label"] == "anomaly",
                sensors[train & normal],
                sensors[~train],
                normal[~train],
                within[~train],
                left[~train],
            )


def substations(folder: Path) -> Iterator[Event]:
    """PreDist: `Manufacturer k/faults.csv`, `normal_events.csv`, `operational_data/substation_<i>.csv`, semicolons."""
    for maker in sorted(f.parent for f in folder.glob("**/faults.csv")):
        for name, ends in (("faults", "Report date"), ("normal_events", "Event end")):
            events = pl.read_csv(maker / f"{name}.csv", separator=";", infer_schema_length=None)
            times = [c for c in ("Training start", "Training end", "Event start", ends) if c in events.columns]
            events = events.with_columns(pl.col(times).cast(pl.String).str.to_datetime(time_unit="us"))
            if "efd_possible" in events.columns:
                events = events.filter(pl.col("efd_possible").cast(pl.String).str.to_lowercase() == "true")
            yield from (_substation(maker, row, row[ends], name == "faults") for row in events.iter_rows(named=True))


def _substation(maker: Path, row: dict, end, fault: bool) -> Event:
    file = maker / "operational_data" / f"substation_{row['substation ID']}.csv"
    rows = pl.read_csv(file, separator=";", infer_schema_length=None)
    at = pl.col("timestamp").cast(pl.String).str.slice(0, 19).str.to_datetime(time_unit="us")
    rows = rows.with_columns(at).unique("timestamp", keep="first").sort("timestamp")
    numbers = [c for c, kind in rows.schema.items() if kind.is_numeric()]
    time = pl.col("timestamp")
    learned = pl.max_horizontal(
        pl.lit(row["Training start"]), pl.lit(row["Training end"]) - pl.duration(days=LEARN_DAYS)
    )
    train = rows.filter((time >= learned) & (time <= row["Training end"]))
    begins = pl.lit(end) - pl.duration(days=WATCHED_DAYS) if fault else pl.lit(row["Training end"])
    test = rows.filter((time > begins) & (time <= end))
    moves = [c for c in numbers if test[c].n_unique() > 1 and train[c].n_unique() > 1]
    left = (test.select((pl.lit(end) - time).dt.total_seconds() / 3600.0).to_series()).to_numpy()
    all_of_it = np.ones(test.height, dtype=bool)
    cast = [frame.select(moves).cast(pl.Float64).to_numpy() for frame in (train, test)]
    return Event(fault, cast[0], cast[1], all_of_it, all_of_it, left)


def run(events: Callable[[Path], Iterator[Event]], goal: str) -> Callable[[Path], Result]:
    """All events of a set."""

    def of(folder: Path) -> Result:
        verdicts = [judge(e, alarms(e.train, e.test)) for e in events(folder)]
        fault, detected = (np.array([getattr(j, name) for j in verdicts]) for name in ("fault", "detected"))
        lead = np.array([j.lead_hours for j in verdicts])
        number = np.arange(len(verdicts))

        def mean_of(values, which, i) -> float:
            rows = i[which[i]]
            return float(values[rows].mean()) if rows.size else np.nan

        right = np.array([j.accuracy for j in verdicts])
        scores = [
            scored("CARE score", goal, number, lambda i: care([verdicts[k] for k in i])),
            scored("F0.5 by event", "", number, lambda i: f_beta(fault[i], detected[i])),
            scored("faults found before the report", "", number, lambda i: mean_of(detected, fault, i)),
            scored("accuracy on normal stretches", "", number, lambda i: mean_of(right, ~fault, i)),
            scored("lead [h]", "", number, lambda i: mean_of(lead, fault & detected, i)),
        ]
        return Result(scores)

    return of


CARE = Recipe(
    name="care",
    title="Wind turbines (CARE to Compare)",
    folder="care*",
    wants="**/event_info.csv",
    source="Gueck, Roelofs and Faulstich, Fraunhofer IEE, 2024, doi 10.5281/zenodo.14958989",
    licence="CC BY-SA 4.0, by its page",
    anchor="CARE score .66 of an autoencoder (Data 9 (12) 138)",
    run=run(turbines, ""),
)
PREDIST = Recipe(
    name="predist",
    title="District heating substations (PreDist)",
    folder="predist*",
    wants="**/faults.csv",
    source="Fraunhofer IEE, 2025, doi 10.5281/zenodo.17522254",
    licence="by its page",
    anchor="F0.5 by event .83, accuracy .98, 60 % found before the report (arXiv 2511.14791)",
    run=run(substations, ""),
)
