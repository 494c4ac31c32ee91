"""Bookmarks as rows of a table: what is known of a pack when a chapter of its flights begins, a row a history."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from hdt_core.records.keys import PACK
from hdt_core.twin.belief import Belief
from hdt_core.twin.crossing import Array

STATES = 5
PAGE = [*PACK, "chapter", "seen"]
_SCHEMA: dict[str, Any] = {
    "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "chapter": pl.Int64, "seen": pl.String,
    "history": pl.Int64, "log_weight": pl.Float64, "mean": pl.List(pl.Float64), "cov": pl.List(pl.Float64),
    "pace": pl.Int64, "since": pl.Int64, "unlogged": pl.Boolean, "faulty": pl.Boolean,
}  # fmt: skip


class Pages(NamedTuple):
    """Where packs go on: the chapter of each (packs,), the beliefs with which those begin, the bookmarks that stand."""

    begin: Array
    bookmarks: dict[tuple[int, int], Belief]
    stand: pl.DataFrame


def first_page(n_packs: int) -> Pages:
    """Every pack from its first flight."""
    return Pages(np.zeros(n_packs, dtype=np.int64), {}, pl.DataFrame(schema=_SCHEMA))


def read_pages(chapters: pl.DataFrame, packs: pl.DataFrame, seen: list[list[str]]) -> Pages:
    """Bookmarks of flights that are what they were.

    Hindsight reaches to the end of the next chapter: the last chapter whose earlier flights all stand has changed what
    is said of the one before it, so that one is gone through again.

    Parameters
    ----------
    chapters : DataFrame
        Of `written`.
    packs : DataFrame
        `PACK`, in order.
    seen : list of list of str
        Of `wave.prints`: digest of each pack's flights before each chapter.
    """
    now = [(*packs.row(p), chapter, digest) for p, own in enumerate(seen) for chapter, digest in enumerate(own)]
    valid = pl.DataFrame(now, schema={c: _SCHEMA[c] for c in PAGE}, orient="row")
    stand = chapters.select(*_SCHEMA).join(valid, on=PAGE, how="semi").sort(*PAGE, "history")
    marked: dict[int, set[int]] = {p: {0} for p in range(packs.height)}
    place = {row: p for p, row in enumerate(packs.rows())}
    for *pack, chapter in stand.select(*PACK, "chapter").unique().rows():
        marked[place[tuple(pack)]].add(chapter)
    begin = {p: max((c - 1 for c in own if c - 1 in own), default=0) for p, own in marked.items()}
    bookmarks = {}
    wanted = pl.DataFrame(
        [(*packs.row(p), c) for p, c in begin.items() if c], schema=valid.drop("seen").schema, orient="row"
    )
    for key, rows in stand.join(wanted, on=PAGE[:-1], how="semi").group_by(PAGE[:-1], maintain_order=True):
        bookmarks[place[key[:-1]], int(str(key[-1]))] = _belief(rows)
    return Pages(np.array([begin[p] for p in range(packs.height)], dtype=np.int64), bookmarks, stand)


def written(
    packs: pl.DataFrame, seen: list[list[str]], pages: Pages, new: Mapping[tuple[int, int], Belief]
) -> pl.DataFrame:
    """Rows of the bookmarks that stand and of new ones; the first chapter needs none."""
    again = pl.DataFrame([(*packs.row(p), c) for p, c in new], schema={c: _SCHEMA[c] for c in PAGE[:-1]}, orient="row")
    rows = [_rows(packs.row(p), c, seen[p][c], new[p, c]) for p, c in sorted(new) if c]
    return pl.concat([pages.stand.join(again, on=PAGE[:-1], how="anti"), *rows]).sort(*PAGE, "history")


def _rows(pack: tuple[Any, ...], chapter: int, seen: str, b: Belief) -> pl.DataFrame:
    n = len(b.pack)
    told: dict[str, Any] = {c: [v] * n for c, v in zip(PAGE, (*pack, chapter, seen), strict=True)}
    told |= {c: getattr(b, c) for c in ("log_weight", "pace", "since", "unlogged", "faulty")}
    told |= {"mean": b.mean.tolist(), "cov": b.cov.reshape(n, STATES**2).tolist(), "history": np.arange(n)}
    return pl.DataFrame(told).select(pl.col(c).cast(t) for c, t in _SCHEMA.items())


def _belief(rows: pl.DataFrame) -> Belief:
    n = rows.height
    mean, cov = (np.array(rows[c].to_list(), dtype=float) for c in ("mean", "cov"))
    pace, since, unlogged, faulty = (rows[c].to_numpy() for c in ("pace", "since", "unlogged", "faulty"))
    return Belief(
        np.zeros(n, dtype=np.int64),
        rows["log_weight"].to_numpy(),
        mean,
        cov.reshape(n, STATES, STATES),
        pace,
        since,
        unlogged,
        faulty,
        np.arange(n),
        np.ones((n, STATES)),
    )
