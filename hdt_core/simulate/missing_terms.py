"""Simulate fleets with a physical term that the twin's model lacks: recorded values differ from the exchanger's."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hdt_core.physics.terms import TERMS, record_signals
from hdt_core.simulate.flight_conditions import Conditions

Array = NDArray[np.float64]
PACK_SIGNALS = {"hx_in_k": "hot_in_k", "hx_out_k": "hot_out_k", "pack_flow_kg_s": "pack_flow_kg_s"}


def recorded_air(now: Conditions, missing: Mapping[str, float]) -> Conditions:
    """Return outside conditions as the air data probes record them, without terms of the packs."""
    terms = {name: value for name, value in missing.items() if TERMS[name].signal == "tat_k"}
    return replace(now, tat_k=record_signals(_air(now), terms)["tat_k"])


def recorded_pack(true: dict[str, Array], now: Conditions, missing: Mapping[str, float]) -> dict[str, Array]:
    """Return a pack's signals as recorded before the sensors' own errors; `now` as the probes record it."""
    terms = {name: value for name, value in missing.items() if TERMS[name].signal != "tat_k"}
    recorded = record_signals(_air(now) | {name: true[of] for name, of in PACK_SIGNALS.items()}, terms)
    return true | {of: recorded[name] for name, of in PACK_SIGNALS.items()}


def _air(now: Conditions) -> dict[str, Array]:
    return {n: getattr(now, n) for n in ("altitude_m", "mach", "tat_k", "total_pressure_pa")}
