"""Diagnoses of alerts, each declared once: its component, texts, action, and the work that ends it.

To add one, declare it here and write a rule that finds its cases (`alerts.raise_alerts`); report, `hdt explain`,
catalog and the check of alerts follow from the declaration.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hdt_core.alerts import evidence
from hdt_core.alerts.cases import REPAIR, Case, Grid
from hdt_core.alerts.evidence import Evidence, Facts
from hdt_core.components.pack import CC, HX


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One kind of case: its texts, its action and what ends it.

    Attributes
    ----------
    code, component, name : str
        As in the catalog; the component as in the log of work; the name in plain words.
    action : str
        What to do, with its ATA task.
    ended_by : tuple of str
        Actions on the component that end the case, because another or a repaired part is fitted.
    severity : callable
        `low`, `medium` or `high` by the facts of a moment.
    evidence : callable
        Evidence by the facts of a moment and the flight since which the finding holds.
    features : tuple of str
        Columns that are facts of any moment, beside those the case was raised with.
    addendum : callable, optional
        Text that the facts add to the action.
    ended_by_sound : bool
        Whether an inspection of the component without a finding ends the case.
    """

    code: str
    component: str
    name: str
    action: str
    ended_by: tuple[str, ...]
    severity: Callable[[Facts], str]
    evidence: Callable[[Facts, str], Evidence]
    features: tuple[str, ...] = ()
    addendum: Callable[[Facts], str] = lambda facts: ""
    ended_by_sound: bool = True

    def facts(self, grid: Grid, case: Case, flight: int) -> Facts:
        """Return the facts after a flight: those the case was raised with, and the latest features."""
        return {**case.facts, **case.facts_at(flight), **{n: _latest(grid, n, case, flight) for n in self.features}}


def _latest(grid: Grid, name: str, case: Case, flight: int) -> float:
    """Return the last value of a feature from the flight that raised the case to `flight`."""
    values = grid.track(name, case.unit)[case.raised_flight : flight + 1]
    values = values[np.isfinite(values)]
    return float(values[-1]) if values.size else np.nan


_EXCHANGER = (
    "hx_fouling", "hx_fouling_sd", "hx_fouling_slope_30_per_flight", "door_full_open_share",
    "door_median_between_packs", "hx_fouling_between_packs", "ram_flow_loss",
)  # fmt: skip
_MARGIN = (
    "hx_passage_100", "hx_passage_300", "hx_margin_k", "hx_margin_sd_k", "hx_margin_hot_day_k", "hx_margin_design_k",
    "hx_margin_target_k", "hx_margin_flow_k", "hx_margin_ambient_k", "hx_margin_wear_k", "overheat_p20_k",
)  # fmt: skip
_COMPRESSOR = (
    "cc_efficiency_loss", "cc_efficiency_loss_sd", "cc_diameter_loss", "cc_diameter_left", "cc_diameter_left_hot_high",
)  # fmt: skip

DIAGNOSES = {
    d.code: d
    for d in (
        Diagnosis(
            code="HX_FOULING",
            component="HX",
            name="heat exchanger fouling",
            action=HX.action,
            ended_by=HX.ended_by,
            severity=evidence.exchanger_severity,
            evidence=evidence.exchanger,
            features=_EXCHANGER,
        ),
        Diagnosis(
            code="HX_SUDDEN_CLOG",
            component="HX",
            name="heat exchanger clogged suddenly",
            action="Inspect ram air inlet and core face for foreign objects before the next long sector "
            "(ATA 21-52, detailed visual inspection)",
            ended_by=HX.ended_by,
            severity=lambda facts: "high",
            evidence=evidence.clog,
            features=_EXCHANGER,
        ),
        Diagnosis(
            code="HX_LOW_MARGIN",
            component="HX",
            name="little cooling margin left",
            action="Not a new exchanger alone: check target, flow schedule and ram door travel (ATA 21-53, rigging), "
            "keep the aircraft off hot sectors where it can be, and wash at the next stop",
            ended_by=HX.ended_by,
            severity=lambda facts: "high" if facts["hx_passage_100"] > 0.5 else "medium",
            evidence=evidence.low_margin,
            features=(*_EXCHANGER, *_MARGIN),
            ended_by_sound=False,  # its evidence already excludes wear as the only cause
        ),
        Diagnosis(
            code="CC_DEGRADED",
            component="CC",
            name="compressor worn",
            action=CC.action,
            ended_by=CC.ended_by,
            severity=lambda facts: "medium",
            evidence=evidence.compressor,
            features=_COMPRESSOR,
        ),
        Diagnosis(
            code="RAM_DOOR_FAULT",
            component="RAM_DOOR",
            name="ram air door fault",
            action="Operational test of the ram air inlet door and its actuator (ATA 21-53); rig or replace",
            ended_by=REPAIR,
            severity=lambda facts: "high" if facts["kind"] == "jam" else "medium",
            evidence=evidence.door,
        ),
        Diagnosis(
            code="SENSOR_FAULT",
            component="SENSOR",
            name="sensor fault",
            action="Check connector and wiring, then replace the sensor (ATA 21-61)",
            ended_by=REPAIR,
            severity=evidence.sensor_severity,
            evidence=evidence.sensor,
            addendum=evidence.sensor_addendum,
        ),
    )
}
