"""A case in words: what moved and since when, which witnesses speak for or against it, what waiting costs."""

import math
from collections.abc import Mapping
from typing import Any

from scipy.special import ndtr

from hdt_core.alerts import phrases
from hdt_core.alerts.cases import DIAMETER_SD, FAILS_AT
from hdt_core.alerts.evidence import AGAINST, NEUTRAL, SUPPORTS, Corroboration, Evidence
from hdt_core.robust import Z_90

Facts = Mapping[str, Any]
"""What is known of a case at one moment, by name; NaN where it was not recorded."""
WORN = 0.05
"""Loss from which a unit counts as worn at all. [-]"""
PEG_SD_K = 0.33
"""Scatter, over sound flights, of the outlet where the door is widest less the outlet elsewhere. [K]"""
LEANED_ON = ("hx_out_k", "hx_in_k", "pack_flow_kg_s", "tat_k")
"""Sensors that the fouling estimate stands on."""
CONTRADICTED = "contradicted"
"""Kind of a sensor's case that an inspection of another part has raised."""
FULL_OPEN_SHARE = 0.05
"""Share of cruise with the door full open that a sound pack shows on one flight in a hundred. [-]"""
DOOR_APART, LOSS_APART, RAM_FLOW_LOST = 0.03, 0.05, 0.04
"""Differences that packs of one aircraft, and a clean duct, do not show by chance: three standard deviations. [-]"""


def exchanger_severity(facts: Facts) -> str:
    """High where little is left."""
    left = flights_left(facts)
    return "high" if facts["hx_fouling"] > 0.3 or (left is not None and left < 50) else "medium"


def sensor_severity(facts: Facts) -> str:
    """Medium for a sensor that the health estimate stands on."""
    return "medium" if facts["kind"] == CONTRADICTED or facts["sensor"] in LEANED_ON else "low"


def door_severity(facts: Facts) -> str:
    """High where the door can't move at all."""
    return "high" if facts["kind"] == "jam" else "medium"


def flights_left(facts: Facts) -> float | None:
    """Straight-line flights to the loss at which packs fail, for the severity; None where the loss doesn't grow."""
    slope = facts["hx_fouling_slope_30_per_flight"]
    return max((FAILS_AT - facts["hx_fouling"]) / slope, 0.0) if slope > 1e-5 else None


def sensor_named(facts: Facts) -> str:
    """The sensor by what it measures; of a contradiction, what to compare."""
    if facts["kind"] == CONTRADICTED:
        return phrases.COMPARE.format(day=facts["looked_on"])
    return phrases.SENSOR_NAMED.format(sensor=phrases.named(facts["sensor"]))


def within(value: float, sd: float, digits: int = 0) -> str:
    """A share in per cent with its interval of 90 %.

    Examples
    --------
    >>> within(0.34, 0.01)
    '34 % (32 to 36)'
    """
    low, high = (f"{100.0 * (value + side * Z_90 * sd):.{digits}f}" for side in (-1, 1))
    return phrases.WITHIN.format(value=f"{100.0 * value:.{digits}f}", low=low, high=high)


def _probability(p: float) -> str:
    """In words; never a certainty."""
    return phrases.ABOVE.format(value=0.99) if p > 0.99 else f"{p:.2f}"


def chance_above(value: float, limit: float, sd: float) -> str:
    """Chance that an estimate above a limit is truly above it, in words."""
    return _probability(float(ndtr((value - limit) / max(sd, 1e-6))))


def exchanger(facts: Facts, since: str) -> Evidence:
    """Fouling, gradual or sudden."""
    loss, sd = facts["hx_fouling"], facts["hx_fouling_sd"]
    slope = facts["hx_fouling_slope_30_per_flight"]
    moved = [
        phrases.UA_LOST.format(
            loss=within(loss, sd),
            sigma=f"{loss / max(sd, 1e-6):.0f}",
            limit=f"{100 * WORN:.0f}",
            since=since,
            odds=chance_above(loss, WORN, sd),
        )
    ]
    if slope > 1e-5:
        moved.append(phrases.TREND.format(points=f"{1000 * slope:.1f}"))
    if facts["gained"] > loss + 2.0 * sd:
        moved.append(phrases.RISEN.format(points=f"{100 * facts['gained']:.0f}"))
    witnesses = (_full_open(facts), _door_beside(facts), _loss_beside(facts), _ram_flow(facts, NEUTRAL))
    return Evidence("; ".join(moved), tuple(w for w in witnesses if w), phrases.EXCHANGER_ELSE, phrases.EXCHANGER_COSTS)


def clog(facts: Facts, since: str) -> Evidence:
    """A sudden clog: fouling with a jump that wear doesn't make."""
    said = exchanger(facts, since)
    moved = f"{said.moved}; " + phrases.JUMP.format(points=f"{100 * facts['jump']:.0f}")
    witnesses = (_full_open(facts), _door_beside(facts), _loss_beside(facts), _ram_flow(facts, AGAINST))
    return Evidence(moved, tuple(w for w in witnesses if w), said.otherwise, said.waiting)


