"""Store checkpoints as rows of a table: hypotheses about a pack at the start of a segment of its flights."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.records.keys import PACK
from hdt_core.tables.twin import TwinCheckpoints
from hdt_core.tracking.hypotheses import Hypotheses, join

STATES = 5
LABELS = ("log_weight", "pace", "since", "unlogged", "faulty")
TRACK = [*PACK, "component", "parameter"]
PLACE = [*TRACK, "chapter"]
CHECKPOINT_KEY = [*PLACE, "seen"]
"""Of a segment; and with the digest of the flights before it. The table calls a segment a chapter."""
_EMPTY = pl.DataFrame(schema=TwinCheckpoints.types())


class Restart(NamedTuple):
    """Restart of packs: the segment of each (packs,), hypotheses at its start, rows that stay valid."""

    begin: Array
    checkpoints: dict[tuple[int, int], Hypotheses]
    valid: pl.DataFrame


def read_checkpoints(rows: pl.DataFrame | None, packs: pl.DataFrame, digests: list[list[str]]) -> Restart:
    """Select checkpoints before which no flight has changed; without `rows` every pack starts at its first flight.

    Smoothing reaches to the end of the next segment: the last segment whose earlier flights are all unchanged has
    changed the smoothed values of the one before it, so that one is filtered again.

    Parameters
    ----------
    rows : DataFrame, optional
        Of `checkpoint_rows`.
    packs : DataFrame
        `TRACK`, in order.
    digests : list of list of str
        Of `flight_panel.fingerprints`: digest of each pack's flights before each segment.
    """
    now = [(*packs.row(p), c, digest) for p, segments in enumerate(digests) for c, digest in enumerate(segments)]
    keys = pl.DataFrame(now, schema=_EMPTY.select(CHECKPOINT_KEY).schema, orient="row")
    rows = _EMPTY if rows is None else rows.select(_EMPTY.columns)
    valid = rows.join(keys, on=CHECKPOINT_KEY, how="semi").sort(*CHECKPOINT_KEY, "history")
    segments_of: dict[int, set[int]] = {p: {0} for p in range(packs.height)}
    number = {row: p for p, row in enumerate(packs.rows())}
    for *pack, segment in valid.select(PLACE).unique().rows():
        segments_of[number[tuple(pack)]].add(segment)
    begin = {p: max((c - 1 for c in segments if c - 1 in segments), default=0) for p, segments in segments_of.items()}
    checkpoints = {}
    restart_places = _places((*packs.row(p), c) for p, c in begin.items() if c)
    for key, own in valid.join(restart_places, on=PLACE, how="semi").group_by(PLACE, maintain_order=True):
        checkpoints[number[key[:-1]], int(str(key[-1]))] = _hypotheses(own)
    return Restart(np.array([begin[p] for p in range(packs.height)], dtype=np.int64), checkpoints, valid)


def checkpoint_rows(
    packs: pl.DataFrame, digests: list[list[str]], restart: Restart, starts: Mapping[tuple[int, int], Hypotheses]
) -> pl.DataFrame:
    """Return rows of the checkpoints that stay valid and of new ones; the first segment needs none."""
    valid = restart.valid.join(_places((*packs.row(p), c) for p, c in starts), on=PLACE, how="anti")
    places = [place for place in sorted(starts) if place[1]]
    rows = _rows([(*packs.row(p), c, digests[p][c]) for p, c in places], [starts[place] for place in places])
    return pl.concat([valid, rows]).sort(*CHECKPOINT_KEY, "history")


def _places(rows: Iterable[tuple[Any, ...]]) -> pl.DataFrame:
    return pl.DataFrame(list(rows), schema=_EMPTY.select(PLACE).schema, orient="row")


def _rows(keys: list[tuple[Any, ...]], parts: list[Hypotheses]) -> pl.DataFrame:
    if not parts:
        return _EMPTY
    b, counts = join(parts), [len(part.pack) for part in parts]
    columns: dict[str, Any] = {c: getattr(b, c) for c in LABELS}
    columns |= {"mean": b.mean.tolist(), "cov": b.cov.reshape(len(b.pack), STATES**2).tolist()}
    columns |= {"history": np.concatenate([np.arange(n) for n in counts])}
    rows = pl.DataFrame(keys, schema=_EMPTY.select(CHECKPOINT_KEY).schema, orient="row")
    return TwinCheckpoints.conform(
        pl.concat([rows[np.repeat(np.arange(len(keys)), counts)], pl.DataFrame(columns)], how="horizontal")
    )


def _hypotheses(rows: pl.DataFrame) -> Hypotheses:
    n = rows.height
    labels = {c: rows[c].to_numpy() for c in LABELS}
    mean, cov = (np.array(rows[c].to_list(), dtype=float) for c in ("mean", "cov"))
    identity = {"pack": np.zeros(n, dtype=np.int64), "parent": np.arange(n), "retention": np.ones((n, STATES))}
    return Hypotheses(mean=mean, cov=cov.reshape(n, STATES, STATES), **labels, **identity)
