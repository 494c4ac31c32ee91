"""A case in words: what moved and since when, which witnesses speak for or against it, what waiting costs."""

import math
from collections.abc import Mapping
from typing import Any

from scipy.special import ndtr

from hdt_core.health.episodes import DIAMETER_SD, FAILS_AT
from hdt_core.health.evidence import AGAINST, NEUTRAL, SUPPORTS, Evidence, Witness
from hdt_core.tables.raw import Signals

Facts = Mapping[str, Any]
"""What is known of a case at one moment, by name; NaN where it was not recorded."""
WORN = 0.05
"""Loss from which a unit counts as worn at all. [-]"""
PEG_SD_K = 0.33
"""Scatter, over sound flights, of the outlet where the door is widest less the outlet elsewhere. [K]"""
WITHOUT = "Until it is replaced the pack's health is judged without it, and less surely"
LEANED_ON = ("hx_out_k", "hx_in_k", "pack_flow_kg_s", "tat_k")
"""Sensors that the fouling estimate stands on."""
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
    return "medium" if facts["sensor"] in LEANED_ON else "low"


def door_severity(facts: Facts) -> str:
    """High where the door can't move at all."""
    return "high" if facts["kind"] == "jam" else "medium"


def flights_left(facts: Facts) -> float | None:
    """Straight-line flights to the loss at which packs fail, for the severity; None where the loss doesn't grow."""
    slope = facts["hx_fouling_slope_30_per_flight"]
    return max((FAILS_AT - facts["hx_fouling"]) / slope, 0.0) if slope > 1e-5 else None


def sensor_named(facts: Facts) -> str:
    """The sensor by what it measures, without the paper's number of it."""
    said = Signals.columns()[facts["sensor"]].metadata or {}
    return f"; sensor: {str(said['meaning']).partition(' (')[0]} ({facts['sensor']})"


def _probability(p: float) -> str:
    """In words; never a certainty."""
    return "above 0.99" if p > 0.99 else f"{p:.2f}"


def chance_above(value: float, limit: float, sd: float) -> str:
    """Chance that an estimate above a limit is truly above it, in words."""
    return _probability(float(ndtr((value - limit) / max(sd, 1e-6))))


def exchanger(facts: Facts, since: str) -> Evidence:
    """Fouling, gradual or sudden."""
    loss, sd = facts["hx_fouling"], facts["hx_fouling_sd"]
    slope = facts["hx_fouling_slope_30_per_flight"]
    moved = (
        f"UA lost (hx_fouling) {100 * loss:.0f} +- {100 * sd:.0f} %, {loss / max(sd, 1e-6):.0f} sigma; "
        f"above {100 * WORN:.0f} % since {since}, and with probability {chance_above(loss, WORN, sd)}"
    )
    if slope > 1e-5:
        moved += f"; {1000 * slope:.1f} points more every ten flights (trend of 30)"
    if facts["gained"] > loss + 2.0 * sd:
        moved += f"; its last ten flights alone lie {100 * facts['gained']:.0f} % above the best ten of this unit"
    otherwise = "a door or outlet sensor at fault, but their checks are quiet; icing would go by the next flight"
    waiting = "Waiting costs ram drag and, when the door has no travel left, the message 21-52-HXTEMP"
    witnesses = (_full_open(facts), _door_beside(facts), _loss_beside(facts), _ram_flow(facts, NEUTRAL))
    return Evidence(moved, tuple(w for w in witnesses if w), otherwise, waiting)


def clog(facts: Facts, since: str) -> Evidence:
    """A sudden clog: fouling with a jump that wear doesn't make."""
    said = exchanger(facts, since)
    step = facts["jump"]
    moved = f"{said.moved}; {100 * step:.0f} points of it within three flights, which wear doesn't do"
    witnesses = (_full_open(facts), _door_beside(facts), _loss_beside(facts), _ram_flow(facts, AGAINST))
    return Evidence(moved, tuple(w for w in witnesses if w), said.otherwise, said.waiting)


