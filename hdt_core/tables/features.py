"""Tables of stage features: features and alerts."""

from collections.abc import Iterator, Sequence
from typing import Any, cast

import dataframely as dy

from hdt_core.tables.base import DatedLegTable, Table, column, count, flag, moment, number, operator_key, pack_key, text
from hdt_core.tables.raw import Signals

Declared = tuple[type[dy.Column], str, str]
"""Type, unit and meaning of a feature's column."""
HEALTH = {
    "hx_fouling": ("-", "conductance lost by the heat exchanger"),
    "cc_efficiency_loss": ("-", "efficiency lost by the compressor"),
    "cc_diameter_loss": ("-", "effective diameter lost, against equation (6)"),
    "cc_effective_diameter_m": ("m", "effective diameter of the compressor, equation (5)"),
}
_RESIDUALS = {
    "cc_effective_diameter_{}_m": "effective diameter, equations (5) and (6)",
    "cc_flow_{}_kg_s": "compressor flow, equations (2)-(4)",
    "cc_out_{}_k": "compressor exit temperature",
    "cc_out_{}_pa": "compressor exit pressure, equation (5)",
    "hx_out_{}_k": "exchanger outlet, bleed side",
    "ram_out_{}_k": "exchanger outlet, ram side",
}
_KINDS = {"dsm_minus_twin": "model less twin", "sensor_minus_dsm": "sensor less model",
          "sensor_minus_twin": "sensor less twin"}  # fmt: skip
_UNITS = {"kg_s": "kg/s", "rad_s": "rad/s", "w_k": "W/K", "k": "K", "pa": "Pa", "m": "m"}
_VIRTUAL = {
    "ram_flow_kg_s": "ram flow by the clean duct's map",
    "ram_outlet_k": "ram outlet temperature by heat balance",
    "effectiveness": "hot-side effectiveness",
    "ua_w_k": "conductance",
    "ram_flow_loss": "share of the clean duct's ram flow that the heat balance misses; null without a ram outlet probe",
    "hx_fouling_flight": "conductance lost by this flight alone, its unit's offset still in it",
    "cc_diameter_deficit": "share of the diameter expected by equation (6) that is missing in this flight alone",
}
_MODEL_CHECKS = {
    "hx_in_over_discharge_k": "exchanger inlet above the value by compressor discharge and ram outlet",
    "hx_in_over_pressure_k": "the same where the discharge temperature is not recorded, from the pressure ratio",
    "conductance_off_cruise_ln": "ln of the conductance ratio of climb and descent over that of the cruise",
}
_LEVEL = {
    "inlet_minus_tat_k": "compressor inlet less total air temperature",
    "inlet_over_total_pressure_ln": "ln of compressor inlet over total pressure",
    "total_over_pitot_pressure_ln": "ln of total pressure over that of altitude and Mach number",
    "pack_over_compressor_flow_ln": "ln of pack over compressor flow",
    "tat_between_packs_k": "total air temperature less the other pack's",
    "total_pressure_between_packs_ln": "ln of total pressure over the other pack's",
    "pack_flow_between_packs_ln": "ln of pack flow over the other pack's",
    "compressor_flow_between_packs_ln": "ln of compressor flow over the other pack's",
    "cc_out_pressure_between_packs_ln": "ln of compressor exit pressure over the other pack's",
    "cc_out_pressure_over_schedule_ln": "ln of compressor exit pressure over its controller's schedule",
    "hx_in_between_packs_k": "exchanger inlet less the other pack's",
    "cc_out_between_packs_k": "compressor exit temperature less the other pack's",
}
_FREE = {
    "hx_out_minus_target_k": "exchanger outlet less its controller's target",
    "hx_out_between_packs_k": "exchanger outlet less the other pack's",
}
EXCHANGER_MARGIN = {
    "hx_ln_ua_ratio": "ln of the conductance that is left over the model's, unit's offset included, as tracked",
    "hx_margin_k": "margin: level held less outlet with the ram door full open, hottest fifth of the high samples",
    "hx_margin_sd_k": "standard deviation of it",
    "hx_margin_hot_day_k": "the same on the standard's hot day (ISA + 15 K) at the flight's own level, speed and flow",
    "hx_margin_hot_day_sd_k": "standard deviation of it",
    "hx_margin_design_k": "margin of a clean pack at the reference cruise",
    "hx_margin_target_k": "of the margin: what the flight's own target adds",
    "hx_margin_flow_k": "of the margin: what its flow and inlet temperature add",
    "hx_margin_ambient_k": "of the margin: what the air outside adds",
    "hx_margin_wear_k": "of the margin: what wear, blockage and the unit's own build add",
    "hx_margin_blockage_k": "of that: what a blocked ram side adds; null without a ram outlet probe",
    "hx_margin_profile_k": "of the margin: what the hottest fifth of the flight adds to its middle",
    "overheat_p20_k": "outlet above its level with the ram door full open, hottest fifth of the high samples",
    "full_open_share": "share of the high samples with the ram door full open",
}
COMPRESSOR_MARGIN = {
    "cc_ln_diameter_ratio": "ln of the effective diameter that is left over equation (6)'s, unit's offset included, as "
    "tracked",
    "cc_diameter_left": "share of it that may still go before flow or pressure falls short, hardest fifth of cruise",
    "cc_diameter_left_sd": "standard deviation of it",
    "cc_diameter_left_hot_high": "the same with that flow asked at 41,000 ft on a hot day (ISA + 15 K)",
    "cc_flow_asked_kg_s": "flow that the flight asked of the compressor, by speed and diffuser, median in cruise",
    "cc_flow_margin_kg_s": "margin: flow it can deliver at its highest speed less the flow asked, hardest fifth of the "
    "cruise",
    "cc_flow_margin_sd_kg_s": "standard deviation of it; null where it is as much as the diffuser's map reaches to",
    "cc_flow_margin_hot_high_kg_s": "the same with that flow asked at 41,000 ft on a hot day (ISA + 15 K)",
    "cc_flow_margin_hot_high_sd_kg_s": "standard deviation of it; null in the same way",
}
_DOOR = {
    "door_span": "5 to 95 % span of the ram door's position in the flight",
    "door_max": "widest ram door position",
    "door_n": "readings of the ram door",
    "door_travel": "sum of the ram door's moves",
}
_SETTING = {
    "tat_cruise_k": "total air temperature",
    "altitude_cruise_m": "pressure altitude",
    "mach_cruise": "Mach number",
    "hx_in_cruise_k": "exchanger inlet",
    "hx_out_cruise_k": "exchanger outlet",
    "pack_flow_cruise_kg_s": "pack flow",
    "cc_speed_cruise_rad_s": "compressor speed",
    "door_median": "ram door position, 0 shut, 1 full open",
}


