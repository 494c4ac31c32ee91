"""The prognosis layer on NASA's turbofans: `python -m benchmarks.cmapss --data DIR`.

Claim: RMSE <= 12.5 cycles on the 100 test engines of FD001 against the true remaining lives as published (uncapped),
and intervals that cover 88 to 92 % at 90 %. Published: LSTM 16.1, DCNN 12.6, the best 10.5 to 11.5, most of
them against lives capped at 125, which is easier; both are printed. DIR holds
train_FD001.txt.gz, test_FD001.txt.gz, RUL_FD001.txt.

The layer is the one exchangers get: causal features of a health track (`feature_rows`), the discrete-time hazard
(`fit_hazard`), and interval levels from engines held out (`learn_levels`). Only the health track is this file's own.
"""

import argparse
import gzip
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

from hdt_core.prognosis.hazard import EDGES, event_by, fit_hazard, hazards, position, quantile
from hdt_core.prognosis.history import FEATURES, SEEN, Panel, feature_rows, record_rows
from hdt_core.prognosis.metrics import interval_score

Array = NDArray[np.float64]

HEALTHY_CYCLES = 125.0
"""A remaining life beyond this can't be told from any other: the set's usual limit, used for training by everyone."""
MEMBERS, FOLDS = 5, 5


@dataclass(frozen=True)
class Engines:
    """Recorded rows: engine, cycle, sensors; sorted by engine and cycle."""

    unit: Array
    cycle: Array
    sensors: Array

    @property
    def last(self) -> NDArray[np.int_]:
        """Row of each engine's last cycle."""
        return np.append(np.nonzero(np.diff(self.unit))[0], self.unit.size - 1)

    @property
    def left(self) -> Array:
        """Cycles to the last one recorded."""
        count = np.diff(np.append(-1, self.last))
        return np.repeat(self.cycle[self.last], count) - self.cycle


@dataclass(frozen=True)
class Track:
    """How sensors become one health track: standardised, weighed, summed. Learned from training engines only."""

    mean: Array
    spread: Array
    weight: Array
    limit: float = 1.0
    """Loss at which engines end: the middle of those that teach. [-]"""

    def __call__(self, engines: Engines) -> tuple[Array, Array]:
        """Smoothed loss (0 healthy, 1 failed) and smoothed standardised sensors, causal."""
        z = (engines.sensors - self.mean) / self.spread
        loss = np.column_stack([z, np.ones(len(z))]) @ self.weight
        return smoothed(loss[:, None], engines.unit, 0.12)[:, 0], smoothed(z, engines.unit, 0.1)


def load(path: Path) -> Engines:
    with gzip.open(path) as file:
        rows = np.loadtxt(file)
    return Engines(rows[:, 0], rows[:, 1], rows[:, 5:26])


def learn_track(train: Engines) -> Track:
    """Least squares of the share of life used in the last 125 cycles on the sensors that move at all."""
    spread = train.sensors.std(axis=0)
    still = spread < 1e-6
    spread = np.where(still, np.inf, spread)
    mean = train.sensors.mean(axis=0)
    z = (train.sensors - mean) / spread
    used = np.clip(1.0 - train.left / HEALTHY_CYCLES, 0.0, 1.0)
    weight = np.linalg.lstsq(np.column_stack([z, np.ones(len(z))]), used, rcond=None)[0]
    track = Track(mean, spread, weight)
    return replace(track, limit=float(np.median(track(train)[0][train.last])))


def smoothed(values: Array, unit: Array, gain: float) -> Array:
    """Exponential mean within an engine; the first cycles are averaged, not forgotten."""
    out, count = np.empty_like(values), 0
    for k in range(len(values)):
        count = 1 if k == 0 or unit[k] != unit[k - 1] else count + 1
        before = values[k] if count == 1 else out[k - 1]
        out[k] = before + max(gain, 1.0 / count) * (values[k] - before)
    return out