def _full_open(facts: Facts) -> Witness:
    """A controller that asks for more ram air than the door can give."""
    share = facts["door_full_open_share"]
    if math.isnan(share):
        return Witness(NEUTRAL, "door position unknown")
    if share < FULL_OPEN_SHARE:
        return Witness(
            NEUTRAL, f"ram door full open in {100 * share:.0f} % of cruise: it can still make up for the loss"
        )
    return Witness(SUPPORTS, f"ram door full open in {100 * share:.0f} % of cruise")


def _door_beside(facts: Facts) -> Witness | None:
    """The door of the pack that lost more should stand wider than the other's, on the same flight."""
    wider, more = facts["door_median_between_packs"], facts["hx_fouling_between_packs"]
    if math.isnan(wider) or not more > LOSS_APART:
        return None
    if abs(wider) <= DOOR_APART:
        return Witness(NEUTRAL, "ram door about as wide as that of the other pack, which has lost less")
    if wider > 0.0:
        return Witness(SUPPORTS, f"ram door {100 * wider:.0f} points wider than that of the other pack")
    return Witness(
        AGAINST, f"ram door {-100 * wider:.0f} points narrower than that of the other pack, which has lost less"
    )


def _loss_beside(facts: Facts) -> Witness | None:
    """What both packs of an aircraft show alike may be something they share."""
    more = facts["hx_fouling_between_packs"]
    if math.isnan(more):
        return None
    if more > LOSS_APART:
        return Witness(SUPPORTS, f"the other pack has lost {100 * more:.0f} points less on the same flights")
    return Witness(NEUTRAL, "the other pack has lost as much: the same dust, or an error both share")


def _ram_flow(facts: Facts, otherwise: str) -> Witness | None:
    """Where the ram outlet is measured: a blockage starves the ram flow, a film does not."""
    lost = facts["ram_flow_loss"]
    if math.isnan(lost):
        return None
    if lost > RAM_FLOW_LOST:
        return Witness(SUPPORTS, f"ram flow {100 * lost:.0f} % below a clean duct's, as a blocked core has it")
    return Witness(otherwise, "ram flow that of a clean duct: no blockage")


def margin_severity(facts: Facts) -> str:
    """High where the message is more likely than not within a hundred flights."""
    return "high" if facts["hx_passage_100"] > 0.5 else "medium"


def low_margin(facts: Facts, since: str) -> Evidence:
    """Little reserve before the message, and what took it."""
    loss, sd = facts["hx_fouling"], facts["hx_fouling_sd"]
    moved = (
        f"With the ram door full open the outlet would stand {_kelvin(facts['hx_margin_k'])} its level in the hottest "
        f"fifth of the last flight, {_kelvin(facts['hx_margin_hot_day_k'])} it on a hot day (ISA + 15 K); message "
        f"21-52-HXTEMP within 300 flights with probability {_probability(facts['hx_passage_300'])}, "
        f"believed since {since}"
    )
    parts = {
        "the design gives": "hx_margin_design_k", "target": "hx_margin_target_k", "flow": "hx_margin_flow_k",
        "air outside": "hx_margin_ambient_k", "wear and build": "hx_margin_wear_k",
    }  # fmt: skip
    shares = ", ".join(f"{word} {facts[name]:+.0f} K" for word, name in parts.items() if not math.isnan(facts[name]))
    told = [Witness(NEUTRAL, f"what makes the margin: {shares}")] if shares else []
    worn = f"UA lost (hx_fouling) {100 * loss:.0f} +- {100 * sd:.0f} %: wear alone does not explain it"
    told.append(Witness(NEUTRAL, worn))
    if facts["overheat_p20_k"] > 1.0:
        above = f"on the last flight the outlet was {facts['overheat_p20_k']:.0f} K above its level, door full open"
        told.append(Witness(SUPPORTS, above))
    waiting = "Waiting costs the message on a hot day, and an exchanger that is taken off in vain"
    return Evidence(moved, (*told, _full_open(facts)), "a cooler season, or an outlet sensor that reads high", waiting)


def _kelvin(margin_k: float) -> str:
    """A margin as a reader sees it: how far below or above a level."""
    if math.isnan(margin_k):
        return "at an unknown distance from"
    return f"{abs(margin_k):.0f} K {'below' if margin_k >= 0.0 else 'above'}"


