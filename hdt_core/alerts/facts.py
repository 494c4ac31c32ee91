"""Facts of a case at one moment, a record for each kind of evidence; NaN where not recorded."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
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
