"""Baseline of a fleet's nominal legs, learned once in its commissioning window, and indicators of legs against it."""

import json
from dataclasses import asdict, dataclass, field

import polars as pl

from hdt_core.flight.control_schedule import ControlSchedule
from hdt_core.flight.cross_checks import leg_checks
from hdt_core.flight.manifold import Manifold, leg_conductance
from hdt_core.flight.nominal import IndexLevel, Scatter
from hdt_core.loading import with_tuples
from hdt_core.records.keys import LEG, of_each_aircraft
from hdt_core.tables.base import finite


@dataclass(frozen=True, slots=True)
class NominalBaseline:
    """Laws of a fleet's nominal legs, against which each leg is compared."""

    manifold: Manifold | None = None
    outlet: ControlSchedule | None = None
    level: IndexLevel = field(default_factory=IndexLevel)
    scatter: Scatter | None = None

    def to_json(self) -> str:
        """Return the baseline as JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "NominalBaseline":
        """Read a baseline from JSON."""
        plain = with_tuples(json.loads(text))
        kinds = {"manifold": Manifold, "outlet": ControlSchedule, "level": IndexLevel, "scatter": Scatter}
        return cls(**{name: kind(**plain[name]) for name, kind in kinds.items() if plain[name]})


def leg_indicators(samples: pl.DataFrame, baseline: NominalBaseline) -> pl.DataFrame:
    """Compute indicators leg by leg, each from its own samples: level, unrest, count of the index, means of checks."""

    def indicators(own: pl.DataFrame) -> pl.DataFrame:
        checks = leg_checks(own, baseline.outlet)
        return checks.join(leg_conductance(own, baseline.manifold), on=LEG, how="full", coalesce=True, validate="m:1")

    return finite(of_each_aircraft(samples, indicators)).sort(LEG)