def _unit(name: str) -> str:
    """Unit that a feature's name ends in."""
    return next((unit for end, unit in _UNITS.items() if name.endswith(f"_{end}")), "-")


def _number(name: str, meaning: str) -> tuple[str, Declared]:
    return name, (dy.Float64, _unit(name), meaning)


def _count(name: str, meaning: str) -> tuple[str, Declared]:
    return name, (dy.Int32, "-", meaning)


def _columns() -> Iterator[tuple[str, Declared]]:
    """Yield every feature, family by family, in the order in which they are stored."""
    yield "flight_index", (dy.Int64, "-", "flights of the tail before this one, in order of departure")
    yield from _of_health()
    for template, what in _RESIDUALS.items():
        yield from (_number(template.format(kind), f"{what}: {gap}, mean") for kind, gap in _KINDS.items())
    for name, what in _VIRTUAL.items():
        yield _number(name, what)
        yield f"{name}_sd", (dy.Float64, _unit(name), "standard deviation of it")
    yield from (_number(f"w_{name}", what) for name, what in _MODEL_CHECKS.items())
    yield from _of_sensors()
    yield from _of_cross_checks()
    yield from _of_margin()
    yield from _of_life()


def _of_health() -> Iterator[tuple[str, Declared]]:
    for name, (unit, what) in HEALTH.items():
        yield name, (dy.Float64, unit, f"{what}, after this flight")
        yield f"{name}_sd", (dy.Float64, unit, "standard deviation of it")
        yield f"{name}_status", (dy.String, "", "how that estimate ended")


def _of_sensors() -> Iterator[tuple[str, Declared]]:
    yield "running", (dy.Bool, "", "the pack was on")
    yield _count("n_snapshots", "samples of the flight")
    for signal in Signals.columns():
        yield f"{signal}_lost_share", (dy.Float64, "-", f"share of the flight without a value of {signal}")
    for signal in Signals.columns():
        yield f"{signal}_still", (dy.Bool, "", f"{signal} had one value all flight")


