"""What arrived, what did not, what was kept aside, and what of the rest could teach the model."""

from typing import Any

import polars as pl

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.html import Html, join, tag
from pipelines.report.tables import Cell, plain, table

MONTHS = 12


def gaps(facts: Facts) -> Html:
    """Flights that never came and aircraft that fell silent."""
    rows = facts["gaps"]
    if not rows.height:
        return tag("p", "No gap: every leg number of every day has arrived.", class_="empty")
    silent = rows.filter(pl.col("gap") != "missing_leg").to_dicts()
    quiet = table(("Aircraft", "Silent from", "Until", "Days"), map(_silence, silent))
    by = ["operator", "tail"]
    legs = rows.filter(gap="missing_leg").group_by(by, maintain_order=True).agg(
        pl.col("n_flights").sum(), pl.col("after_flight_id").first()
    )  # fmt: skip
    legs = legs.sort("n_flights", *by, descending=[True, False, False])
    missing = table(
        ("Aircraft", "Legs that never arrived", "The last of them after"),
        [plain(g["tail"], g["n_flights"], g["after_flight_id"]) for g in legs.to_dicts()],
    )
    return join(quiet if silent else tag("p", "No aircraft fell silent."), missing if legs.height else None)


def _silence(g: dict[str, Any]) -> list[Cell]:
    if g["gap"] == "never_heard":
        return plain(g["tail"], "in the fleet list", "never heard", "")
    until = "still silent" if g["gap"] == "silent_now" else words.clock(g["until_at"])
    return plain(g["tail"], words.clock(g["from_at"]), until, f"{g['silent_days']:.1f}")


def quarantine(facts: Facts) -> Html:
    """Where the delivered rows went, and why some were kept aside."""
    d = facts["deliveries"].row(0, named=True)
    says = (
        f"{words.count(d['delivered'], 'row')} delivered in {words.count(d['files'], 'file')}: {d['loaded']:,} loaded, "
        f"{d['quarantined']:,} kept aside, {d['duplicate']:,} delivered twice."
    )
    rows = facts["quarantine"].to_dicts()
    if not rows:
        return tag("p", says, " Nothing is in quarantine.")
    names = ("Reason", "Of a", "Entries", "Rows kept out", "Files", "For instance")
    return join(tag("p", says), table(names, map(_kept_aside, rows)))


def _kept_aside(q: dict[str, Any]) -> list[Cell]:
    row = "" if q["example_row"] is None else f", row {q['example_row']}"
    example = f"{q['example_file']}{row}. {q['example'] or ''}"
    reason = q["reason"].replace("_", " ")
    return plain(reason, q["scope"], f"{q['entries']:,}", f"{q['n_rows'] or 0:,}", f"{q['files']:,}", example)


def filter_yield(facts: Facts) -> Html:
    """Share of legs fit to calibrate from, by operator, and by aircraft and month."""
    rows = facts["filter_yield"]
    if not rows.height:
        return tag("p", "No leg has been judged yet.", class_="empty")
    months = rows["month"].unique().sort().to_list()[-MONTHS:]
    by = ["operator", "tail"]
    of = {(r["operator"], r["tail"], r["month"]): r for r in rows.to_dicts()}
    aircraft = rows.select(by).unique().sort(by).rows()
    body = [[(o, o), (t, t), *(_share(of.get((o, t, m))) for m in months)] for o, t in aircraft]
    months_of = table(("Operator", "Aircraft", *(f"{m:%b %Y}" for m in months)), body)
    return join(tag("p", _whole(rows)), months_of, _why_not(facts["reasons"].to_dicts()))


def _whole(rows: pl.DataFrame) -> str:
    total = rows.group_by("operator").agg(pl.col("n_admitted", "n_legs").sum()).sort("operator").to_dicts()
    said = (f"{r['operator']} {words.percent(r['n_admitted'] / r['n_legs'])} of {r['n_legs']:,} legs" for r in total)
    return f"Fit to calibrate from: {'; '.join(said)}."


def _why_not(reasons: list[dict[str, Any]]) -> Html | None:
    if not reasons:
        return None
    why = ", ".join(f"{words.REASONS.get(r['reason'], r['reason'])} ({r['legs']:,})" for r in reasons)
    watched = "A worn pack is still watched; it only teaches the model nothing of how it was built."
    return tag("p", f"Why the others were not: {why}. {watched}", class_="small")


def _share(row: dict[str, Any] | None) -> Cell:
    if row is None:
        return "", None
    share = row["admitted_share"]
    bar = tag("span", "", class_="bar", style=f"width:{round(100 * share)}%")
    return tag("span", bar, f"{words.percent(share)} of {row['n_legs']}", class_="share"), share
