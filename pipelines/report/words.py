"""Numbers and cases as the night shift says them. Every interval is one of 90 %."""

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.components import components
from hdt_core.flight.admission import SECOND_LEVEL
from hdt_core.flight.legs import REASONS as FIRST_LEVEL
from hdt_core.prognosis.model import HORIZON
from hdt_core.robust import Z_90
from pipelines.words import _, grouped, number, several
from pipelines.words.evidence import retold

Row = Mapping[str, Any]
URGENCY = {"act": "Act now", "plan": "Plan", "none": "No action", "unknown": "Not known"}
"""In the order of every output: what is not known stands last, and says what is missing."""
REASONS = {**FIRST_LEVEL, **SECOND_LEVEL}
PARTS = {**{c.code: c.name for c in components().values()}, "RAM_DOOR": "ram air door", "SENSOR": "sensor"}
SIDES = {1: "left", 2: "right"}
WEARS = {c.code: (c.lost, int(c.warn_loss < 0.1)) for c in components().values()}
"""Components that wear: what they lose, and the digits that its percentage is told with."""
NAMES = {**{c.diagnosis: f"{c.name} worn" for c in components().values()}, **{c: d.name for c, d in DIAGNOSES.items()}}
"""Diagnoses as the night shift says them."""
THRESHOLDS = {
    "fouling": ("conductance lost above", "%"),
    "clog": ("lost within three flights above", "%"),
    "passage": ("chance of the message within 300 flights above", "%"),
    "compressor": ("efficiency lost above", "%"),
    "peg_k": ("outlet above its target by", "K"),
}
"""What the limit of each diagnosis is on, and its unit."""
FEW = 10
"""Judged cases below which a share is told to rest on few."""
DASH = "\N{EN DASH}"
# control characters and those that turn the direction of text: a name must not reorder the sentence it stands in
_HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f\u200e\u200f\u202a-\u202e\u2066-\u2069\ufffe\uffff]")


def pack_name(row: Row) -> str:
    """`LX-AAC pack 2 (right)`."""
    name = _("{tail} pack {pack}", tail=row["tail"], pack=row["pack"])
    return f"{name} ({_(SIDES[row['pack']])})" if row["pack"] in SIDES else name


def unit_name(row: Row) -> str:
    """`LX-AAC hydraulic oil cooler 2`."""
    return f"{row['tail']} {_(row['name'])} {row['pack']}"


def unit_key(row: Row) -> tuple[Any, ...]:
    """Operator, tail and pack."""
    return row["operator"], row["tail"], row["pack"]


def urgency(row: Row) -> str:
    """How urgent it is."""
    return _(URGENCY[row["urgency"]])


def unknown(rows: Iterable[Row]) -> list[str]:
    """A line for all packs, or units, that lack an estimate for the same reason."""
    same: dict[str, list[Row]] = {}
    for row in rows:
        if row["urgency"] == "unknown":
            same.setdefault(_missing(row), []).append(row)
    return [_unknown(own, missing) for missing, own in same.items()]


def _unknown(rows: list[Row], missing: str) -> str:
    names = [unit_name(row) if "name" in row else pack_name(row) for row in rows]
    more = several(" and {n} more", " and {n} more", len(names) - FEW) if len(names) > FEW else ""
    since = min((row["missing_since"] for row in rows if row["missing_since"] is not None), default=None)
    return _(
        "Not known: {packs}{more}. No estimate since {day}{missing}.",
        packs=", ".join(names[:FEW]),
        more=more,
        day=day(since),
        missing=missing,
    )


def _missing(row: Row) -> str:
    """Why there is no estimate, as far as the flights show it."""
    reason, columns = REASONS.get(row["missing_reason"] or ""), row.get("missing_columns")
    why = [_(reason)] if reason else []
    return "".join(f"; {x}" for x in [*why, *([_("without values: {columns}", columns=columns)] if columns else [])])


def found_by(row: Row, diagnoses: str | None = None) -> str:
    """What the page's search finds a row or a card by."""
    name = unit_name(row) if "name" in row else pack_name(row)
    said = f"{diagnoses} {diagnosis(diagnoses)}" if diagnoses else ""
    return f"{row['operator']} {name} {said} {urgency(row) if row.get('urgency') else ''}".lower()


def percent(value: float | None, digits: int = 0) -> str:
    """A share in percent; a dash where there is none."""
    return DASH if value is None else f"{number(100 * value, digits)} %"


def chance(value: float | None) -> str:
    """A probability; one in hundreds is not told from nothing."""
    if value is None:
        return DASH
    return "< 1 %" if value < 0.01 else "> 99 %" if value > 0.99 else percent(value)


