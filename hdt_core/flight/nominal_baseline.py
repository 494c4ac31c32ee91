"""What nominal legs of a fleet have in common, learned once in its commissioning window, and legs held against it."""

import json
from dataclasses import asdict, dataclass, field
from typing import Any

import polars as pl

from hdt_core.flight.cross_checks import OutletLaw, leg_checks
from hdt_core.flight.manifold import Manifold, leg_conductance
from hdt_core.flight.nominal import IndexLevel, Scatter
from hdt_core.flight.phases import LEG_KEY
from hdt_core.records.each_aircraft import of_each_aircraft
from hdt_core.tables.base import finite


@dataclass(frozen=True, slots=True)
class NominalBaseline:
    """What nominal legs of a fleet have in common: the laws that legs are held against."""

    manifold: Manifold | None = None
    outlet: OutletLaw | None = None
    level: IndexLevel = field(default_factory=IndexLevel)
    scatter: Scatter | None = None

    def to_json(self) -> str:
        """Plain text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "NominalBaseline":
        """Inverse of `to_json`."""
        plain = json.loads(text)
        kinds = {"manifold": Manifold, "outlet": OutletLaw, "level": IndexLevel, "scatter": Scatter}
        return cls(**{name: kind(**_frozen(plain[name])) for name, kind in kinds.items() if plain[name] is not None})


def leg_indicators(samples: pl.DataFrame, baseline: NominalBaseline) -> pl.DataFrame:
    """What each leg shows by itself, held against the fleet's laws: `LEG_KEY`, the index's level, unrest and count,
    means of the cross checks. Each from its own samples only."""

    def found(own: pl.DataFrame) -> pl.DataFrame:
        checks = leg_checks(own, baseline.outlet)
        return checks.join(
            leg_conductance(own, baseline.manifold), on=LEG_KEY, how="full", coalesce=True, validate="m:1"
        )

    return finite(of_each_aircraft(samples, found)).sort(LEG_KEY)


def _frozen(plain: dict[str, Any]) -> dict[str, Any]:
    """Lists as tuples, as the laws hold them."""
    return {k: _tuple(v) for k, v in plain.items()}


def _tuple(value: Any) -> Any:
    return tuple(_tuple(v) for v in value) if isinstance(value, list) else value
