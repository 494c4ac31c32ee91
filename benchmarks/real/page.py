"""Section of the page for a recipe and its result."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness import DOCS, markdown
from benchmarks.real.recipe import Recipe, Result, Score

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
