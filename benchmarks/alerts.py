"""Alerts by component on fleets whose truth is recorded: precision, recall, rate, lead, and cause at hand.

An alert is right where a message, a confirmed finding or the true fault of its own component follows within `FOLLOWED`
flights. A failure is alerted where an alert of its own component and unit was raised or open in the `BEFORE` flights
before it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.fleets import Frames
from benchmarks.harness import markdown
from hdt_core.alerts.alerts import trials

PACK = ["tail", "pack"]
FOLLOWED, BEFORE = 200, 300
GROUP = {
    "HX_FOULING": "HX", "HX_SUDDEN_CLOG": "HX", "HX_LOW_MARGIN": "HX", "CC_DEGRADED": "CC",
    "RAM_DOOR_FAULT": "RAM_DOOR", "SENSOR_FAULT": "SENSOR",
}  # fmt: skip
"""Component of each diagnosis."""
COMPONENTS = {"HX": "exchanger", "CC": "compressor", "RAM_DOOR": "ram door", "SENSOR": "sensors"}
CONFIRMED = ("FOULED", "CLOGGED", "CORRODED", "DAMAGED")
WORN = {"HX": 0.15, "CC": 0.05}
"""True loss that counts as the fault of a part that wears: that at which its rule alerts. [-]"""
AT_HAND = {"HX": 0.05, "CC": 0.05}
"""True loss at which an alert has its own cause at hand. [-]"""


class Tally(NamedTuple):
    """Alerts and failures of some fleets, one row each, with their marks."""

    alerts: pl.DataFrame
    failures: pl.DataFrame
    flights: int


def tally(fleet: Frames, alerts: pl.DataFrame | None = None) -> Tally:
    """Score a fleet's alerts, or others raised on the same record."""
    truth = causes(fleet["truth"])
    alerts_on_pack = place_alerts(fleet["alerts"] if alerts is None else alerts, fleet["truth"])
    failures = _failures(fleet["events"])
    packs = dict(truth.group_by(*PACK))
    findings = _findings(fleet["maintenance"], fleet["truth"])
    verdicts = [
        _judge_alert(a, packs[a["tail"], a["pack"]], failures, findings) for a in alerts_on_pack.iter_rows(named=True)
    ]
    marks = pl.DataFrame(verdicts, schema=dict.fromkeys(Marks._fields, pl.Boolean), orient="row")
    raised = [_alerted(f, alerts_on_pack) for f in failures.iter_rows(named=True)]
    failures = failures.with_columns(lead=pl.Series(raised, dtype=pl.Float64))
    flights = fleet["truth"].filter("arrived")["flight_id"].n_unique()
    marked = pl.concat([alerts_on_pack, marks], how="horizontal")
    return Tally(marked, failures.select("tail", "component", "lead"), flights)


def together(parts: list[Tally]) -> Tally:
    """Pool the tallies of several fleets."""
    alerts, failures, flights = zip(*parts, strict=True)
    return Tally(pl.concat(alerts), pl.concat(failures), sum(flights))


def causes(truth: pl.DataFrame) -> pl.DataFrame:
    """True faults by flight and pack: `at` hand on or near the flight, and `fault` on it, of each component."""

    def near(flag: pl.Expr, before: int, after: int) -> pl.Expr:
        window = flag.cast(pl.Int8).rolling_max(before + after + 1, min_samples=1).shift(-after)
        return window.fill_null(strategy="forward").over(*PACK) > 0

    losses = {"HX": 1.0 - pl.min_horizontal("ua_ratio", "apparent_ua_ratio"), "CC": pl.col("cc_eff_loss")}
    flags = {"RAM_DOOR": pl.col("door_fault"), "SENSOR": pl.col("sensor_fault") != ""}
    jump = (pl.col("blockage") - pl.col("blockage").shift(3).over(*PACK)).fill_null(0.0) > 0.08
    rows = truth.sort(*PACK, "index").with_columns(jump=jump)
    return rows.select(
        *PACK,
        "index",
        loss=losses["HX"],
        ice=near(pl.col("icing"), 3, 0),
        clog=near(pl.col("jump"), 40, 0),
        **{f"at_{c}": loss >= AT_HAND[c] for c, loss in losses.items()},
        **{f"at_{c}": near(flag, 8, 2) for c, flag in flags.items()},
        **{f"fault_{c}": loss >= WORN[c] for c, loss in losses.items()},
        **{f"fault_{c}": flag for c, flag in flags.items()},
    )


