"""Write the report: what to do first, then the evidence, then how reliable it is."""

from collections.abc import Sequence
from datetime import timedelta
from importlib import resources
from pathlib import Path
from typing import Any

import duckdb
import polars as pl
from markupsafe import Markup

from hdt_core.alerts.alerts import Trial, trials
from hdt_core.alerts.cases import Limits
from hdt_core.health.work import settled_log
from pipelines.report import words
from pipelines.report.facts import Facts, read_facts
from pipelines.report.figures import figures
from pipelines.report.templating import policy, render
from pipelines.report.tonight import tonight_with_cards
from pipelines.storage.catalog import connect
from pipelines.storage.files import replacing
from pipelines.storage.settings import alert_limits, changed_limits
from pipelines.storage.view_headers import read_header, views
from pipelines.words import _, format_count

CLOSED_DAYS = 180  # alerts closed longer ago stand in the catalog only
MONTHS = 12


def write_report(home: Path, target: Path, units: str = "si", with_thresholds: bool = False) -> None:
    """Write the page over the catalog in `home` to `target`: same catalog, same bytes.

    It opens in a system of units, `si` or `us`, and is in the language in use. Counts at other thresholds take some
    three seconds an aircraft.
    """
    rows = thresholds(home) if with_thresholds else ()
    with replacing(target.resolve()) as temporary:
        temporary.write_text(
            page(read_facts(home), units, rows, changed_limits(home), alert_limits(home).fouling), encoding="utf-8"
        )


def page(
    facts: Facts,
    units: str = "si",
    thresholds: Sequence[dict[str, Any]] = (),
    limits: Sequence[str] = (),
    fouling_limit: float = Limits().fouling,
) -> str:
    """Render the document in `units` (of `units.SYSTEMS`), with rows of `thresholds` and the home's `limits`."""
    script = (resources.files("pipelines.report") / "page.js").read_text(encoding="utf-8")
    until = facts.until()
    return render(
        "report.html",
        title=_("Fleet health") + (f", {until:%Y-%m-%d}" if until else ""),
        dates=facts.dates,
        units=units,
        policy=policy(script),
        script=Markup(script),
        tonight=tonight_with_cards(facts, fouling_limit),
        alerts=_alerts(facts),
        thresholds=thresholds,
        limits=limits,
        gaps=_gaps(facts),
        quarantine=facts["quarantine"].to_dicts(),
        deliveries=facts["deliveries"].row(0, named=True),
        filter_yield=_filter_yield(facts),
        design=facts["design"].filter(pl.col("scope") != "tail").to_dicts(),
        figures=figures(facts),
        model_card=facts.card,
    )


def _alerts(facts: Facts) -> dict[str, Any]:
    """Return the alerts closed lately, and the number of older ones and of all."""
    rows = facts["alerts"]
    until = facts.until()
    closed = rows.filter(pl.col("closed_at").is_not_null())
    late = closed.filter(pl.col("closed_at") >= until - timedelta(days=CLOSED_DAYS)) if until else closed
    return {
        "n": rows.height,
        "closed": late.to_dicts(),
        "older": closed.height - late.height,
        "days": CLOSED_DAYS,
    }


def _gaps(facts: Facts) -> dict[str, list[dict[str, Any]]]:
    """Return silent aircraft, missing flights by aircraft, and recoveries without work in the log."""
    by = ["operator", "tail"]
    missing = facts["gaps"].filter(gap="missing_leg").group_by(by, maintain_order=True)
    legs = missing.agg(pl.col("n_flights").sum(), pl.col("after_flight_id").first())
    return {
        "silent": facts["gaps"].filter(pl.col("gap") != "missing_leg").to_dicts(),
        "unlogged": facts["unlogged"].to_dicts(),
        "missing": legs.sort("n_flights", *by, descending=[True, False, False]).to_dicts(),
    }


def _refusal(row: dict[str, Any]) -> str:
    """Word a reason why legs were not admitted, with their number."""
    reason = words.REASONS.get(row["reason"], row["reason"])
    translated = _(reason)
    return f"{translated} ({format_count(row['legs'])})"


