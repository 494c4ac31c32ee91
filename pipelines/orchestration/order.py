"""The order of a night's runs, which follows from what the stages are made from.

A run has one kind of partition, so the chain takes several.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pipelines.lineage import Stage


class Step(NamedTuple):
    """What is made in one run: stages of one grain, parents before children."""

    stages: tuple[Stage, ...]

    @property
    def grain(self) -> str:
        """Partition that is made."""
        return self.stages[0].grain

    @property
    def label(self) -> str:
        """What the run is called."""
        return next((stage.label for stage in self.stages if stage.label), self.stages[0].name)

    @property
    def folded(self) -> int:
        """How many times as many flights the run may take as one that reads files."""
        return min(stage.size for stage in self.stages)


def steps(stages: Iterable[Stage]) -> list[Step]:
    """Few runs in which every stage comes after what it is made from.

    From the end backwards: of the stages that nothing left depends on the last declared is taken, and with it all of
    its grain and road, so each is made as late as it can be.

    Raises
    ------
    ValueError
        Where stages are made from each other in a circle.
    """
    left, found = list(stages), list[Step]()
    while left:
        taken = _last_run(left)
        left = [stage for stage in left if stage not in taken]
        found.insert(0, Step(tuple(taken)))
    return found


def _last_run(stages: Sequence[Stage]) -> list[Stage]:
    """Stages of one grain and road, in order, that may all be made after the others."""
    left, taken = list(stages), list[Stage]()
    while free := [s for s in _leaves(left) if not taken or (s.grain, s.road) == (taken[0].grain, taken[0].road)]:
        left.remove(free[-1])
        taken.insert(0, free[-1])
    if not taken:
        raise ValueError(f"stages are made from each other in a circle: {', '.join(s.name for s in stages)}")
    return taken


def _leaves(stages: Sequence[Stage]) -> list[Stage]:
    """Stages whose tables none of them is made from."""
    read = {table for stage in stages for table in (*stage.parents, *stage.untracked)}
    return [stage for stage in stages if not read & set(stage.tables)]
