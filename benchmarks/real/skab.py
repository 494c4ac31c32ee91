"""SKAB: runs of a water rig with one fault each; all there is to learn from are the first 400 rows of a run.

Files `*.csv`, in one folder or in `valve1`, `valve2` and `other`: `datetime;` eight sensors `;anomaly;changepoint`.
Scored by row, over the rows after those that were learned from. The detector has the settings of the product.

Each sensor is foretold from all others by their covariance on normal rows (shrunk, Ledoit and Wolf 2004); what is left,
in standard deviations, goes to the CUSUM that watches a pack's witnesses.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure
from sklearn.covariance import LedoitWolf

from benchmarks.real.recipe import Array, Flags, Recipe, Result, scored
from hdt_core.health.detection import Cusum, watch

LEARN_SHARE, BLOCKS = 0.5, (10, 30, 60)
"""Of the normal rows the first teach what a sensor should say, the others how far its residual wanders in blocks."""
STILL = 1e-9
TAIL = 1000


@dataclass(frozen=True, slots=True)
class Normal:
    """Learned from normal rows."""

    mean: Array
    spread: Array
    precision: Array

    def residuals(self, rows: Array) -> Array:
        """Return each sensor minus its prediction from the others, in standard deviations; NaN stays NaN."""
        z = np.clip((rows - self.mean) / self.spread, -50.0, 50.0)
        own = np.sqrt(np.diag(self.precision))
        predicted = (np.nan_to_num(z) @ self.precision) / own
        return np.where(np.isnan(z), np.nan, predicted)


def learn(rows: Array) -> Normal:
    """Mean, spread and precision of normal rows; a sensor that never moves says nothing."""
    mean = np.nanmean(rows, axis=0)
    spread = np.nanstd(rows, axis=0)
    spread = np.where(spread > STILL, spread, np.inf)
    z = np.nan_to_num((rows - mean) / spread)
    jitter = np.random.default_rng(0).standard_normal(z.shape)  # a sensor that stands still has a variance
    return Normal(mean, spread, LedoitWolf().fit(z + 1e-6 * jitter).precision_)


def alarms(train: Array, test: Array) -> Flags:
    """Return the rows of `test` on which a sensor shift is detected.

    The detector learns offset and scatter on the last `TAIL` rows of `train`.
    """
    split = int(LEARN_SHARE * len(train))
    normal = learn(train[:split])
    scale = wander(normal.residuals(train[split:]))
    z = np.concatenate([normal.residuals(train[-TAIL:]), normal.residuals(test)])[None] / scale
    prior = np.ones(z.shape[2])
    watch_result = watch(z, prior, np.zeros(z.shape, dtype=bool), Cusum())
    return np.asarray(watch_result.alarm[0, -len(test) :].any(axis=1)) if len(test) else np.zeros(0, dtype=bool)


def wander(residuals: Array) -> Array:
    """How much more the mean of a block of rows scatters than independent rows would; at least 1, of each sensor.

    A CUSUM takes rows for independent; those of a process seldom are.
    """
    scatter = np.ones(residuals.shape[1])
    for rows in BLOCKS:
        blocks = np.nan_to_num(residuals[: len(residuals) // rows * rows]).reshape(-1, rows, residuals.shape[1])
        scatter = np.fmax(scatter, np.sqrt(rows * (blocks.mean(axis=1) ** 2).mean(axis=0)))
    return scatter


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
    truth = []
    called_rows = []
    group = []
    for number, file in enumerate(files(folder)):
        sensors, wrong = read(file)
        rows = sensors.to_numpy()
        truth.append(wrong[LEARN_ROWS:])
        called_rows.append(alarms(rows[:LEARN_ROWS], rows[LEARN_ROWS:]))
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