def place_alerts(alerts: pl.DataFrame, truth: pl.DataFrame) -> pl.DataFrame:
    """Alerts with the component they name and the pack's flights between which they were open."""
    flights = truth.sort("departed_at").select(*PACK, "flight_id", "index", "departed_at")
    at = flights.rename({"flight_id": "raised_flight_id", "index": "raised"}).drop("departed_at")
    ends = flights.select(*PACK, closed_at="departed_at", closed="index")
    rows = alerts.join(at, on=[*PACK, "raised_flight_id"], validate="m:1")
    rows = rows.sort("closed_at").join_asof(
        ends.sort("closed_at"), on="closed_at", by=PACK, strategy="forward", check_sortedness=False
    )
    group = pl.col("diagnosis").replace_strict(GROUP).alias("component")
    return rows.select(*PACK, "diagnosis", group, "raised", "closed").sort(*PACK, "raised")


class Marks(NamedTuple):
    """Criteria met by an alert."""

    by_message: bool
    """The message of its component followed within `FOLLOWED` flights."""
    right: bool
    """So did that, a confirmed finding or the true fault."""
    own: bool
    """Its own cause was at hand; for `HX_LOW_MARGIN`, which is about reserve, or a message within `BEFORE` flights."""
    any_cause: bool
    """Something was wrong with the pack."""
    early: bool
    """Raised for wear of an exchanger that had lost less than 15 %."""


def _judge_alert(alert: dict, truth: pl.DataFrame, failures: pl.DataFrame, findings: pl.DataFrame) -> Marks:
    component = alert["component"]
    first = alert["raised"]
    own_failures = _own(failures, alert).filter(pl.col("wears"))["at"].to_numpy()
    message = bool(((own_failures >= first) & (own_failures <= first + FOLLOWED)).any())
    ahead = truth.filter(pl.col("index").is_between(first, first + FOLLOWED))
    finding = bool(_own(findings, alert)["at"].is_between(first, first + FOLLOWED).any())
    now = truth.row(by_predicate=pl.col("index") == first, named=True)
    low = alert["diagnosis"] == "HX_LOW_MARGIN"
    soon = low and bool(((own_failures > first) & (own_failures <= first + BEFORE)).any())
    own = now[f"at_{component}"] or soon
    cause = own or now["ice"] or any(now[f"at_{c}"] for c in COMPONENTS)
    early = component == "HX" and now["loss"] < WORN["HX"] and not soon
    return Marks(message, message or finding or bool(ahead[f"fault_{component}"].any()), own, cause, early)


def _own(rows: pl.DataFrame, alert: dict) -> pl.DataFrame:
    """Select the rows of an alert's pack and component."""
    return rows.filter(tail=alert["tail"], pack=alert["pack"], component=alert["component"])


def _failures(events: pl.DataFrame) -> pl.DataFrame:
    """Messages of parts that wear and faults of doors and sensors: when the alert may begin, and must have come."""
    wears = pl.col("component").is_in(["HX", "CC"])
    ends = pl.when(wears).then("message_index").otherwise(pl.col("removal_index").fill_null(10**9) + 3)
    begins = pl.when(wears).then(pl.col("installed_index").fill_null(0)).otherwise("onset_index")
    rows = events.select(*PACK, "component", wears=wears, begins=begins, at=ends)
    return rows.filter(pl.col("component").is_in(list(COMPONENTS))).drop_nulls(["begins", "at"])


def _alerted(failure: dict, alerts: pl.DataFrame) -> float | None:
    """Flights from the first alert that counts to the failure, of a door or sensor from its onset; None if missed."""
    begins = failure["begins"]
    at = failure["at"]
    last_look = at - BEFORE if failure["wears"] else begins
    still_open = pl.col("closed").is_null() | (pl.col("closed") > last_look)
    own = _own(alerts, failure).filter(pl.col("raised").is_between(begins, at, closed="left") & still_open)
    raised = own["raised"].min()
    return None if raised is None else float(at - raised if failure["wears"] else raised - begins)


def _findings(maintenance: pl.DataFrame, truth: pl.DataFrame) -> pl.DataFrame:
    """Confirmed findings with the pack's first flight on or after their day."""
    flights = truth.select(*PACK, "index", day=pl.col("departed_at").dt.date()).sort("day")
    confirmed = maintenance.filter(pl.col("finding").is_in(CONFIRMED)).sort("done_on")
    rows = confirmed.join_asof(
        flights, left_on="done_on", right_on="day", by=PACK, strategy="forward", check_sortedness=False
    )
    return rows.select(*PACK, "component", at="index").drop_nulls()