def loss(row: Row) -> str:
    """Conductance lost, with its interval."""
    return share(row["hx_fouling"], row["hx_fouling_sd"])


def share(value: float | None, sd: float | None, digits: int = 0) -> str:
    """A share in percent with its interval: `34 % (32 to 36)`."""
    if value is None:
        return _("not known")
    return percent(value, digits) if sd is None else f"{percent(value, digits)} ({span(value, sd, digits, 100.0)})"


def span(value: float, sd: float, digits: int, scale: float = 1.0) -> str:
    """The interval about an estimate: `32 to 36`."""
    low, high = (number(scale * (value + side * Z_90 * sd), digits) for side in (-1, 1))
    return _("{low} to {high}", low=low, high=high)


def alert_state(alert: Row, moment: str) -> list[tuple[str, str]]:
    """What an alert's component had lost, and what was expected of it, at `raised` or `now`: name and value.

    Nothing for doors and sensors, which lose nothing that is measured.
    """
    if alert["component"] not in WEARS:
        return []
    lost, digits = WEARS[alert["component"]]
    outlook = {k: alert[f"{moment}_{k}"] for k in ("rul_flights", "rul_low", "rul_high", "p_event_50")}
    return [
        (_(lost), share(alert[f"{moment}_loss"], alert[f"{moment}_loss_sd"], digits)),
        (_("Flights left (90 %)"), flights_left(outlook)),
        (_("Message in 50 flights"), chance(outlook["p_event_50"])),
    ]


def flights_left(row: Row) -> str:
    """Flights left with the 90 % interval, or only what they surely exceed where no event is near.

    300 stands for 300 or more: nobody looks further.
    """
    rul, low, high, p = (row[k] for k in ("rul_flights", "rul_low", "rul_high", "p_event_50"))
    if rul is None:
        return _("not known")
    if low is None or high is None:
        return _("about {n}", n=number(rul))
    if rul >= HORIZON or (p is not None and p < 0.05):
        return _("more than {n}", n=number(low))
    ends = {"low": number(low), "high": number(high)}
    told = _("{low} to {high} or more", **ends) if high >= HORIZON else _("{low} to {high}", **ends)
    return f"{number(rul)} ({told})"


def diagnosis(code: str) -> str:
    """A diagnosis code, or several with commas between, in words."""
    return ", ".join(_(NAMES.get(c, c)) for c in map(str.strip, code.split(",")))


def hit_rate(row: Row | None) -> str:
    """How often alerts of a kind were right: `3 of 4 confirmed (75 %, 37 to 94); 2 still open. Few cases.`"""
    if row is None or not row["n_judged"]:
        return _("no case of it has been judged yet")
    told = _(
        "{right} of {judged} confirmed ({share}, {low} to {high})",
        right=count(row["n_right"]),
        judged=count(row["n_judged"]),
        share=percent(row["hit_rate"]),
        low=number(100 * row["hit_rate_low"]),
        high=number(100 * row["hit_rate_high"]),
    )
    left = several("; {n} still open", "; {n} still open", row["n_open"]) if row["n_open"] else ""
    few = _("; few cases") if row["n_judged"] < FEW else ""
    return told + left + few


def day(value: Any) -> str:
    """`2024-06-17`."""
    return DASH if value is None else f"{value:%Y-%m-%d}"


def clock(value: Any) -> str:
    """`2024-06-17 09:29 UTC`."""
    return DASH if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def figures(value: float | None, digits: int = 4) -> str:
    """Some significant digits, without an exponent where the number is of common size."""
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    return number(value, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def count(n: int) -> str:
    """A number of things, thousands apart."""
    return grouped(n)


def packs(n: int) -> str:
    """`1 pack`, `3 packs`."""
    return several("{n} pack", "{n} packs", n)


def visible(text: str) -> str:
    """Text whose hidden characters show."""
    return _HIDDEN.sub("\ufffd", text)


def tidy(sentence: str) -> str:
    """Evidence or an action in the language spoken, with the signs a reader expects."""
    return retold(sentence.replace("+-", "±"))


def plain(sentence: str) -> str:
    """Evidence or an action without the names that columns have in the catalog."""
    return re.sub(r" \((?:[a-z]+\d*_)+[a-z0-9]+\)", "", tidy(sentence))


def finding(evidence: str) -> str:
    """Evidence up to its witnesses: for where alternatives and cost are told beside it already."""
    return tidy(evidence.partition(" Else:")[0])
