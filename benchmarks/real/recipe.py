"""Recipe of a data set: source, published results, and ours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import ge, gt, le, lt
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

Array = NDArray[np.float64]
DRAWS = 1000


@dataclass(frozen=True, slots=True)
class Score:
    """One figure with a 90 % bootstrap interval over lives, engines or runs."""

    name: str
    value: float
    low: float
    high: float
    goal: str
    """Such as `< 16.2`, `>= 0.80` or `0.88-0.92`; empty where none was set."""

    @property
    def is_met(self) -> bool | None:
        """Return whether the value meets its goal; None where none is set."""
        words = self.goal.split()
        if not words:
            return None
        if len(words) == 1:
            low, high = map(float, words[0].split("-"))
            return low <= self.value <= high
        bound = float(words[1])
        return bool({"<": lt, "<=": le, ">": gt, ">=": ge}[words[0]](self.value, bound))


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a recipe."""

    scores: list[Score]
    draw: Callable[[Figure], None] | None = None
    words: str = ""
    """What a reader must know beside the table; failures first."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """One data set.

    Attributes
    ----------
    name, title : str
        The plot's file name; the heading.
    folder : str
        Below the folder that is given; of several, any.
    wants : str
        A file in it without which there is nothing to run; empty where something can be told without.
    source, licence : str
        Where to get it, under what terms.
    anchor : str
        The published number to hold ours against, and who published it.
    run : callable
        From the folder to what was found.
    """

    name: str
    title: str
    folder: str
    wants: str
    source: str
    licence: str
    anchor: str
    run: Callable[[Path], Result]

    def find_folder(self, data: Path) -> Path | None:
        """Find its folder below `data`; None where it is absent."""
        if not self.wants:
            return data / self.folder
        return next((p for p in sorted(data.glob(self.folder)) if any(p.glob(self.wants))), None)


def scored(
    name: str, goal: str, groups: Sequence[int] | NDArray[np.int_], metric: Callable[[NDArray[np.int_]], float]
) -> Score:
    """A metric of rows, with the 5 and 95 % points when whole groups (lives, runs) are drawn again.

    Parameters
    ----------
    name, goal : str
        As in `Score`.
    groups : sequence of int
        The group of each row: rows of one life aren't independent.
    metric : callable
        Of the rows with these numbers.
    """
    own = np.asarray(groups)
    rows = [np.flatnonzero(own == g) for g in np.unique(own)]
    rng = np.random.default_rng(0)
    resampled = [metric(np.concatenate([rows[k] for k in rng.integers(0, len(rows), len(rows))])) for _ in range(DRAWS)]
    low, high = np.nanquantile(resampled, [0.05, 0.95])
    return Score(name, metric(np.arange(own.size)), float(low), float(high), goal)
