"""Facts of a case at one moment, a record for each kind of evidence; NaN where not recorded."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from math import nan
from typing import Any, ClassVar, Self

OF_THE_CASE = ("since", "follows", "biased")
"""What a rule notes of a case beside its evidence."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """Facts of any case, all measured by the rule that raised it."""

    @classmethod
    def collect(cls, own: Mapping[str, Any], latest: Callable[[str], float]) -> Self:
        """Build the record from what the case's rule measured, and where it has any the latest value of each feature.

        Raises
        ------
        TypeError
            The rule measured what the record has no field for, or left out what it needs.
        """
        return cls(**_evidence(own))


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureFacts(Facts):
    """Facts that are features of the pack's last flights, by their columns' names, but for those of `FROM_CASE`."""

    FROM_CASE: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def collect(cls, own: Mapping[str, Any], latest: Callable[[str], float]) -> Self:
        """Build the record: see `Facts.collect`."""
        features = {f.name: latest(f.name) for f in fields(cls) if f.name not in cls.FROM_CASE}
        return cls(**features, **_evidence(own))


def _evidence(own: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in own.items() if name not in OF_THE_CASE}


@dataclass(frozen=True, slots=True, kw_only=True)
class ExchangerFacts(FeatureFacts):
    """Of a worn or clogged exchanger."""

    FROM_CASE = ("gained", "jump")

    hx_fouling: float
    hx_fouling_sd: float
    hx_fouling_slope_30_per_flight: float
    hx_fouling_between_packs: float
    door_full_open_share: float
    door_median_between_packs: float
    ram_flow_loss: float
    gained: float = nan  # by its last ten flights over its ten best
    jump: float = nan  # within three flights


@dataclass(frozen=True, slots=True, kw_only=True)
class MarginFacts(ExchangerFacts):
    """Of an exchanger with little cooling margin left."""

    hx_passage_100: float
    hx_passage_300: float
    hx_margin_k: float
    hx_margin_hot_day_k: float
    hx_margin_design_k: float
    hx_margin_target_k: float
    hx_margin_flow_k: float
    hx_margin_ambient_k: float
    hx_margin_wear_k: float
    overheat_p20_k: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CompressorFacts(FeatureFacts):
    """Of a worn compressor."""

    FROM_CASE = ("shrunk",)

    cc_efficiency_loss: float
    cc_efficiency_loss_sd: float
    cc_diameter_loss: float
    cc_diameter_left: float
    cc_diameter_left_hot_high: float
    shrunk: float = nan  # change of the effective diameter, as a share


@dataclass(frozen=True, slots=True, kw_only=True)
class DoorFacts(Facts):
    """Of a door that is jammed or ends its travel too soon."""

    kind: str
    stop: float
    excess_k: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFacts(Facts):
    """Of a sensor that drops out, freezes or shifts, or that an inspection of another part contradicts."""

    FROM_CASE = (
        "kind",
        "sensor",
        "whose",
        "share",
        "channel",
        "moved",
        "sigma",
        "p",
        "of",
        "looked_on",
        "level",
        "loss",
    )

    kind: str
    sensor: str = ""
    whose: str = "own"
    share: float = nan  # of readings lost
    channel: str = ""  # cross check that shows a shift
    moved: float = nan  # by how much it moved, in its unit
    sigma: float = nan
    p: float = nan  # that it is this sensor
    of: str = ""  # component that was found clean
    looked_on: str = ""
    level: float = nan  # of the loss that was found clean
    loss: float = nan


@dataclass(frozen=True, slots=True, kw_only=True)
class LossFacts(FeatureFacts):
    """Of a worn part that a package declares."""

    loss: float
    loss_sd: float
    loss_slope_30_per_flight: float
    loss_step_3: float
