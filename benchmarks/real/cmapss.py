"""NASA's turbofans, C-MAPSS FD001 to FD004: engines run to failure teach, others are asked once each.

One setting for all four. Only the health track is this file's own: sensors standardised within each operating regime,
weighed, summed, learned from the engines that teach.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.real.lifetimes import Foretold, Rows, expected_left, foretell, history_features
from benchmarks.real.recipe import Array, Index, Recipe, Result, Score, scored
from hdt_core.prognosis.hazard import EDGES

SETS = ("FD001", "FD002", "FD003", "FD004")
PUBLISHED = dict(zip(SETS, (16.2, 19.3, 16.8, 20.0), strict=True))
HEALTHY_CYCLES = 125.0
"""A remaining life beyond this can't be told from any other: the set's usual limit, used for training by everyone."""
FOLDS = 5
FIRST_CUT = 30
"""Cycles that every test engine has flown. Levels are learned on cuts from there to the set's usual limit. [cycle]"""
STILL = 1e-6


@dataclass(frozen=True)
class Engines:
    """Recorded rows: engine, cycle, operating regime, sensors; sorted by engine and cycle."""

    unit: Index
    cycle: Index
    settings: Array
    sensors: Array

    @property
    def last(self) -> Index:
        """Row of each engine's last cycle."""
        return np.append(np.nonzero(np.diff(self.unit))[0], self.unit.size - 1)

    @property
    def left(self) -> Array:
        """Cycles to the last one recorded."""
        count = np.diff(np.append(-1, self.last))
        return np.repeat(self.cycle[self.last], count) - self.cycle.astype(float)


@dataclass(frozen=True)
class Track:
    """How sensors become one health track. Learned from teaching engines only."""

    regimes: Array
    mean: Array
    spread: Array
    weight: Array
    limit: float = 1.0
    """Loss at which engines end: the middle of those that teach. [-]"""

    def __call__(self, engines: Engines) -> tuple[Array, Array]:
        """Smoothed loss (0 healthy, 1 failed) and smoothed standardised sensors, causal."""
        z = self.standardised(engines)
        loss = np.column_stack([z, np.ones(len(z))]) @ self.weight
        return smoothed(loss[:, None], engines.unit, 0.12)[:, 0], smoothed(z, engines.unit, 0.1)

    def standardised(self, engines: Engines) -> Array:
        """Sensors against those of the nearest regime."""
        far = np.abs(regime_of(engines.settings)[:, None, :] - self.regimes[None]).sum(axis=2)
        near = far.argmin(axis=1)
        return np.asarray((engines.sensors - self.mean[near]) / self.spread[near])


def load(folder: Path, name: str) -> Engines:
    """A file as published, packed or not."""
    rows = np.loadtxt(next(folder.glob(f"{name}.txt*")))
    return Engines(rows[:, 0].astype(int) - 1, rows[:, 1].astype(int) - 1, rows[:, 2:5], rows[:, 5:26])


def regime_of(settings: Array) -> Array:
    """Altitude in thousands of feet and throttle, rounded: the flight condition that the set holds apart."""
    return np.round(settings[:, [0, 2]])


def learn_track(train: Engines) -> Track:
    """Least squares of the share of life used in the last 125 cycles on the sensors that move at all."""
    regimes, own = np.unique(regime_of(train.settings), axis=0, return_inverse=True)
    groups = [train.sensors[own.ravel() == k] for k in range(len(regimes))]
    mean, spread = (np.array([f(g, axis=0) for g in groups]) for f in (np.mean, np.std))
    spread = np.where(spread < STILL, np.inf, spread)
    track = Track(regimes, mean, spread, np.empty(0))
    z = track.standardised(train)
    used = np.clip(1.0 - train.left / HEALTHY_CYCLES, 0.0, 1.0)
    weight = np.linalg.lstsq(np.column_stack([z, np.ones(len(z))]), used, rcond=None)[0]
    track = replace(track, weight=weight)
    return replace(track, limit=float(np.median(track(train)[0][train.last])))


def smoothed(values: Array, unit: Index, gain: float) -> Array:
    """Exponential mean within an engine; the first cycles are averaged, not forgotten."""
    out = np.empty_like(values)
    count = 0
    for k in range(len(values)):
        count = 1 if k == 0 or unit[k] != unit[k - 1] else count + 1
        before = values[k] if count == 1 else out[k - 1]
        out[k] = before + max(gain, 1.0 / count) * (values[k] - before)
    return out