def _filter_yield(facts: Facts) -> dict[str, Any]:
    """Return the shares of legs admitted to calibration, by operator and by month, and the other reasons."""
    rows = facts["filter_yield"]
    total = rows.group_by("operator").agg(pl.col("n_admitted", "n_legs").sum()).sort("operator")
    of = {(r["operator"], r["tail"], r["month"]): r for r in rows.to_dicts()}
    return {
        "whole": "; ".join(
            _(
                "{operator} {share} of {n} legs",
                operator=r["operator"],
                share=words.percent(r["n_admitted"] / r["n_legs"]),
                n=format_count(r["n_legs"]),
            )
            for r in total.to_dicts()
        ),
        "months": rows["month"].unique().sort().to_list()[-MONTHS:],
        "aircraft": rows.select("operator", "tail").unique().sort("operator", "tail").rows(),
        "of": of,
        "why": ", ".join(map(_refusal, facts["reasons"].to_dicts())),
    }


OUTCOME_VIEWS, ALERTS = ("alert_hit_rates", "alert_lead_times"), "tables.features_alerts"
_COUNTS = """
    select
        coalesce(any_value(n_alerts), 0) as alerts,
        coalesce(any_value(n_right), 0) as "right",
        coalesce(any_value(n_judged - n_right), 0) as false,
        coalesce(any_value(n_open), 0) as open,
        (select median(lead_flights) from alert_lead_times where diagnosis = $1) as lead_flights,
        (select count(*) from alert_lead_times where lead_flights is null and component = any_value(o.component))
            as missed
    from alert_hit_rates as o where diagnosis = $1"""
Row = dict[str, Any]


def thresholds(home: Path) -> list[Row]:
    """Return one row a diagnosis and value of its limit.

    Columns `diagnosis, limit, value, in_service, alerts, right, false, open`, `lead_flights` (median) and `missed`
    (messages of the component without an alert before them).
    """
    definitions = _definitions_over_alerts()
    inputs = {source for sql in definitions.values() for source in read_header(sql).sources} - definitions.keys()
    with connect(home) as con:
        rows = {name: con.sql(f"select * from {name}").to_arrow_table() for name in sorted(inputs)}
        stored = ("features", "raw_maintenance", "features_work")
        features, maintenance, judgements = (con.sql(f"select * from tables.{t}").pl() for t in stored)
    with duckdb.connect() as copy:
        copy.execute("set TimeZone = 'UTC'; create schema tables")
        for name, table in rows.items():
            _replace(copy, name, table)
        for sql in definitions.values():
            copy.execute(sql)
        return [_outcome(copy, t) for t in trials(features, settled_log(maintenance, judgements), alert_limits(home))]


def _outcome(con: duckdb.DuckDBPyConnection, t: Trial) -> Row:
    _replace(con, ALERTS, t.alerts.to_arrow())
    (row,) = con.sql(_COUNTS, params=[t.diagnosis]).pl().to_dicts()
    return {"diagnosis": t.diagnosis, "limit": t.limit, "value": t.value, "in_service": t.in_service, **row}


def _definitions_over_alerts() -> dict[str, str]:
    """Return the outcome views and those they read over the alerts, in order of dependence; other sources stay rows."""
    definitions = views()
    over_alerts = {ALERTS}
    needed = set(OUTCOME_VIEWS)
    sources = {name: set(read_header(sql).sources) for name, sql in definitions.items()}
    for name in definitions:
        if sources[name] & over_alerts:
            over_alerts.add(name)
    for name in reversed(definitions):
        if name in needed:
            needed |= sources[name] & over_alerts
    return {name: sql for name, sql in definitions.items() if name in needed & over_alerts}


def _replace(con: duckdb.DuckDBPyConnection, name: str, rows: Any) -> None:
    con.register("frame", rows)
    con.execute(f"create or replace table {name} as select * from frame")
    con.unregister("frame")