def _of_cross_checks() -> Iterator[tuple[str, Declared]]:
    for name, what in _DOOR.items():
        yield _count(name, what) if name.endswith("_n") else _number(name, what)
    yield "flight_hours", (dy.Float64, "h", "from the first to the last sample")
    yield from (_number(f"w_{name}", f"{what}, median in cruise") for name, what in _LEVEL.items())
    yield from (_count(f"w_{name}_n", "samples behind it") for name in _LEVEL)
    yield from (_number(name, f"{what}, median in cruise") for name, what in _SETTING.items())
    yield _number("door_full_open_share", "share of cruise with the ram door full open")
    yield from (_number(f"w_{name}", f"{what}, median while the door can move") for name, what in _FREE.items())
    yield from (_count(f"w_{name}_n", "samples behind it") for name in _FREE)
    yield _number("door_peg_excess_k", "outlet above target where the door is widest, less the same elsewhere")
    yield _count("door_peg_n", "samples where the door is widest")
    yield _count("door_off_peg_n", "samples elsewhere")
    yield _number("hx_out_target_sd_k", "scatter of the outlet about its target")


def _of_margin() -> Iterator[tuple[str, Declared]]:
    for name, what in EXCHANGER_MARGIN.items():
        yield _number(name, what)
    for ahead in (100, 300):
        what = (
            f"chance of the exchanger's message within {ahead} flights, by physics alone: no fleet's messages are in it"
        )
        yield _number(f"hx_passage_{ahead}", what)
    yield "hx_margin_status", (dy.String, "", "ok, level_of_pack (the flight does not show its own) or not_known")
    yield from (_number(name, what) for name, what in COMPRESSOR_MARGIN.items())
    reach = "ok, at_least (as far as the diffuser's map or the speeds on record reach) or not_known"
    yield "cc_flow_margin_status", (dy.String, "", reach)
    yield "cc_flow_margin_hot_high_status", (dy.String, "", reach)


def _of_life() -> Iterator[tuple[str, Declared]]:
    yield "flights_since_replacement", (dy.Int64, "-", "flights of this exchanger; null before the first logged")
    yield "flights_seen_of_unit", (dy.Int64, "-", "flights of this exchanger on record")
    yield (
        "flights_since_drop",
        (dy.Int64, "-", "flights since its fouling last fell as after work, or of this exchanger"),
    )
    for name, (unit, _) in HEALTH.items():
        per_flight = f"{unit}/flight" if unit != "-" else "1/flight"
        for n in (10, 30, 100):
            meaning = f"slope of {name} over the unit's last {n} flights"
            yield f"{name}_slope_{n}_per_flight", (dy.Float64, per_flight, meaning)
    yield _number("hx_fouling_jump_10", "hx_fouling less its value ten flights ago")
    step = "median of three flights less that of the twelve before"
    yield _number("hx_fouling_step_3", f"hx_fouling_flight: {step}, wear in between taken out")
    yield _number("ram_flow_loss_step_3", f"ram_flow_loss: {step}")
    for name in ("hx_fouling", "cc_efficiency_loss", "cc_effective_diameter_m", "door_median"):
        yield f"{name}_between_packs", (dy.Float64, _unit(name), f"{name} less the other pack's")
    yield _number("hx_out_excess_k", "hx_out_sensor_minus_dsm_k, as the alerts name it")
    yield _number("ram_door_open_cruise", "door_median, as the prognosis names it")
    yield _number("ram_door_margin", "what the ram door has left at its widest, 1 - door_max")
    yield "usage_hours", (dy.Float64, "h", "flight_hours so far")


def _table(name: str, doc: str, declared: Sequence[tuple[str, Declared]]) -> type[Table]:
    """Build a table of features without limits, for an odd ratio must not stop a night; the catalog checks it."""
    free: dict[str, Any] = {"allow_inf": True, "allow_nan": True}
    columns = {
        feature: column(dtype, meaning, unit, nullable=True, **(free if dtype is dy.Float64 else {}))
        for feature, (dtype, unit, meaning) in declared
    }
    return cast("type[Table]", type(name, (DatedLegTable,), {"__doc__": doc} | columns))


Features = _table(
    "Features", "Features of a pack after a flight, one column a feature: flight, pack.", tuple(_columns())
)
FeaturesCrossChecks = _table(
    "FeaturesCrossChecks",
    "Cross checks of a pack in a flight, by its own sensors, door and controllers: flight, pack.",
    (*_of_sensors(), *_of_cross_checks()),
)