def features(engines: Engines, track: Track) -> Array:
    """One row a cycle: the layer's features of the health track, and the sensors themselves."""
    loss, sensors = track(engines)
    unit = np.unique(engines.unit, return_inverse=True)[1]
    moves = np.isfinite(track.spread).any(axis=0)
    return np.column_stack([history_features(loss, unit, engines.cycle, track.limit), sensors[:, moves]])


def forecast(folder: Path, name: str) -> tuple[Foretold, Array]:
    """Forecasts of the test engines of one set, and their true lives."""
    train = load(folder, f"train_{name}")
    test = load(folder, f"test_{name}")
    truth = np.loadtxt(folder / f"RUL_{name}.txt")
    track = learn_track(train)
    teach = Rows(features(train, track), train.left, train.unit, train.unit % FOLDS)
    cuts = np.flatnonzero((train.cycle >= FIRST_CUT) & (train.left <= HEALTHY_CYCLES))
    return foretell(teach, features(test, track)[test.last], cuts), truth


def phm_score(error: Array) -> float:
    """Sum over engines of the penalty of the PHM 2008 challenge (Saxena et al. 2008); late forecasts cost more."""
    return float(np.where(error < 0.0, np.expm1(-error / 13.0), np.expm1(error / 10.0)).sum())


def scores(name: str, forecast: Foretold, truth: Array) -> list[Score]:
    """Errors and intervals against lives capped at 125, as published tables have them, and uncapped."""
    engine = np.arange(truth.size)
    capped = np.minimum(truth, HEALTHY_CYCLES)
    middle, capped_middle = (expected_left(forecast.by, most) for most in (EDGES[-1], HEALTHY_CYCLES))
    errors = {"capped at 125": capped_middle - capped, "uncapped": capped_middle - truth}

    def score(what: str, goal: str, each: Array | Callable[[Index], float]) -> Score:
        return scored(f"{name}: {what}", goal, engine, each)

    def rmse(what: str, goal: str, error: Array) -> Score:
        return score(f"RMSE, {what} [cycles]", goal, lambda i: float(np.sqrt((error[i] ** 2).mean())))

    def interval(what: str, goal: str, low: Array, high: Array, left: Array) -> list[Score]:
        inside = ((low <= left) & (left <= high)).astype(float)
        return [score(f"{what}, coverage", goal, inside), score(f"{what}, width [cycles]", "", high - low)]

    wide = (np.minimum(bound, HEALTHY_CYCLES) for bound in forecast.wide)
    return [
        rmse("lives capped at 125", f"< {PUBLISHED[name]}", errors["capped at 125"]),
        rmse("lives uncapped, forecast capped", "", errors["uncapped"]),
        rmse("lives and forecast uncapped", "", middle - truth),
        *(score(f"PHM score, lives {how}", "", lambda i, e=e: phm_score(e[i])) for how, e in errors.items()),
        *interval("95 % interval, lives capped at 125", "", *wide, capped),
        *interval("90 % interval, lives uncapped", "0.88-0.92", forecast.low, forecast.high, truth),
    ]


def run(folder: Path) -> Result:
    """All sets that are there, each in a folder of its own or all in one."""
    files = {name: next(folder.parent.glob(f"cmapss*/RUL_{name}.txt"), None) for name in SETS}
    forecasts = {name: forecast(file.parent, name) for name, file in files.items() if file}

    def draw(figure: Figure) -> None:
        for k, (name, (bounds, truth)) in enumerate(forecasts.items()):
            axes = figure.add_subplot(1, len(forecasts), k + 1)
            order = np.argsort(truth)
            axes.fill_between(
                range(truth.size), bounds.low[order], bounds.high[order], alpha=0.3, label="90 % interval"
            )
            axes.plot(truth[order], "k.", ms=3, label="true")
            axes.set(title=name, xlabel="engine, by true life", ylabel="cycles left")
            axes.legend()

    absent = [name for name, file in files.items() if not file]
    words = f"Not run here, their files are absent: {', '.join(absent)}." if absent else ""
    return Result([s for name, (bounds, truth) in forecasts.items() for s in scores(name, bounds, truth)], draw, words)


RECIPE = Recipe(
    name="cmapss",
    title="Turbofans run to failure (NASA C-MAPSS FD001-FD004, a simulator of NASA's, not ours)",
    folder="cmapss*",
    wants="RUL_FD00*.txt",
    source="NASA Prognostics Center of Excellence, data set 6 (Saxena and Goebel 2008)",
    licence="work of the US Government",
    anchor="lives capped at 125: RMSE 16.2 / 19.3 / 16.8 / 20.0, 95 % intervals that cover .94-.95 (arXiv 2511.19124)",
    run=run,
)
