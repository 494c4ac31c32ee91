"""Simulated faults on real nominal legs (Pujana et al. 2023), as far as a health track goes.

What the twin says of a sound unit is its own noise: weather, sensors, filter. A wear curve laid over it makes a failing
unit as this very fleet would have shown it, on the flights that it flew, whose end is known.
"""

from dataclasses import replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from benchmarks.contestants import Array, Asked, together
from hdt_core.margin.conditions import repeated
from hdt_core.margin.exchanger_demand import EXCESS_K, SHARES
from hdt_core.margin.margin import MessageRule, at_excess
from hdt_core.prognosis.feature_rows import PRIOR_RULES, Tracks, fleet_rows, learn_rule, tracks
from hdt_core.prognosis.history import Panel, record_rows
from hdt_core.simulate.wear import WearSettings, draw_wear

COPIES, FLIGHTS = 30, 400
"""Wear curves laid over each nominal stretch, and flights each is followed."""
SOUND, SHORTEST = 0.08, 60
"""Loss below which a stretch is nominal, and flights it must have."""


def own_rows(features: pl.DataFrame, lives: pl.DataFrame) -> Asked:
    """Rows of a fleet's lives with the health history as inputs."""
    return _asked(tracks(features, lives, "HX"))


def augmented(features: pl.DataFrame, lives: pl.DataFrame, seed: int = 0) -> Asked:
    """A fleet's own rows, and those of wear laid over its nominal stretches until the message by the rule it showed."""
    track = tracks(features, lives, "HX")
    rule = learn_rule(track, "HX", ~track.mute)
    assert isinstance(rule, dict)
    rng = np.random.default_rng(seed)
    made = [_asked(track)]
    level = track.panel.level
    known = np.isfinite(level)
    sound = np.nonzero((np.where(known, level, 0.0).max(axis=1) < SOUND) & (known.sum(axis=1) >= SHORTEST))[0]
    for unit in sound:
        row = _rows_of(track, int(unit))
        operator = str(track.keys["operator"][int(row[0])])
        made.append(_asked(_laid_over(rng, track, row, rule.get(operator, rule[""]))))
    return together(made)


def _rows_of(track: Tracks, unit: int) -> NDArray[np.int_]:
    """The row of each flight of known health of a life."""
    own = np.nonzero((track.at[:, 0] == unit) & (track.at[:, 1] >= 0))[0]
    return own[np.unique(track.at[own, 1], return_index=True)[1]]


def _laid_over(rng: np.random.Generator, track: Tracks, row: NDArray[np.int_], rule: MessageRule) -> Tracks:
    """Wear over the flights of one sound life, which are flown again and again from a flight of their own."""
    curves, ratio = track.curves[tuple(track.where[row].T)], track.panel.ratio[tuple(track.at[row].T)]
    flight = (rng.integers(0, row.size, (COPIES, 1)) + np.arange(FLIGHTS)) % row.size
    middle = float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else 0.0
    worn = np.log1p(-draw_wear(rng, np.zeros(COPIES), FLIGHTS, _reaching(middle, curves, rule)).loss)
    asked = curves[flight]
    critical = at_excess(asked[:, :, SHARES.index(rule.share)], rule.excess_k)
    hot = middle + worn < repeated(critical, rule.of)
    message = np.where(hot.any(axis=1), hot.argmax(axis=1), FLIGHTS)
    panel = _worn_panel(track.panel, tuple(track.at[row].T), flight, worn, _overheat_k(middle + worn, asked))
    life, column = np.nonzero(np.arange(FLIGHTS)[None, :] < message[:, None])
    at = np.column_stack([life, column])
    whose = track.keys.select("operator", "pack", "departed_at")[int(row[0])]
    keys = pl.DataFrame({"tail": f"laid over {track.at[row[0], 0]}", "flight_id": "", "life_id": life})
    return Tracks(
        panel=panel, at=at, record=record_rows(panel, (life, column)), curves=asked, where=at,
        keys=keys.join(whose, how="cross"), left=(message[life] - column).astype(float), failed=message[life] < FLIGHTS,
        mute=np.zeros(life.size, bool),
    )  # fmt: skip


def _worn_panel(panel: Panel, at: tuple, flight: NDArray[np.int_], worn: Array, overheat_k: Array) -> Panel:
    """What the twin and the sensors would have said, flights `flight` of the life at `at` flown so much more worn."""
    level, sd, ratio, full_open, day = (
        getattr(panel, name)[at] for name in ("level", "sd", "ratio", "full_open", "day")
    )
    # where a share of the samples is above its level, the door is full open in so many
    opened = (np.array(SHARES)[:, None, None] * (overheat_k > 0.0)).max(axis=0)
    return Panel(
        level=1.0 - np.exp(worn) * (1.0 - (level - np.median(level))[flight]),
        sd=np.full(worn.shape, float(np.nanmedian(sd))),
        age=np.broadcast_to(np.arange(FLIGHTS, dtype=float), worn.shape),
        ratio=ratio[flight] + worn,
        overheat_k=overheat_k[0],
        overheat_half_k=overheat_k[1],
        full_open=np.fmax(full_open[flight], opened),
        day=day[flight],
    )


def _reaching(middle: float, curves: Array, rule: MessageRule) -> WearSettings:
    """Wear whose nominal life ends where a flight in two would be hot."""
    asked = at_excess(curves[:, SHARES.index(rule.share)], rule.excess_k)
    if not np.isfinite(asked).any():
        return WearSettings()
    return replace(WearSettings(), reference_loss=float(np.clip(-np.expm1(np.nanmedian(asked) - middle), 0.05, 0.9)))


def _overheat_k(left: Array, curves: Array) -> Array:
    """Outlet above its level at a ln conductance ratio, none below 0: curves over `EXCESS_K` turned round. [K]

    (copies, flights) and (copies, flights, shares, excesses) to (shares, copies, flights).
    """
    each = np.repeat(left.ravel(), len(SHARES))
    flat = zip(each, curves.reshape(-1, len(EXCESS_K)), strict=True)
    found = [np.interp(-at, -c, EXCESS_K) if np.isfinite(c).all() else np.nan for at, c in flat]
    return np.maximum(np.moveaxis(np.array(found).reshape(*left.shape, len(SHARES)), -1, 0), 0.0)


def _asked(track: Tracks) -> Asked:
    rows = fleet_rows(track, PRIOR_RULES["HX"])
    frame = track.keys.select("tail", "flight_id", "pack", "life_id")
    return Asked(frame, {"health": rows.features}, rows.left, rows.failed, rows.life)
