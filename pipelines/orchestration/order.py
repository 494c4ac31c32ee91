"""Order a night's runs by the stages' parents.

A run has one kind of partition, so the chain takes several.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pipelines.lineage import Stage


class Step(NamedTuple):
    """Stages of one run: one grain, parents before children."""

    stages: tuple[Stage, ...]

    @property
    def grain(self) -> str:
        """Partition of the run."""
        return self.stages[0].grain

    @property
    def label(self) -> str:
        """Name of the run."""
        return next((stage.label for stage in self.stages if stage.label), self.stages[0].name)

    @property
    def batch_factor(self) -> int:
        """Flights that the run may take, as a multiple of those of a run that reads files."""
        return min(stage.size for stage in self.stages)


def steps(stages: Iterable[Stage]) -> list[Step]:
    """Group stages into few runs in which every stage comes after its parents.

    From the end backwards: among the stages without remaining children, pick the last declared, with all of its grain
    and road, so that each stage runs as late as it can.

    Raises
    ------
    ValueError
        Where the stages' parents form a cycle.
    """
    remaining, ordered_steps = list(stages), list[Step]()
    while remaining:
        last_stages = _last_run(remaining)
        remaining = [stage for stage in remaining if stage not in last_stages]
        ordered_steps.insert(0, Step(tuple(last_stages)))
    return ordered_steps


def _last_run(stages: Sequence[Stage]) -> list[Stage]:
    """Return stages of one grain and road, in order, that may all run after the others."""
    remaining, last = list(stages), list[Stage]()
    while free := [
        s for s in _leaf_stages(remaining) if not last or (s.grain, s.road) == (last[0].grain, last[0].road)
    ]:
        remaining.remove(free[-1])
        last.insert(0, free[-1])
    if not last:
        raise ValueError(f"stages form a cycle: {', '.join(s.name for s in stages)}")
    return last


def _leaf_stages(stages: Sequence[Stage]) -> list[Stage]:
    """Return stages whose tables no other stage reads."""
    parents = {table for stage in stages for table in (*stage.parents, *stage.untracked)}
    return [stage for stage in stages if not parents & set(stage.tables)]
