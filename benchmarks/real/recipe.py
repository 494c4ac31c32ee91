"""Recipe of a data set: source, published results, and ours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import ge, gt, le, lt
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.harness import DOCS, markdown

Array = NDArray[np.float64]
Index = NDArray[np.int_]
Flags = NDArray[np.bool_]
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
    name: str,
    goal: str,
    groups: Sequence[int] | Index,
    metric: Array | Callable[[Index], float],
) -> Score:
    """A metric of rows, with the 5 and 95 % points when whole groups (lives, runs) are drawn again.

    Parameters
    ----------
    name, goal : str
        As in `Score`.
    groups : sequence of int
        The group of each row: rows of one life aren't independent.
    metric : array or callable
        A value of each row, of which the mean counts; or a function of the rows with these numbers.
    """
    of = metric if callable(metric) else lambda i: float(metric[i].mean())
    own = np.asarray(groups)
    rows = [np.flatnonzero(own == g) for g in np.unique(own)]
    rng = np.random.default_rng(0)
    resampled = [of(np.concatenate([rows[k] for k in rng.integers(0, len(rows), len(rows))])) for _ in range(DRAWS)]
    low, high = np.nanquantile(resampled, [0.05, 0.95])
    return Score(name, of(np.arange(own.size)), float(low), float(high), goal)


PAGE = DOCS / "real.md"
MARKS = {True: "yes", False: "**no**", None: ""}


def described(recipe: Recipe, result: Result | None, plot: str | None = None) -> str:
    """A section of the page."""
    head = [
        f"### {recipe.title}",
        f"- **From**: {recipe.source}. Licence: {recipe.licence}. Folder `{recipe.folder}`.",
        f"- **Published**: {recipe.anchor}.",
    ]
    if result is None:
        return "\n".join([*head, "", "Not run here: its files are absent."])
    lines = ["", markdown([["figure", "value", "90 % interval", "goal", "held"], *map(_row, result.scores)])]
    tail = ["", result.words] if result.words else []
    return "\n".join([*head, *lines, *tail, *(["", f"![{recipe.title}](plots/{plot})"] if plot else [])])


def plotted(recipe: Recipe, result: Result, folder: Path) -> str | None:
    """The recipe's plot as a file, and its name."""
    if result.draw is None:
        return None
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    result.draw(figure)
    name = f"real_{recipe.name}.png"
    figure.savefig(folder / name, dpi=90, metadata={"Software": None})
    return name


def _row(s: Score) -> list[str]:
    interval = f"{s.low:.3g} to {s.high:.3g}" if np.isfinite(s.low) else ""
    goal = s.goal.replace(">=", "≥").replace("<=", "≤")
    return [s.name, f"{s.value:.3g}", interval, goal, MARKS[s.is_met]]
