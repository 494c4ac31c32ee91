"""Lives of the units on one pack: wear, messages, the work of the shop and its entries in the log."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hdt_core.robust import Array
from hdt_core.simulate.design import Conditions, Operator, PackDesign
from hdt_core.simulate.packs import FULL_OPEN, Demand, ExchangerWear, behind_worn_compressor, outlets
from hdt_core.simulate.wear import draw_wear

CC_MESSAGE_LOSS = 0.27
SENSORS = ("hx_in_degc", "hx_out_degc", "pack_flow_lbpm", "cc_flow_lbpm", "cc_out_psia", "ram_door_pct")
_WORK = ("component", "action", "finding")
FAULTS = ("drift", "step", "stuck", "dropout")


@dataclass(slots=True)
class PackHistory:
    """One pack over all its flights: state per flight, and what happened.

    Attributes
    ----------
    film_k_w, blockage, area_loss, unit_ua, cc_loss, cc_scatter : ndarray, shape (flights,)
        Wear of the exchanger's unit, its own conductance ratio, the compressor's loss of efficiency, and the offset of
        its diameter [m].
    hx_unit, cc_unit : ndarray of int
        Which unit flies.
    door_stuck, door_reach : ndarray
        Position at which the door is jammed (NaN: free), and the widest it opens; its sensor sits on the door. [-]
    sensor, fault : ndarray of str
        Which sensor is faulty, and how.
    icing, pack_off : ndarray of bool
        Flights with ice on the core, flights with the pack switched off.
    events, messages, maintenance : list of dict
        Rows of the frames of that name, flights by index.
    """

    film_k_w: Array
    blockage: Array
    area_loss: Array
    unit_ua: Array
    cc_loss: Array
    cc_scatter: Array
    hx_unit: Array
    cc_unit: Array
    door_stuck: Array
    door_reach: Array
    sensor: Array
    fault: Array
    icing: Array
    pack_off: Array
    events: list[dict[str, Any]] = field(default_factory=list)
    messages: list[dict[str, Any]] = field(default_factory=list)
    maintenance: list[dict[str, Any]] = field(default_factory=list)

    @property
    def wear(self) -> ExchangerWear:
        """State of the exchanger, per flight."""
        return ExchangerWear(self.film_k_w, self.blockage, self.area_loss, self.unit_ua)


def draw_history(
    rng: np.random.Generator, operator: Operator, design: PackDesign, cruise: Conditions, demand: Demand
) -> PackHistory:
    """Draw the history of one pack.

    Parameters
    ----------
    rng : Generator
        Source of randomness.
    operator, design
        Operator of the aircraft, and design of its packs.
    cruise, demand
        Conditions, and demand behind a sound compressor, in the middle of each flight's cruise, shape (flights,).
    """
    n = cruise.mach.size
    zero = np.zeros(n)
    none = np.full(n, "", dtype="<U32")
    history = PackHistory(
        zero.copy(), zero.copy(), zero.copy(), zero + 1.0, zero.copy(), zero.copy(), zero.astype(int), zero.astype(int),
        zero + np.nan, zero + 1.0, none.copy(), none.copy(), rng.random(n) < 0.004, rng.random(n) < 0.003,
    )  # fmt: skip
    _compressors(rng, history, design)
    demand = behind_worn_compressor(design, cruise, demand, history.cc_loss)
    _exchangers(rng, history, operator, design=design, cruise=cruise, demand=demand)
    _door_faults(rng, history, design, cruise, demand)
    _sensor_faults(rng, history)
    for index in np.nonzero(rng.random(n) < 0.001)[0]:
        _add_message(history, int(index), rng.choice(["21-61-TRIM", "21-52-HXTEMP"]))
    return history


def unmet_k(design: PackDesign, cruise: Conditions, demand: Demand, wear: ExchangerWear, door: Array) -> Array:
    """Compute the outlet above its target with the door at its widest. [K]"""
    return outlets(design, cruise, demand, door, wear)[0] - demand.target_k


def _exchangers(
    rng: np.random.Generator,
    h: PackHistory,
    operator: Operator,
    *,
    design: PackDesign,
    cruise: Conditions,
    demand: Demand,
) -> None:
    """Write the lives of the exchangers of one pack."""
    n = h.blockage.size
    start = 0
    unit = 0
    while start < n:
        kind = _install(rng, h, operator, design=design, start=start, unit=unit)
        rest = np.arange(start, n)
        conditions = (cruise.at(rest), demand.at(rest), h.wear.at(rest))
        is_over = unmet_k(design, *conditions, np.full(n - start, FULL_OPEN)) > design.unmet_limit_k
        messages = np.nonzero(is_over & np.roll(is_over, 1))[0]
        message = start + int(messages[messages > 0][0]) if (messages > 0).any() else None
        preventive_at = start + int(rng.integers(40, 400)) if rng.random() < 0.15 else 10**9
        removal = min(message + int(rng.integers(1, 10)) if message is not None else 10**9, 10**9)
        preventive = preventive_at < min(removal, n) and (message is None or preventive_at <= message)
        end = preventive_at if preventive else removal
        event: dict[str, Any] = {"component": "HX", "kind": kind, "installed_index": start, "message_index": None}
        if preventive:
            event |= {"removal_kind": "PREVENTIVE", "censored": True, "removal_index": end, "finding": ""}
            _log(rng, h, end, "HX", "REPLACED", "")
        elif message is not None:
            finding = "CLOGGED" if h.blockage[message] > h.film_k_w[message] * design.hx_ua_reference_w_k else "FOULED"
            event |= {"message_index": message, "removal_kind": "FAILURE", "censored": False, "finding": finding}
            event["removal_index"] = end if end < n else None
            for index in range(message, min(end, n)):
                if index == message or rng.random() < 0.5:
                    _add_message(h, index, "21-52-HXTEMP")
            if end < n:
                _log(rng, h, end, "HX", "REPLACED", finding)
        else:
            event |= {"removal_kind": "END", "censored": True, "removal_index": None, "finding": ""}
        h.events.append(event)
        start = end
        unit = unit + 1


def _install(
    rng: np.random.Generator, h: PackHistory, operator: Operator, *, design: PackDesign, start: int, unit: int
) -> str:
    """Write the wear of a new unit from `start` to the end of the record; return its kind."""
    n = h.blockage.size - start
    age = rng.uniform(0.0, 0.5) if unit == 0 and rng.random() < 0.4 else 0.0
    wear = draw_wear(rng, np.array([age]), n, operator.wear)
    clog = wear.clog[0]
    gradual = _wash(rng, h, operator, start, 1.0 - (1.0 - wear.loss[0]) / (1.0 - clog))
    share = rng.dirichlet([1.2, 1.0, 0.25])
    reference_ua = design.hx_ua_reference_w_k
    film = share[0] * gradual
    h.film_k_w[start:] = film / (1.0 - film) / reference_ua
    h.blockage[start:] = 1.0 - (1.0 - share[1] * gradual) * (1.0 - clog)
    h.area_loss[start:] = share[2] * gradual
    h.unit_ua[start:] = 1.0 + 0.04 * rng.standard_normal()
    h.hx_unit[start:] = unit
    return str(wear.shape[0]) + ("+sudden_clog" if clog.max() > 0.0 else "")


def _wash(rng: np.random.Generator, h: PackHistory, operator: Operator, start: int, gradual: Array) -> Array:
    """Apply scheduled washes, which remove half to nine tenths of the deposit."""
    out = gradual.copy()
    if not operator.wash_every:
        return out
    for index in range(int(rng.integers(operator.wash_every)), h.blockage.size, operator.wash_every):
        if index > start:
            out[index - start :] -= rng.uniform(0.5, 0.9) * out[index - start]
            _log(rng, h, index, "HX", "CLEANED", "")
    return np.maximum(out, 0.0)


def _compressors(rng: np.random.Generator, h: PackHistory, design: PackDesign) -> None:
    """Write the lives of the compressors of one pack."""
    n = h.cc_loss.size
    start = 0
    unit = 0
    while start < n:
        is_worn = rng.random() < 0.3
        life = rng.uniform(180.0, 600.0) if is_worn else rng.uniform(3000.0, 9000.0)
        k = np.arange(n - start) + (rng.uniform(0.0, 0.4) * life if unit == 0 else 0.0)
        loss = CC_MESSAGE_LOSS * (k / life) ** rng.uniform(1.0, 2.5)
        messages = np.nonzero(loss + 0.01 * rng.standard_normal(loss.size) > CC_MESSAGE_LOSS)[0]
        message = start + int(messages[0]) if messages.size else None
        end = message + int(rng.integers(2, 10)) if message is not None else n
        h.cc_loss[start:] = np.minimum(loss, 0.6)
        h.cc_scatter[start:] = 0.3 * design.diameter_scatter_m * rng.standard_normal()
        h.cc_unit[start:] = unit
        kind = "efficiency_wear" if is_worn else "healthy"
        event: dict[str, Any] = {"component": "CC", "kind": kind, "installed_index": start, "message_index": message}
        end_of_life = ("END", "") if message is None else ("FAILURE", "DAMAGED")
        event |= dict(zip(("removal_kind", "finding"), end_of_life, strict=True))
        h.events.append(event | {"censored": message is None, "removal_index": end if end < n else None})
        if message is not None:
            _add_message(h, message, "21-51-CCFLOW")
            if end < n:
                _log(rng, h, end, "CC", "REPLACED", "DAMAGED")
        start = end
        unit = unit + 1


def _door_faults(
    rng: np.random.Generator, h: PackHistory, design: PackDesign, cruise: Conditions, demand: Demand
) -> None:
    """Write the faults of the ram door of one pack."""
    n = h.blockage.size
    for onset in np.nonzero(rng.random(n) < 1.0 / 1500.0)[0]:
        end = min(int(onset + rng.integers(8, 35)), n)
        jam = rng.random() < 0.5
        if jam:
            h.door_stuck[onset:end] = rng.uniform(0.1, 0.5)
        else:
            h.door_reach[onset:end] = rng.uniform(0.45, 0.7)
        widest = np.where(np.isnan(h.door_stuck), h.door_reach, h.door_stuck)
        is_over = unmet_k(design, cruise, demand, h.wear, widest) > design.unmet_limit_k
        messages = [int(i) for i in np.nonzero(is_over[onset:end])[0] + onset]
        for index in messages:
            _add_message(h, index, "21-52-HXTEMP")
        kind = "door_jam" if jam else "door_lost_travel"
        event: dict[str, Any] = {"component": "RAM_DOOR", "kind": kind, "finding": "DAMAGED"}
        event |= {"removal_kind": "REPAIR", "censored": end >= n, "installed_index": None, "onset_index": int(onset)}
        event |= {"message_index": messages[0] if messages else None, "removal_index": end if end < n else None}
        h.events.append(event)
        if end < n:
            _log(rng, h, end, "RAM_DOOR", "REPLACED", "DAMAGED")
            if messages:
                _log(rng, h, min(messages[-1] + 1, n - 1), "HX", "INSPECTED", "NO_FAULT_FOUND")


def _sensor_faults(rng: np.random.Generator, h: PackHistory) -> None:
    """Write the faults of the sensors of one pack."""
    n = h.blockage.size
    for onset in np.nonzero(rng.random(n) < 1.0 / 800.0)[0]:
        end = min(int(onset + rng.integers(6, 80)), n)
        h.sensor[onset:end], h.fault[onset:end] = rng.choice(SENSORS), rng.choice(FAULTS)
        kind = f"{h.sensor[onset]}_{h.fault[onset]}"
        event: dict[str, Any] = {"component": "SENSOR", "kind": kind, "removal_kind": "REPAIR"}
        event |= {"censored": end >= n, "installed_index": None, "onset_index": int(onset), "message_index": None}
        h.events.append(event | {"removal_index": end if end < n else None, "finding": "DAMAGED"})
        if end < n:
            _log(rng, h, end, "SENSOR", "REPLACED", "DAMAGED")


def _add_message(h: PackHistory, index: int, code: str) -> None:
    h.messages.append({"index": index, "code": str(code)})


def _log(rng: np.random.Generator, h: PackHistory, index: int, *work: str) -> None:
    late = int(rng.integers(0, 6)) if rng.random() < 0.3 else 0
    h.maintenance.append({"index": min(index + late, h.blockage.size - 1)} | dict(zip(_WORK, work, strict=True)))
