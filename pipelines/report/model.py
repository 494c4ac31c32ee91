"""What the models say of themselves: how the fleet was built, and how far the prognosis can be trusted."""

from typing import Any

import polars as pl

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.html import Html, join, tag
from pipelines.report.tables import Cell, number, plain, table


def design(facts: Facts) -> Html:
    """Design parameters of fleet and operators; those of single sensors stay in the catalog."""
    rows = facts["design"].filter(pl.col("scope") != "tail").to_dicts()
    if not rows:
        return tag("p", "Not calibrated yet: too few nominal flights.", class_="empty")
    names = ("Part", "Parameter", "Value", "± sd", "Unit", "Flights", "Decided by", "Scope")
    return join(tag("p", f"Model in service: {rows[0]['dsm_version']}."), table(names, map(_parameter, rows)))


def _parameter(r: dict[str, Any]) -> list[Cell]:
    return plain(
        words.PARTS.get(r["component"], r["component"]),
        r["parameter"],
        number(r["value"]),
        number(r["sd"], 2),
        r["unit"],
        f"{r['n_flights']:,}",
        "data" if r["identifiable"] else "data and prior",
        r["operator"] or r["scope"],
    )


def model_card(facts: Facts) -> Html:
    """What the prognosis is made of and how well it did on aircraft it had not seen."""
    if not facts.card:
        return tag("p", "No prognostic model has been trained yet.", class_="empty")
    return tag("dl", *(join(tag("dt", _name(k)), tag("dd", _value(v))) for k, v in facts.card.items()))


def _name(key: str) -> str:
    return key.replace("_", " ").capitalize() if key.islower() else key


def _value(v: Any) -> Any:
    if isinstance(v, dict):
        if all(isinstance(x, int | float | str | None) for x in v.values()):
            return "; ".join(f"{k.replace('_', ' ')} {_value(x)}" for k, x in v.items()) or "none"
        return tag("ul", *(tag("li", f"{k.replace('_', ' ')}: ", _value(x)) for k, x in v.items()))
    if isinstance(v, list):
        return ", ".join(str(_value(x)) for x in v)
    return number(v, 3) if isinstance(v, float) else v
