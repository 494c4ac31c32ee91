"""Order a night's runs by the stages' parents.

A run has one kind of partition, so the chain takes several.
"""

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

from pipelines.lineage import UPSTREAM, Stage


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

    def tables(self, stale: Collection[str]) -> list[str]:
        """List the tables of the `stale` stages, by name, and of those that follow from them."""
        tables = list[str]()
        for stage in self.stages:
            if stage.name in stale or not UPSTREAM[stage.name].isdisjoint(tables):
                tables += stage.tables
        return tables


def steps(stages: Iterable[Stage]) -> list[Step]:
    """Group stages into few runs in which every stage comes after its parents.

    From the end backwards: among the stages without remaining children, pick the last declared, with all of its grain,
    so that each stage runs as late as it can.

    Raises
    ------
    ValueError
        Where the stages' parents form a cycle.
    """
    remaining, ordered_steps = list(stages), list[Step]()
    while remaining:
        last = list[Stage]()
        while leaves := [s for s in _leaf_stages(remaining) if not last or s.grain == last[0].grain]:
            remaining.remove(leaves[-1])
            last.insert(0, leaves[-1])
        if not last:
            raise ValueError(f"stages form a cycle: {', '.join(s.name for s in remaining)}")
        ordered_steps.insert(0, Step(tuple(last)))
    return ordered_steps


def _leaf_stages(stages: Sequence[Stage]) -> list[Stage]:
    """Return stages whose tables no other stage reads."""
    parents = {table for stage in stages for table in (*stage.parents, *stage.untracked)}
    return [stage for stage in stages if not parents & set(stage.tables)]