class _Margin(DatedLegTable):
    """Demand of a flight on exchanger and compressor, independent of their wear: flight, pack."""

    high_n = count("samples above 15,000 ft behind it")
    held_k = number("level the controller holds the hot outlet at, median of the high samples", "K")
    held_status = text("flight, pack or unknown: whose level that is", nullable=False)
    full_open_share = number("share of the high samples with the ram door full open", "-", 0, 1)
    overheat_p20_k = number("hottest fifth of the high samples: outlet above its level, door full open", "K", 0)
    overheat_p50_k = number("hotter half of the high samples: outlet above its level, door full open", "K", 0)
    hx_margin_design_k = number("margin of a clean pack at the reference cruise", "K")
    hx_margin_target_k = number("what the flight's own target adds to it", "K")
    hx_margin_flow_k = number("what the flight's flow and inlet temperature add", "K")
    hx_margin_ambient_k = number("what the air outside adds", "K")
    hx_margin_blockage_k = number("what a blocked ram side adds; null without a ram outlet probe", "K")


def _critical(where: str) -> dict[str, dy.Column]:
    lead = "ln conductance ratio at which the outlet, door full open, is"
    at = ("20 K below", "10 K below", "at", "5 K above", "10 K above")
    names = ("minus_20k", "minus_10k", "0k", "5k", "10k")
    words = {"p20": "in a fifth of the high samples", "p50": "in half of them", "hot_day": "on the standard's hot day"}
    return {
        f"critical_ln_ratio_{where}_{n}": number(f"{lead} {a} its level {words[where]}")
        for n, a in zip(names, at, strict=True)
    }


def _delivery(where: str) -> dict[str, dy.Float64]:
    words = {"p20": "a fifth of the cruise", "hot_high": "its middle, were it hot and high"}
    flow = f"of the flow asked in {words[where]}, at the highest speed"
    ratio = "ln of the least diameter over equation (6)'s that delivers"
    critical = {
        f"critical_ln_diameter_{where}_{n}pct": number(f"{ratio} {n} % {flow}") for n in (60, 80, 100, 120, 150)
    }
    return critical | {f"cc_widest_share_{where}": number(f"share {flow}, that the widest diffuser known delivers")}


_CRITICAL = {**_critical("p20"), **_critical("p50"), **_critical("hot_day")}
COMPRESSOR_DEMAND = {
    "cc_flow_asked_kg_s": number("flow asked of the compressor, by speed and diffuser, median in cruise", "kg/s"),
    "cc_speed_limit_met": flag("the compressors' highest speed is known to be their limit", nullable=True),
    **_delivery("p20"),
    **_delivery("hot_high"),
}
FeaturesMargin = cast(
    "type[Table]", type("FeaturesMargin", (_Margin,), {"__doc__": _Margin.__doc__, **_CRITICAL, **COMPRESSOR_DEMAND})
)


class FeaturesAlerts(Table):
    """One case that needs a person's attention."""

    alert_id = text("hash of pack, diagnosis, sensor and first flight", nullable=False, primary_key=True)
    operator = operator_key(primary_key=False)
    tail = text("aircraft", nullable=False)
    pack = pack_key()
    component = text("HX, CC, RAM_DOOR, SENSOR or the code of a declared component", nullable=False)
    diagnosis = text(
        "code of the diagnosis, of unnest(tables.diagnoses()) or of a declared component",
        nullable=False,
    )
    sensor = text("SENSOR_FAULT: sensor at fault or, where a loss was found clean, the component; null for others")
    raised_flight_id = text("flight after which it was raised", nullable=False)
    raised_at = moment("departure of the flight after which it was raised")
    closed_at = moment(
        "departure of the first flight without it; where none has flown since the work that ended it, when that counts",
        nullable=True,
    )
    severity = text("low, medium or high, after now_flight_id", nullable=False)
    evidence = text("when raised: what moved, by how much, since when, and what corroborates it", nullable=False)
    evidence_phrases = text("JSON: evidence in phrases and values, to be written in another language", nullable=False)
    recommended_action = text("what to do", nullable=False)
    action_phrases = text("JSON: recommended_action in phrases and values", nullable=False)
    raised_severity = text("low, medium or high when raised", nullable=False)
    now_flight_id = text("last flight of the pack, or of a closed alert the last while it was open", nullable=False)
    evidence_now = text("the same as evidence, after now_flight_id", nullable=False)
    evidence_now_phrases = text("JSON: evidence_now in phrases and values", nullable=False)
    closed_reason = text(
        "renewed (another or a repaired part flies), found_clean (an inspection found nothing) or recovered (the "
        "loss or fault is no longer estimated); null while open"
    )
    follows = text("alert that was found clean, of one that came back because the loss grew on")
    units_in_90_days = column(
        dy.Int64,
        "units of the component on this position in the 90 days before it was raised, its own included; null for "
        "sensors and doors",
        "-",
        nullable=True,
    )
