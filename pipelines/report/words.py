"""Labels, numbers and sentences of report, digest and terminal. Every interval is one of 90 %."""

import math
import re
from collections.abc import Iterable, Mapping
from datetime import timedelta
from textwrap import fill
from typing import Any

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.components import components, recorded_components
from hdt_core.flight.admission import SECOND_LEVEL
from hdt_core.flight.component_legs import REASONS as UNIT_REASONS
from hdt_core.flight.legs import REASONS as FIRST_LEVEL
from hdt_core.prognosis.model import HORIZON
from hdt_core.robust import Z_90
from pipelines.words import _, format_count, number, several

Row = Mapping[str, Any]
URGENCY = {"act": "Act now", "plan": "Plan", "none": "No action", "unknown": "Not known"}
"""Labels of urgency, in the order of every output."""
NO_ROWS = {"NO_ROWS": "the flights hold no row of this pack"}
REASONS = {**FIRST_LEVEL, **SECOND_LEVEL, **NO_ROWS}
PARTS = {**{c.code: c.name for c in components().values()}, "RAM_DOOR": "ram air door", "SENSOR": "sensor"}
DECLARED = {c.code for c in recorded_components().values()}
SIDES = {1: "left", 2: "right"}
WEARS = {c.code: (c.lost, int(c.warn_loss < 0.1)) for c in components().values()}
"""Components that wear: name of the loss, and decimals of its percentage."""
NAMES = {**{c.diagnosis: f"{c.name} worn" for c in components().values()}, **{c: d.name for c, d in DIAGNOSES.items()}}
"""Labels of diagnoses."""
THRESHOLDS = {
    "fouling": ("conductance lost above", "%"),
    "clog": ("lost within three flights above", "%"),
    "passage": ("chance of the message within 300 flights above", "%"),
    "compressor": ("efficiency lost above", "%"),
    "peg_k": ("outlet above its target by", "K"),
}
"""Quantity and unit of each alert limit."""
FEW = 10
"""Cases with an outcome below which a hit rate is marked as based on few; also the packs that one line names."""
FEWEST = 3
"""Other units that came to a loss below which nothing is written of them."""
NEAR = 0.05
"""Chance of a message within 50 flights below which flights left are given as a bound, as in `unit_rows`."""
DASH = "\N{EN DASH}"
# control characters and those that change the direction of text: a name must not reorder its sentence
_HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f\u200e\u200f\u202a-\u202e\u2066-\u2069\ufffe\uffff]")


def pack_name(row: Row) -> str:
    """Name a pack, such as `LX-AAC pack 2 (right)`."""
    name = _("{tail} pack {pack}", tail=row["tail"], pack=row["pack"])
    if row["pack"] not in SIDES:
        return name
    side = _(SIDES[row["pack"]])
    return f"{name} ({side})"


def unit_name(row: Row) -> str:
    """Name a declared component's unit, such as `LX-AAC hydraulic oil cooler 2`; of anything else, the pack."""
    part = row.get("component")
    name = row.get("name") or (PARTS[part] if part in DECLARED else None)
    if not name:
        return pack_name(row)
    translated = _(name)
    return f"{row['tail']} {translated} {row['pack']}"


def unit_key(row: Row) -> tuple[Any, ...]:
    """Return operator, tail and pack."""
    return row["operator"], row["tail"], row["pack"]


def urgency(row: Row) -> str:
    """Label the urgency of a row."""
    return _(URGENCY[row["urgency"]])


def unknown(rows: Iterable[Row]) -> list[str]:
    """Write a line for all packs, or units, that lack an estimate for the same reason."""
    same: dict[str, list[Row]] = {}
    for row in rows:
        if row["urgency"] == "unknown":
            same.setdefault(_missing(row), []).append(row)
    return [_unknown(own, missing) for missing, own in same.items()]


def _unknown(rows: list[Row], missing: str) -> str:
    names = list(map(unit_name, rows))
    more = several(" and {n} more", " and {n} more", len(names) - FEW) if len(names) > FEW else ""
    since = min((row["missing_since"] for row in rows if row["missing_since"] is not None), default=None)
    return _(
        "Not known: {packs}{more}. No estimate since {day}{missing}.",
        packs=", ".join(names[:FEW]),
        more=more,
        day=day(since),
        missing=missing,
    )


def not_seen(row: Row) -> str:
    """Format since when no flight moved the estimate, and why; empty where one did."""
    if row.get("missing_since") is None:
        return ""
    return _("no estimate since {day}{missing}", day=day(row["missing_since"]), missing=_missing(row))


