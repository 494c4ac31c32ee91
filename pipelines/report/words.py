"""Numbers and cases as the night shift says them."""

from collections.abc import Mapping
from typing import Any

from hdt_core.components import components
from hdt_core.flight.admission import SECOND_LEVEL
from hdt_core.flight.legs import REASONS as FIRST_LEVEL
from hdt_core.health.diagnoses import DIAGNOSES
from hdt_core.prognosis.model import HORIZON

Row = Mapping[str, Any]
URGENCY = {"act": "Act now", "plan": "Plan", "unknown": "Not known", "none": "No action"}
REASONS = {**FIRST_LEVEL, **SECOND_LEVEL}
PARTS = {**{c.code: c.name for c in components().values()}, "RAM_DOOR": "ram air door", "SENSOR": "sensor"}
SIDES = {1: "left", 2: "right"}
WEARS = {c.code: (c.lost, int(c.warn_loss < 0.1)) for c in components().values()}
"""Components that wear: what they lose, and the digits that its percentage is told with."""
NAMES = {**{c.diagnosis: f"{c.name} worn" for c in components().values()}, **{c: d.name for c, d in DIAGNOSES.items()}}
"""Diagnoses as the night shift says them."""


def pack_name(row: Row) -> str:
    """`LX-AAC pack 2 (right)`."""
    side = SIDES.get(row["pack"])
    return f"{row['tail']} pack {row['pack']}" + (f" ({side})" if side else "")


def unit_name(row: Row) -> str:
    """`LX-AAC hydraulic oil cooler 2`."""
    return f"{row['tail']} {row['name']} {row['pack']}"


def unit_key(row: Row) -> tuple[Any, ...]:
    """Operator, tail and pack."""
    return row["operator"], row["tail"], row["pack"]


def found_by(row: Row, diagnoses: str | None) -> str:
    """What the page's search finds a row or a card by."""
    urgency = URGENCY.get(row.get("urgency", ""), "")
    said = f"{diagnoses} {diagnosis(diagnoses)}" if diagnoses else ""
    return f"{row['operator']} {pack_name(row)} {said} {urgency}".lower()


def percent(value: float | None, digits: int = 0) -> str:
    """A share in percent; a dash where there is none."""
    return "\N{EN DASH}" if value is None else f"{100 * value:.{digits}f} %".replace("-", "\N{MINUS SIGN}")


def chance(value: float | None) -> str:
    """A probability; one in hundreds is not told from nothing."""
    if value is None:
        return "\N{EN DASH}"
    return "< 1 %" if value < 0.01 else "> 99 %" if value > 0.99 else percent(value)


def loss(row: Row) -> str:
    """Conductance lost, with its standard deviation."""
    return with_sd(row["hx_fouling"], row["hx_fouling_sd"])


def with_sd(value: float | None, sd: float | None, digits: int = 0) -> str:
    """A share in percent with its standard deviation: `34 ± 1 %`."""
    if value is None:
        return "not known"
    return percent(value, digits) if sd is None else f"{percent(value, digits)[:-2]} ± {100 * sd:.{digits}f} %"


def alert_state(alert: Row, moment: str) -> list[tuple[str, str]]:
    """What an alert's component had lost, and what was expected of it, at `raised` or `now`: name and value.

    Nothing for doors and sensors, which lose nothing that is measured.
    """
    if alert["component"] not in WEARS:
        return []
    lost, digits = WEARS[alert["component"]]
    outlook = {k: alert[f"{moment}_{k}"] for k in ("rul_flights", "rul_low", "rul_high", "p_event_50")}
    return [
        (lost, with_sd(alert[f"{moment}_loss"], alert[f"{moment}_loss_sd"], digits)),
        ("Flights left (90 %)", flights_left(outlook)),
        ("Message in 50 flights", chance(outlook["p_event_50"])),
    ]


def flights_left(row: Row) -> str:
    """Flights left with the 90 % interval, or only what they surely exceed where no event is near.

    300 stands for 300 or more: nobody looks further.
    """
    rul, low, high, p = (row[k] for k in ("rul_flights", "rul_low", "rul_high", "p_event_50"))
    if rul is None:
        return "not known"
    if low is None or high is None:
        return f"about {rul:.0f}"
    if rul >= HORIZON or (p is not None and p < 0.05):
        return f"more than {low:.0f}"
    return f"{rul:.0f} ({low:.0f} to {high:.0f}{' or more' if high >= HORIZON else ''})"


def diagnosis(code: str) -> str:
    """A diagnosis code, or several with commas between, in words."""
    return ", ".join(NAMES.get(c, c) for c in map(str.strip, code.split(",")))


def day(value: Any) -> str:
    """`2024-06-17`."""
    return "\N{EN DASH}" if value is None else f"{value:%Y-%m-%d}"


def clock(value: Any) -> str:
    """`2024-06-17 09:29 UTC`."""
    return "\N{EN DASH}" if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def count(n: int, noun: str) -> str:
    """`1 pack`, `3 packs`."""
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def tidy(sentence: str) -> str:
    """Evidence as typed by a program, with the signs a reader expects."""
    return sentence.replace("+-", "±")


def finding(evidence: str) -> str:
    """Evidence up to its witnesses: for where alternatives and cost are told beside it already."""
    return tidy(evidence).partition(" Else:")[0]
