"""SKAB: runs of a water rig with one fault each; all there is to learn from are the first 400 rows of a run.

Files `*.csv`, in one folder or in `valve1`, `valve2` and `other`: `datetime;` eight sensors `;anomaly;changepoint`.
Scored by row, over the rows after those that were learned from. The detector has the settings of the product.
"""

from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from benchmarks.real.normal_behaviour import Flags, alarms
from benchmarks.real.recipe import Recipe, Result, scored
from hdt_core.health.detection import Cusum

LEARN_ROWS = 400
NOT_SENSORS = ("datetime", "anomaly", "changepoint")


def read(file: Path) -> tuple[pl.DataFrame, Flags]:
    """Sensors, and whether each row belongs to the fault."""
    rows = pl.read_csv(file, separator=";", try_parse_dates=True).sort("datetime")
    sensors = rows.drop(NOT_SENSORS, strict=False).cast(pl.Float64)
    return sensors, (rows["anomaly"].cast(pl.Float64) > 0.5).to_numpy()


def files(folder: Path) -> list[Path]:
    """Runs with a fault, each once."""
    return [f for f in sorted(folder.glob("**/*.csv")) if "(" not in f.name and f.stem != "anomaly-free"]


def run(folder: Path) -> Result:
    """All runs."""
    truth, called_rows, group = [], [], []
    for number, file in enumerate(files(folder)):
        sensors, wrong = read(file)
        rows = sensors.to_numpy()
        truth.append(wrong[LEARN_ROWS:])
        called_rows.append(alarms(rows[:LEARN_ROWS], rows[LEARN_ROWS:], Cusum()))
        group.append(np.full(wrong.size - LEARN_ROWS, number))
    y, called, own = (np.concatenate(v) for v in (truth, called_rows, group))

    def f1(i):
        return float(2.0 * (y & called)[i].sum() / max(y[i].sum() + called[i].sum(), 1))

    def false(i):
        return float((called & ~y)[i].sum() / max((~y)[i].sum(), 1))

    def missed(i):
        return float((~called & y)[i].sum() / max(y[i].sum(), 1))

    scores = [
        scored("F1 by row", "> 0.78", own, f1),
        scored("false alarms, share of normal rows", "< 0.15", own, false),
        scored("missed, share of the fault's rows", "", own, missed),
    ]

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for n, (wrong, alarm) in enumerate(zip(truth, called_rows, strict=True)):
            axes.plot(np.flatnonzero(wrong), np.full(wrong.sum(), n), "s", ms=2, color="0.75")
            axes.plot(np.flatnonzero(alarm), np.full(alarm.sum(), n + 0.3), "r.", ms=1)
        axes.set(xlabel="row after training", ylabel="run", title="fault (grey) and alarm (red)")

    return Result(scores, draw)


RECIPE = Recipe(
    name="skab",
    title="A water rig with valves shut (SKAB)",
    folder="skab*",
    wants="**/*.csv",
    source="Katser and Kozitsin, Skoltech Anomaly Benchmark, 2020, doi 10.34740/KAGGLE/DSV/1693952; its `data` folder",
    licence="GPL-3.0, by its repository",
    anchor="F1 .78 at 13.6 % false alarms (Conv-AE), the best on its leaderboard below 15 %",
    run=run,
)