def _missing(row: Row) -> str:
    """State why there is no estimate, as far as the flights show it."""
    texts = UNIT_REASONS if row["component"] else REASONS
    columns = row.get("missing_columns")
    reason = texts.get(row["missing_reason"] or "")
    why = [_(reason)] if reason else []
    return "".join(f"; {x}" for x in [*why, *([_("without values: {columns}", columns=columns)] if columns else [])])


def search_text(row: Row, diagnoses: str | None = None) -> str:
    """Return the text by which the page's search finds a row or a card."""
    labels = f"{diagnoses} {diagnosis(diagnoses)}" if diagnoses else ""
    return f"{row['operator']} {unit_name(row)} {labels} {urgency(row) if row.get('urgency') else ''}".lower()


def percent(value: float | None, digits: int = 0) -> str:
    """Format a share in percent; a dash for None."""
    return DASH if value is None else f"{number(100 * value, digits)} %"


def chance(value: float | None) -> str:
    """Format a probability; below 1 % and above 99 % without further digits."""
    if value is None:
        return DASH
    return "< 1 %" if value < 0.01 else "> 99 %" if value > 0.99 else percent(value)


def chance_by(row: Row) -> str:
    """Format the chance of a message with its day: `67 % by 2024-07-07`."""
    until = " ".join(filter(None, (row["check_name"], day(row["until_on"]))))
    text = chance(row["chance"])
    if row["chance"] is None:
        return text
    if row["chance_kind"] == "by":
        return _("{chance} by {until}", chance=text, until=until)
    if row["chance_kind"] == "at_least":
        return _("more than {chance} by {until}", chance=text, until=until)
    return _("{chance} in 50 flights", chance=text)


STATES = {
    "acknowledged": "acknowledged", "muted": "muted until {day}", "worsened": "muted, now worse",
    "confirmed": "confirmed, not repaired yet",
}  # fmt: skip
"""Labels of the states of the view `cases`; a new case has none."""


def case_state(row: Row) -> str:
    """Format the state of a case and its owner: `acknowledged, with Ada`; empty of a new one."""
    label = STATES.get(row["case_state"] or "")
    state = _(label, day=last_day(row["muted_until"])) if label else ""
    owner = _("with {who}", who=row["owner"]) if row["owner"] else ""
    return ", ".join(filter(None, (state, owner)))


def message_on_record(row: Row) -> str:
    """Format the message that nothing has answered: `message raised on 3 of the last 10 flights since 2024-06-09`.

    Empty where there is none.
    """
    if row.get("message_at") is None:
        return ""
    n = row["message_flights"]
    flown = row["message_flown"]
    since = day(row["message_at"])
    if n == 1:
        return _("message raised on {day}, not answered", day=since)
    if n >= flown:
        return _("message raised on each of the last {n} flights since {day}", n=n, day=since)
    return _("message raised on {n} of the last {flown} flights since {day}", n=n, flown=flown, day=since)


def switched_off(row: Row) -> str:
    """Format since when a pack is switched off; empty where it is not."""
    if row.get("off_since") is None:
        return ""
    return _("switched off since {day}", day=day(row["off_since"]))


def share(value: float | None, sd: float | None, digits: int = 0) -> str:
    """Format a share in percent with its interval: `34 % (32 to 36)`."""
    if value is None:
        return _("not known")
    return percent(value, digits) if sd is None else f"{percent(value, digits)} ({span(value, sd, digits, 100.0)})"


def span(value: float, sd: float, digits: int, scale: float = 1.0) -> str:
    """Format the interval of an estimate: `32 to 36`."""
    low, high = (number(scale * (value + side * Z_90 * sd), digits) for side in (-1, 1))
    return _("{low} to {high}", low=low, high=high)


def alert_state(alert: Row, moment: str) -> list[tuple[str, str]]:
    """Return names and values of an alert's loss and forecast at `raised` or `now`.

    Empty for doors and sensors, which have no measured loss.
    """
    if alert["component"] not in WEARS:
        return []
    loss_name, digits = WEARS[alert["component"]]
    columns = ("rul_flights", "rul_low", "rul_high", "p_event_50", "came_at", "came_flights_ago")
    outlook = {k: alert.get(f"{moment}_{k}") for k in columns}
    return [
        (_(loss_name), share(alert[f"{moment}_loss"], alert[f"{moment}_loss_sd"], digits)),
        (_("Flights left (90 %)"), flights_left(outlook)),
        (_("Message in 50 flights"), chance(outlook["p_event_50"])),
    ]