def compressor(facts: Facts, since: str) -> Evidence:
    """Efficiency where the exit temperature is recorded, else effective diameter."""
    loss, sd, shrunk = facts["cc_efficiency_loss"], facts["cc_efficiency_loss_sd"], facts["shrunk"]
    waiting = "Waiting costs compressor power and, in the end, a flow message (21-51-CCFLOW)"
    if not math.isnan(loss):
        moved = (
            f"Compressor efficiency (cc_efficiency_loss) is {100 * loss:.1f} +- {100 * sd:.1f} % below expectation, "
            f"{loss / max(sd, 1e-6):.0f} sigma, believed since {since}; worn at all (above {100 * WORN:.0f} %) with "
            f"probability {chance_above(loss, WORN, sd)}"
        )
        return Evidence(moved, _diameter(facts), "a drifting exit temperature sensor", waiting)
    moved = (
        f"Effective diameter (cc_effective_diameter_m) is {-100 * shrunk:.1f} % below this unit's own first flights, "
        f"{-shrunk / DIAMETER_SD:.1f} sigma of a flight and summed up beyond doubt (CUSUM), believed since {since}"
    )
    witness = Witness(NEUTRAL, "no efficiency to compare with: the exit temperature is not recorded")
    return Evidence(moved, (witness,), "a drifting speed or pressure sensor", waiting)


def _diameter(facts: Facts) -> tuple[Witness, ...]:
    """Equation (5) takes the root of efficiency: a worn compressor's effective diameter shrinks by half of its loss."""
    lost, efficiency = facts["cc_diameter_loss"], facts["cc_efficiency_loss"]
    if math.isnan(lost):
        return ()
    role = SUPPORTS if lost > 0.25 * efficiency else NEUTRAL if lost > -DIAMETER_SD else AGAINST
    return (Witness(role, f"effective diameter lost (cc_diameter_loss) {100 * lost:.1f} %"),)


def door(facts: Facts, since: str) -> Evidence:
    """A jam, or travel that ends too soon."""
    stop = f"{100 * facts['stop']:.0f} %"
    if facts["kind"] == "jam":
        return Evidence(
            f"The ram door (ram_door_open) stays at {stop} from climb to descent since {since} while its controller's "
            "need changes: less than 7 sigma of its sensor's noise, on two of three flights",
            (Witness(SUPPORTS, "its reading flickers, which that of a frozen sensor would not"),),
            "a frozen sensor",
            "Until repaired the outlet runs warm or cold, and the door can't make up for fouling",
        )
    excess_k = facts["excess_k"]
    return Evidence(
        f"The ram door (ram_door_open) goes no further than {stop}: since {since} the outlet ran up to "
        f"{excess_k:.1f} K ({excess_k / PEG_SD_K:.0f} sigma of a sound flight) above its target there",
        (Witness(SUPPORTS, "the outlet was on target wherever the door was not at that stop"),),
        "a fouled exchanger, which would open the door fully first",
        "Waiting costs temperature control on hot days",
    )


def sensor(facts: Facts, since: str) -> Evidence:
    """Silent, frozen, or gone from what physics ties it to."""
    name = facts["sensor"]
    if facts["kind"] == "dropout":
        moved = (
            f"{name} is empty in {100 * facts['share']:.0f} % of its readings since {since}, on two of three flights; "
            "a sound sensor loses about 1 %"
        )
        return Evidence(moved, (), "a loose connector or the recorder's bus", WITHOUT)
    if facts["kind"] == "frozen":
        moved = (
            f"{name} shows one value, or none that can be true, from climb to descent since {since}, though what it "
            "measures moves, on two of three flights"
        )
        return Evidence(moved, (), "its converter or the recorder's bus", WITHOUT)
    moved = (
        f"{name} left what physics ties it to: {facts['channel']} moved by {facts['moved']:.3g} "
        f"({facts['sigma']:.1f} sigma of the mean) since {since}"
    )
    fits = f"the pattern over all cross checks fits this sensor with probability {_probability(facts['p'])}"
    witness = Witness(SUPPORTS, fits)
    return Evidence(moved, (witness,), "another sensor of the same checks; wear leaves them alone", WITHOUT)
