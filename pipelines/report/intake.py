"""What arrived, what did not, and what of the rest could teach the model."""

from typing import Any

import polars as pl

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.words import _

MONTHS = 12


def gaps(facts: Facts) -> dict[str, list[dict[str, Any]]]:
    """Aircraft that fell silent, and flights that never came, by aircraft."""
    by = ["operator", "tail"]
    missing = facts["gaps"].filter(gap="missing_leg").group_by(by, maintain_order=True)
    legs = missing.agg(pl.col("n_flights").sum(), pl.col("after_flight_id").first())
    return {
        "silent": facts["gaps"].filter(pl.col("gap") != "missing_leg").to_dicts(),
        "missing": legs.sort("n_flights", *by, descending=[True, False, False]).to_dicts(),
    }


def filter_yield(facts: Facts) -> dict[str, Any]:
    """Share of legs fit to calibrate from, by operator, and by aircraft and month; and why the others were not."""
    rows = facts["filter_yield"]
    total = rows.group_by("operator").agg(pl.col("n_admitted", "n_legs").sum()).sort("operator")
    of = {(r["operator"], r["tail"], r["month"]): r for r in rows.to_dicts()}
    return {
        "whole": "; ".join(
            _(
                "{operator} {share} of {n} legs",
                operator=r["operator"],
                share=words.percent(r["n_admitted"] / r["n_legs"]),
                n=words.count(r["n_legs"]),
            )
            for r in total.to_dicts()
        ),
        "months": rows["month"].unique().sort().to_list()[-MONTHS:],
        "aircraft": rows.select("operator", "tail").unique().sort("operator", "tail").rows(),
        "of": of,
        "why": ", ".join(
            f"{_(words.REASONS.get(r['reason'], r['reason']))} ({words.count(r['legs'])})"
            for r in facts["reasons"].to_dicts()
        ),
    }