def flights_left(row: Row) -> str:
    """Format flights left with the 90 % interval, or only its lower end where no event is near.

    300 stands for 300 or more, the forecast's horizon. Of a message that has come its day and how many flights ago.
    """
    if row.get("came_at") is not None:
        return several(
            "none since {day}, {n} flight ago",
            "none since {day}, {n} flights ago",
            row["came_flights_ago"],
            day=day(row["came_at"]),
        )
    rul, low, high, p = (row[k] for k in ("rul_flights", "rul_low", "rul_high", "p_event_50"))
    if rul is None:
        return _("not known")
    if low is None or high is None:
        return _("about {n}", n=number(rul))
    if rul >= HORIZON or (p is not None and p < NEAR):
        return _("more than {n}", n=number(low))
    ends = {"low": number(low), "high": number(high)}
    interval = _("{low} to {high} or more", **ends) if high >= HORIZON else _("{low} to {high}", **ends)
    return f"{number(rul)} ({interval})"


def reference(row: Row | None) -> str:
    """Format what became of other units at this loss, a row of `reference_classes`; empty where too few came to it."""
    if row is None or row["n_units"] < FEWEST:
        return ""
    n_replaced = row["n_units"] - row["n_messages"] - row["n_flying"]
    counts = {k: format_count(row[k]) for k in ("n_messages", "n_units", "n_flying")}
    text = _(
        "Of {n_units} other units at {loss} lost, {n_messages} had the message", loss=percent(row["loss"]), **counts
    )
    if row["n_messages"]:
        text += _(" within {n} flights", n=number(row["flights_to_message_most"]))
    if n_replaced:
        text += _(", {n} replaced without it", n=format_count(n_replaced))
    if row["n_flying"]:
        text += _(", {n_flying} still flying", **counts)
    if row["flights_to_message_median"] is not None:
        text += _("; by estimate half come to it within {n}", n=number(row["flights_to_message_median"]))
    return text + "." + (" " + _("That disagrees with the forecast.") if row["disagrees"] else "")


def work_done(row: Row) -> str:
    """Write the work since the last flight: `replaced 2024-07-01, no flight since`; nothing where there was none."""
    if not row["work_action"]:
        return ""
    work = row["work_action"].lower()
    return _("{work} {day}, no flight since", work=_(work), day=day(row["work_on"]))


def diagnosis(code: str) -> str:
    """Label a diagnosis code, or several separated by commas."""
    return ", ".join(_(NAMES.get(c, c)) for c in map(str.strip, code.split(",")))


def hit_rate(row: Row | None) -> str:
    """Format how often alerts of a kind were right: `3 of 4 right (75 %, 37 to 94), 2 by the message; 2 still open`."""
    if row is None or not row["n_judged"]:
        return _("no case has an outcome yet")
    share_right = _(
        "{right} of {judged} right ({share}, {low} to {high}), {by_message} by the message",
        right=format_count(row["n_right"]),
        judged=format_count(row["n_judged"]),
        share=percent(row["hit_rate"]),
        low=number(100 * row["hit_rate_low"]),
        high=number(100 * row["hit_rate_high"]),
        by_message=format_count(row["n_message"]),
    )
    n_open = several("; {n} still open", "; {n} still open", row["n_open"]) if row["n_open"] else ""
    few = _("; few cases") if row["n_judged"] < FEW else ""
    return share_right + n_open + few


def day(value: Any) -> str:
    """Format a day: `2024-06-17`."""
    return DASH if value is None else f"{value:%Y-%m-%d}"


def last_day(moment: Any) -> str:
    """Format the last day before a moment: what counts to the end of a day ends at the next midnight."""
    return DASH if moment is None else day(moment - timedelta(microseconds=1))


def clock(value: Any) -> str:
    """Format a time: `2024-06-17 09:29 UTC`."""
    return DASH if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def figures(value: float | None, digits: int = 4) -> str:
    """Format to significant digits, without an exponent between 1e-4 and 1e6."""
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    return number(value, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def visible(text: str) -> str:
    """Replace hidden characters by a visible one."""
    return _HIDDEN.sub("\ufffd", text)


def unbroken(text: str) -> str:
    """Keep numbers and their percent signs on one line."""
    return text.replace(" %", "\N{NO-BREAK SPACE}%")


def wrap(text: str, width: int, indent: int) -> str:
    """Break a text into indented lines, none of them before a percent sign."""
    margin = " " * indent
    lines = fill(unbroken(text), width, initial_indent=margin, subsequent_indent=margin, break_on_hyphens=False)
    return lines.replace(unbroken(" %"), " %")