def features(engines: Engines, track: Track) -> Array:
    """One row a cycle: the layer's history features of the health track, and the sensors themselves."""
    loss, sensors = track(engines)
    unit = np.unique(engines.unit, return_inverse=True)[1]
    column = (engines.cycle - 1).astype(int)
    level = np.full((unit.max() + 1, column.max() + 1), np.nan)
    level[unit, column] = loss
    age = np.broadcast_to(np.arange(level.shape[1], dtype=float), level.shape)
    ratio, unknown = np.log1p(-np.minimum(level, 0.95)), np.full_like(level, np.nan)
    panel = Panel(level, np.full_like(level, 0.1), age, ratio, unknown, unknown, unknown, unknown)
    # an engine asks for nothing that differs from cycle to cycle: it ends at a limit, as a compressor does
    critical = np.full_like(level, np.log1p(-min(track.limit, 0.95)))
    told = feature_rows(record_rows(panel, (unit, column)), critical, (unit, column))
    known = np.array([name not in SEEN for name in FEATURES])
    return np.column_stack([told[:, known], sensors[:, np.isfinite(track.spread)]])


def fit(x: Array, left: Array, seed: int) -> list[HistGradientBoostingClassifier]:
    return [fit_hazard(x, left, np.ones(left.size, bool), seed + k, share=0.6) for k in range(MEMBERS)]


def expected_left(by: Array) -> Array:
    """Mean of the remaining life, no more than `HEALTHY_CYCLES`: the area under the survival curve up to there."""
    inside = EDGES[EDGES <= HEALTHY_CYCLES]
    alive = 1.0 - by[:, : inside.size]
    return np.asarray((0.5 * (alive[:, 1:] + alive[:, :-1]) * np.diff(inside)).sum(axis=1))


def held_out(x: Array, engines: Engines) -> Array:
    """P(event by t) of every training row from models that never saw its engine."""
    by = np.empty((len(x), EDGES.size))
    for fold in range(FOLDS):
        inside = engines.unit % FOLDS == fold
        models = [fit_hazard(x[~inside], engines.left[~inside], np.ones((~inside).sum(), bool), fold, share=0.6)]
        by[inside] = event_by(hazards(models, x[inside]))
    return by


def interval_levels(by: Array, engines: Engines, seed: int = 0) -> tuple[float, float]:
    """Quantile levels that cover 90 % of held-out engines, each cut at a random cycle as the test engines are."""
    rng = np.random.default_rng(seed)
    first = np.append(0, engines.last[:-1] + 1)
    spans = list(zip(first, engines.last, strict=True))
    cut = np.array([rng.integers(a + 30, b + 1) for a, b in spans for _ in range(20)])
    at = position(by[cut], engines.left[cut])
    low, high = np.quantile(at, [0.05, 0.95])
    return float(low), float(high)


def run(data: Path) -> dict[str, float]:
    """Figures of the claim."""
    train, test = load(data / "train_FD001.txt.gz"), load(data / "test_FD001.txt.gz")
    truth = np.loadtxt(data / "RUL_FD001.txt")
    track = learn_track(train)
    x, asked = features(train, track), features(test, track)[test.last]
    by = event_by(hazards(fit(x, train.left, seed=0), asked))
    said = expected_left(by)
    levels = interval_levels(held_out(x, train), train)
    low, high = quantile(by, levels[0]), quantile(by, levels[1])
    capped = np.minimum(truth, HEALTHY_CYCLES)
    return {
        "rmse_uncapped_cycles": float(np.sqrt(np.mean((said - truth) ** 2))),
        "rmse_capped_125_cycles": float(np.sqrt(np.mean((said - capped) ** 2))),
        "mae_uncapped_cycles": float(np.abs(said - truth).mean()),
        "bias_uncapped_cycles": float((said - truth).mean()),
        "interval_90_coverage": float(((low <= truth) & (truth <= high)).mean()),
        "interval_90_width_cycles": float((high - low).mean()),
        "interval_90_score_cycles": float(interval_score(truth, low, high).mean()),
        "engines": float(truth.size),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    for name, value in run(parser.parse_args().data).items():
        print(f"{name} {value:.4g}")


if __name__ == "__main__":
    main()