def _full_open(facts: Facts) -> Corroboration:
    """A controller that asks for more ram air than the door can give."""
    share = facts["door_full_open_share"]
    if math.isnan(share):
        return Corroboration(NEUTRAL, phrases.DOOR_UNKNOWN)
    spare = share < FULL_OPEN_SHARE
    said = phrases.DOOR_SPARE if spare else phrases.DOOR_FULL
    return Corroboration(NEUTRAL if spare else SUPPORTS, said.format(share=f"{100 * share:.0f}"))


def _door_beside(facts: Facts) -> Corroboration | None:
    """The door of the pack that lost more should stand wider than the other's, on the same flight."""
    wider, more = facts["door_median_between_packs"], facts["hx_fouling_between_packs"]
    if math.isnan(wider) or not more > LOSS_APART:
        return None
    if abs(wider) <= DOOR_APART:
        return Corroboration(NEUTRAL, phrases.DOOR_ALIKE)
    points = f"{abs(100 * wider):.0f}"
    if wider > 0.0:
        return Corroboration(SUPPORTS, phrases.DOOR_WIDER.format(points=points))
    return Corroboration(AGAINST, phrases.DOOR_NARROWER.format(points=points))


def _loss_beside(facts: Facts) -> Corroboration | None:
    """What both packs of an aircraft show alike may be something they share."""
    more = facts["hx_fouling_between_packs"]
    if math.isnan(more):
        return None
    if more > LOSS_APART:
        return Corroboration(SUPPORTS, phrases.OTHER_LESS.format(points=f"{100 * more:.0f}"))
    return Corroboration(NEUTRAL, phrases.OTHER_ALIKE)


def _ram_flow(facts: Facts, otherwise: str) -> Corroboration | None:
    """Where the ram outlet is measured: a blockage starves the ram flow, a film does not."""
    lost = facts["ram_flow_loss"]
    if math.isnan(lost):
        return None
    if lost > RAM_FLOW_LOST:
        return Corroboration(SUPPORTS, phrases.FLOW_STARVED.format(share=f"{100 * lost:.0f}"))
    return Corroboration(otherwise, phrases.FLOW_CLEAN)


def margin_severity(facts: Facts) -> str:
    """High where the message is more likely than not within a hundred flights."""
    return "high" if facts["hx_passage_100"] > 0.5 else "medium"


def low_margin(facts: Facts, since: str) -> Evidence:
    """Little reserve before the message, and what took it."""
    moved = phrases.MARGIN.format(
        margin=_kelvin(facts["hx_margin_k"]),
        hot_day=_kelvin(facts["hx_margin_hot_day_k"]),
        odds=_probability(facts["hx_passage_300"]),
        since=since,
    )
    gives = {
        "design": phrases.DESIGN_GIVES, "target": phrases.TARGET_GIVES, "flow": phrases.FLOW_GIVES,
        "ambient": phrases.AIR_GIVES, "wear": phrases.WEAR_GIVES,
    }  # fmt: skip
    by = {said: facts[f"hx_margin_{name}_k"] for name, said in gives.items()}
    shares = ", ".join(said.format(k=f"{k:+.0f}") for said, k in by.items() if not math.isnan(k))
    told = [Corroboration(NEUTRAL, phrases.MARGIN_PARTS.format(parts=shares))] if shares else []
    worn = within(facts["hx_fouling"], facts["hx_fouling_sd"])
    told.append(Corroboration(NEUTRAL, phrases.NOT_WEAR_ALONE.format(loss=worn)))
    if facts["overheat_p20_k"] > 1.0:
        told.append(Corroboration(SUPPORTS, phrases.WARM_OUTLET.format(k=f"{facts['overheat_p20_k']:.0f}")))
    return Evidence(moved, (*told, _full_open(facts)), phrases.MARGIN_ELSE, phrases.MARGIN_COSTS)


def _kelvin(margin_k: float) -> str:
    """A margin as a reader sees it: how far below or above a level."""
    if math.isnan(margin_k):
        return phrases.FAR_UNKNOWN
    said = phrases.BELOW_BY if margin_k >= 0.0 else phrases.ABOVE_BY
    return said.format(k=f"{abs(margin_k):.0f}")