def figures_of(scores: Tally, component: str) -> dict[str, float]:
    """Compute the figures of one component's alerts; NaN where there is none."""
    own = scores.alerts.filter(component=component)
    failures = scores.failures.filter(component=component)
    lead = failures["lead"].drop_nulls().to_numpy()
    per = 1000.0 / scores.flights
    return {
        "failures": failures.height,
        "alerted": lead.size / failures.height if failures.height else np.nan,
        "lead or delay, median": float(np.median(lead)) if lead.size else np.nan,
        "alerts": own.height,
        "in 1,000 flights": own.height * per,
        "right within 200": _mean(own["right"]),
        "message within 200": _mean(own["by_message"]) if component in WORN else np.nan,
        "without own cause in 1,000": float((~own["own"]).sum()) * per,
        "without any cause in 1,000": float((~own["any_cause"]).sum()) * per,
    }


def overall(scores: Tally) -> dict[str, float]:
    """Figures over all components, and of the exchanger's failures."""
    exchanger = figures_of(scores, "HX")
    per = 1000.0 / scores.flights
    explained = scores.alerts.filter("any_cause")
    return {
        "alerted": exchanger["alerted"],
        "lead": exchanger["lead or delay, median"],
        "early": float(scores.alerts["early"].sum()) * per,
        "false": float((~scores.alerts["any_cause"]).sum()) * per,
        "diagnosis": _mean(explained["own"]),
    }


def _mean(flags: pl.Series) -> float:
    return float(flags.cast(pl.Float64).mean() or 0.0) if len(flags) else np.nan


def by_component(scores: Tally) -> str:
    """Return a table with a row per component."""
    rows = {words: figures_of(scores, component) for component, words in COMPONENTS.items()}
    lines = [["component", *next(iter(rows.values()))]]
    return markdown([*lines, *([words, *map(_cell, row.values())] for words, row in rows.items())])


def curves(fleets: list[Frames]) -> str:
    """Precision and recall of a component's alerts with one limit of its rules moved; the limit in service in bold."""
    lines = [["diagnosis", "limit at", "right within 200", "alerted", "in 1,000 flights"]]
    for settings in zip(*map(_at_limits, fleets), strict=True):
        diagnosis, value, in_service, _ = settings[0]
        figures = figures_of(together([scores for *_, scores in settings]), GROUP[diagnosis])
        at = f"**{value}**" if in_service else f"{value}"
        names = ("right within 200", "alerted", "in 1,000 flights")
        lines.append([diagnosis, at, *(_cell(figures[name]) for name in names)])
    return markdown(lines)


def _at_limits(fleet: Frames) -> Iterator[tuple[str, float, bool, Tally]]:
    for trial in trials(fleet["features"], fleet["maintenance"]):
        yield trial.diagnosis, trial.value, trial.in_service, tally(fleet, trial.alerts)


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3g}"


def confusion(fleets: list[Frames]) -> str:
    """Alerts by diagnosis and true cause; a door or sensor fault counts before wear, a clog before fouling."""
    rows = []
    for fleet in fleets:
        rows_of_alerts = place_alerts(fleet["alerts"], fleet["truth"])
        at = rows_of_alerts.join(
            causes(fleet["truth"]), left_on=[*PACK, "raised"], right_on=[*PACK, "index"], validate="m:1"
        )
        there = (
            pl.when("at_RAM_DOOR").then(pl.lit("door"))
            .when("at_SENSOR").then(pl.lit("sensor"))
            .when("clog").then(pl.lit("clog"))
            .when(pl.col("at_HX") & (pl.col("diagnosis") != "CC_DEGRADED")).then(pl.lit("fouling"))
            .when("at_CC").then(pl.lit("compressor"))
            .when("at_HX").then(pl.lit("fouling"))
            .otherwise(pl.lit("nothing"))
        )  # fmt: skip
        rows.append(at.select("diagnosis", there=there))
    counted = pl.concat(rows).group_by("diagnosis", "there").len()
    columns = ("fouling", "clog", "compressor", "door", "sensor", "nothing")
    lines = [["diagnosis \\ there", *columns]]
    for diagnosis in GROUP:
        own = dict(counted.filter(diagnosis=diagnosis).select("there", "len").iter_rows())
        lines.append([diagnosis, *(str(own.get(c, 0)) for c in columns)])
    return markdown(lines)
