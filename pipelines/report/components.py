"""Units of declared components: who needs attention, and how each has worn."""

from typing import Any

from pipelines.report import svg, words
from pipelines.report.facts import Facts
from pipelines.report.html import Html, anchor, join, tag
from pipelines.report.tables import Cell, table
from pipelines.report.tracks import Z_90, seconds, thin

_COLUMNS = (
    "Place", "Operator", "Unit", "Urgency", "Lost", "Flights left (90 %)", "Failure in 50 flights", "Open alerts",
    "Last flight",
)  # fmt: skip


def components(facts: Facts) -> Html | None:
    """A ranking of the units and a chart for each; nothing where no component is declared beside the pack's."""
    rows = facts["components"].to_dicts()
    if not rows:
        return None
    shown = table(_COLUMNS, map(_ranked, rows), sortable=True, finds=[_found_by(r) for r in rows])
    return join(shown, tag("div", *(_card(facts, r) for r in rows), class_="cards"))


def _found_by(r: dict[str, Any]) -> str:
    return f"{r['operator']} {words.unit_name(r)} {r['diagnoses'] or ''} {words.URGENCY[r['urgency']]}".lower()


def _anchor(r: dict[str, Any]) -> str:
    return anchor("unit", r["component"], *words.unit_key(r))


def _urgency(r: dict[str, Any]) -> Html:
    return tag("span", words.URGENCY[r["urgency"]], class_=f"tag {r['urgency']}")


def _ranked(r: dict[str, Any]) -> list[Cell]:
    diagnoses = words.diagnosis(r["diagnoses"]) if r["diagnoses"] else ""
    last = words.day(r["last_departed_at"])
    return [
        (r["place"], r["place"]),
        (r["operator"], r["operator"]),
        (tag("a", words.unit_name(r), href=f"#{_anchor(r)}"), words.unit_name(r)),
        (_urgency(r), list(words.URGENCY).index(r["urgency"])),
        (f"{r['lost']} {words.with_sd(r['loss'], r['loss_sd'])}", r["loss"]),
        (words.flights_left(r), r["rul_flights"]),
        (words.chance(r["p_event_50"]), r["p_event_50"]),
        (diagnoses, diagnoses or None),
        (last, last),
    ]


def _card(facts: Facts, r: dict[str, Any]) -> Html:
    return tag(
        "article",
        tag("h3", words.unit_name(r), " ", _urgency(r)),
        tag("p", f"{r['lost']} {words.with_sd(r['loss'], r['loss_sd'])}; flights left {words.flights_left(r)}."),
        _chart(facts, r),
        id=_anchor(r),
        class_="card",
        data_find=_found_by(r),
    )


def _chart(facts: Facts, r: dict[str, Any]) -> Html:
    own = thin(facts.of_pack("component_losses", *words.unit_key(r)).filter(component=r["component"]))
    if not own.height:
        return tag("p", "No estimate yet: too few steady flights.", class_="empty")
    when, loss, sd = seconds(own["departed_at"]), 100 * own["loss"], 100 * own["loss_sd"].fill_null(0.0)
    top = max(45.0, *(loss + 5).to_list())
    chart = svg.Chart((when[0], max(when[-1], when[0] + 60.0)), (-10.0, top), f"Loss of {words.unit_name(r)} over time")
    chart.band(list(zip(when, (loss - Z_90 * sd).to_list(), (loss + Z_90 * sd).to_list(), strict=True)), svg.BLUE)
    chart.line(list(zip(when, loss.to_list(), strict=True)), svg.BLUE)
    alerts = facts.of_pack("alerts", *words.unit_key(r)).filter(component=r["component"])
    for a in alerts.to_dicts():
        told = f"{words.day(a['raised_at'])}: alert, {words.diagnosis(a['diagnosis'])}"
        chart.mark(a["raised_at"].timestamp(), "alert", svg.PURPLE, told)
    return chart.svg(svg.month_ticks(when[0], max(when[-1], when[0] + 60.0), 5), "% lost")