def compressor(facts: Facts, since: str) -> Evidence:
    """Efficiency where the exit temperature is recorded, else effective diameter."""
    loss, sd, shrunk = facts["cc_efficiency_loss"], facts["cc_efficiency_loss_sd"], facts["shrunk"]
    if not math.isnan(loss):
        moved = phrases.COMPRESSOR.format(
            loss=within(loss, sd, 1),
            sigma=f"{loss / max(sd, 1e-6):.0f}",
            since=since,
            limit=f"{100 * WORN:.0f}",
            odds=chance_above(loss, WORN, sd),
        )
        return Evidence(moved, _diameter(facts), phrases.COMPRESSOR_ELSE, phrases.COMPRESSOR_COSTS)
    smaller, sigma = f"{-100 * shrunk:.1f}", f"{-shrunk / DIAMETER_SD:.1f}"
    moved = phrases.SHRUNK.format(share=smaller, sigma=sigma, since=since)
    witness = Corroboration(NEUTRAL, phrases.NO_EFFICIENCY)
    return Evidence(moved, (witness, *_reserve(facts)), phrases.SHRUNK_ELSE, phrases.COMPRESSOR_COSTS)


def _diameter(facts: Facts) -> tuple[Corroboration, ...]:
    """Equation (5) takes the root of efficiency: a worn compressor's effective diameter shrinks by half of its loss."""
    lost, efficiency = facts["cc_diameter_loss"], facts["cc_efficiency_loss"]
    if math.isnan(lost):
        return ()
    role = SUPPORTS if lost > 0.25 * efficiency else NEUTRAL if lost > -DIAMETER_SD else AGAINST
    return (Corroboration(role, phrases.DIAMETER_LOST.format(share=f"{100 * lost:.1f}")), *_reserve(facts))


def _reserve(facts: Facts) -> tuple[Corroboration, ...]:
    """What is left before the machine cannot deliver what is asked."""
    left, hot_high = facts["cc_diameter_left"], facts["cc_diameter_left_hot_high"]
    if math.isnan(left):
        return ()
    own = phrases.DIAMETER_LEFT if left > 0.0 else phrases.TOO_SMALL
    high = phrases.LEFT_HOT_HIGH if hot_high > 0.0 else phrases.SMALL_HOT_HIGH
    return (
        Corroboration(NEUTRAL if left > 0.0 else SUPPORTS, own.format(share=f"{100 * abs(left):.0f}")),
        Corroboration(NEUTRAL, high.format(share=f"{100 * abs(hot_high):.0f}")),
    )


def door(facts: Facts, since: str) -> Evidence:
    """A jam, or travel that ends too soon."""
    stop = f"{100 * facts['stop']:.0f}"
    if facts["kind"] == "jam":
        flickers = Corroboration(SUPPORTS, phrases.FLICKERS)
        moved = phrases.JAMMED.format(stop=stop, since=since)
        return Evidence(moved, (flickers,), phrases.JAMMED_ELSE, phrases.JAMMED_COSTS)
    excess_k = facts["excess_k"]
    moved = phrases.STOPPED.format(stop=stop, since=since, k=f"{excess_k:.1f}", sigma=f"{excess_k / PEG_SD_K:.0f}")
    return Evidence(moved, (Corroboration(SUPPORTS, phrases.ON_TARGET),), phrases.STOPPED_ELSE, phrases.STOPPED_COSTS)


def sensor(facts: Facts, since: str) -> Evidence:
    """Silent, frozen, or gone from what physics ties it to."""
    if facts["kind"] == CONTRADICTED:
        return _contradicted(facts, since)
    name = phrases.named(facts["sensor"])
    if facts["kind"] == "dropout":
        moved = phrases.EMPTY.format(sensor=_upper(name), share=f"{100 * facts['share']:.0f}", since=since)
        return Evidence(moved, (), phrases.EMPTY_ELSE, phrases.SENSOR_COSTS)
    if facts["kind"] == "frozen":
        moved = phrases.FROZEN.format(sensor=_upper(name), since=since)
        return Evidence(moved, (), phrases.FROZEN_ELSE, phrases.SENSOR_COSTS)
    moved = phrases.SHIFTED.format(
        sensor=_upper(name),
        check=phrases.named(facts["channel"]),
        moved=_moved(facts["channel"], facts["moved"]),
        sigma=f"{facts['sigma']:.1f}",
        since=since,
    )
    witness = Corroboration(SUPPORTS, phrases.SENSOR_FITS.format(odds=_probability(facts["p"])))
    return Evidence(moved, (witness,), phrases.SENSOR_ELSE, phrases.SENSOR_COSTS)


def _contradicted(facts: Facts, since: str) -> Evidence:
    """A part that was found sound does not lose more: what says so is off."""
    moved = phrases.FOUND_CLEAN[facts["of"]].format(
        day=facts["looked_on"], level=f"{100 * facts['level']:.0f}", loss=f"{100 * facts['loss']:.0f}", since=since
    )
    told = (Corroboration(SUPPORTS, phrases.CLEAN_LOSES_NOTHING),)
    return Evidence(moved, told, phrases.CLEAN_ELSE, phrases.SENSOR_COSTS)


def _moved(check: str, by: float) -> str:
    """By how much a check moved: in K, or for a logarithm in per cent."""
    return f"{by:+.2f} K" if check.endswith("_k") else f"{100.0 * by:+.1f} %"


def _upper(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
