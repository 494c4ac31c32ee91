"""Simulated faults on real nominal legs (Pujana et al. 2023), as far as a health track goes.

What the twin says of a sound unit is its own noise: weather, sensors, filter. A wear curve laid over it makes a failing
unit as this very fleet would have shown it, whose end is known.
"""

from dataclasses import replace

import numpy as np
import polars as pl

from benchmarks.contestants import Asked, together
from hdt_core.prognosis.limits import PRIORS, learn_limit
from hdt_core.prognosis.rows import Tracks, fleet_rows, message_levels, tracks
from hdt_core.simulate.wear import WearSettings, draw_wear

COPIES = 30
"""Wear curves laid over each nominal stretch."""
SOUND, SHORTEST = 0.08, 60
"""Loss below which a stretch is nominal, and flights it must have."""


def own_rows(features: pl.DataFrame, lives: pl.DataFrame) -> Asked:
    """Rows of a fleet's lives with the health history as inputs."""
    track = tracks(features, lives, "HX")
    rows = fleet_rows(track, PRIORS["HX"])
    frame = track.keys.select("tail", "flight_id", "pack", "life_id")
    return Asked(frame, {"health": rows.features}, rows.left, rows.failed, rows.life)


def augmented(features: pl.DataFrame, lives: pl.DataFrame, seed: int = 0) -> Asked:
    """A fleet's own rows, and those of wear laid over its nominal stretches until the limit that it has shown."""
    track = tracks(features, lives, "HX")
    limit = learn_limit(message_levels(track)[0], PRIORS["HX"])
    rng = np.random.default_rng(seed)
    made = [own_rows(features, lives)]
    known = np.isfinite(track.value)
    sound = np.nonzero((np.where(known, track.value, 0.0).max(axis=1) < SOUND) & (known.sum(axis=1) >= SHORTEST))[0]
    for unit in sound:
        noise = track.value[unit, known[unit]] - np.median(track.value[unit, known[unit]])
        made.append(_laid_over(rng, noise, float(np.nanmedian(track.sd[unit])), limit.mean, limit.unit_sd, int(unit)))
    return together(made)


def _laid_over(
    rng: np.random.Generator, noise: np.ndarray, sd: float, limit: float, unit_sd: float, unit: int
) -> Asked:
    flights = 400
    wear = draw_wear(rng, np.zeros(COPIES), flights, replace(WearSettings(), reference_loss=limit)).loss
    over = wear > limit + unit_sd * rng.standard_normal((COPIES, 1))
    message = np.where(over.any(axis=1), over.argmax(axis=1), flights)
    start = rng.integers(0, noise.size, COPIES)
    seen = 1.0 - (1.0 - wear) * (1.0 - noise[(start[:, None] + np.arange(flights)) % noise.size])
    life, column = np.nonzero(np.arange(flights)[None, :] < message[:, None])
    blank = np.full(wear.shape, np.nan)
    keys = pl.DataFrame({"tail": [f"laid over {unit}"] * life.size, "life_id": life})
    track = Tracks(
        value=seen, sd=np.full(wear.shape, sd), age=np.broadcast_to(np.arange(flights, dtype=float), wear.shape),
        door=blank, at=np.column_stack([life, column]), keys=keys, left=(message[life] - column).astype(float),
        failed=message[life] < flights,
    )  # fmt: skip
    rows = fleet_rows(track, PRIORS["HX"])
    frame = keys.select("tail", pl.lit("").alias("flight_id"), pl.lit(1, pl.Int32).alias("pack"), "life_id")
    return Asked(frame, {"health": rows.features}, rows.left, rows.failed, rows.life)
