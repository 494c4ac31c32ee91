"""The pass along packs in chapters of flights, so that it can go on from a bookmark.

A bookmark is the belief with which a chapter begins. Looking back reaches to the end of the next chapter and no
further: what is said with hindsight stands once that has been flown, and a night need not go over all of history.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hdt_core.twin import histories
from hdt_core.twin.belief import Belief, Passage, joined
from hdt_core.twin.crossing import Array
from hdt_core.twin.hindsight import looking_back
from hdt_core.twin.wave import Wave
from hdt_core.twin.wear import Settings

CHAPTER = 50
"""Flights in a chapter. Hindsight of 50 to 100 flights is as good as that of whole histories of 200 (rms error 0.0322
both, without any 0.0343, on the sample fleet)."""
SIDE_BY_SIDE = 64
"""Packs that advance together: two chapters of their beliefs are kept, some 15 kB a flight."""

Bookmarks = Mapping[tuple[int, int], Belief]
"""By pack's number and chapter, the belief with which it begins."""


class Passed(NamedTuple):
    """What a pass found: filtered and smoothed mean and sd of ln loss, (4, rows), NaN where it did not go; bookmarks of
    the chapters it began."""

    found: Array
    bookmarks: dict[tuple[int, int], Belief]


def pass_along(wave: Wave, settings: Settings, begin: Array, bookmarks: Bookmarks) -> Passed:
    """Follow each pack from the chapter `begin` (packs,) says, where it is not the first from that chapter's
    bookmark."""
    passed = Passed(np.full((4, wave.n_rows), np.nan), {})
    left = wave.flights - begin * CHAPTER
    packs = np.argsort(-left, kind="stable")
    for first in range(0, len(packs), SIDE_BY_SIDE):
        _together(wave, settings, packs[first : first + SIDE_BY_SIDE], begin, bookmarks, passed)
    return passed


def _together(wave: Wave, settings: Settings, packs: Array, begin: Array, bookmarks: Bookmarks, passed: Passed) -> None:
    """Some packs side by side, those with most flights left first: who has none left drops out at the end."""
    first, left = begin[packs] * CHAPTER, wave.flights[packs] - begin[packs] * CHAPTER
    belief = _opened(packs, begin, bookmarks, settings)
    steps: list[tuple[Belief, Passage]] = []
    for k in range(int(left[0]) if len(left) else 0):
        flying = int((left > k).sum())
        belief = belief.of_first(flying)
        if k % CHAPTER == 0:
            chapter = begin[packs] + k // CHAPTER
            passed.bookmarks.update({(int(packs[i]), int(chapter[i])): belief.of(i) for i in range(flying)})
        belief, passage = histories.step(belief, wave.flight(first[:flying] + k, packs[:flying]), settings)
        steps.append((belief, passage))
        row = wave.row[first[:flying] + k, packs[:flying]]
        passed.found[:2, row] = histories.wear_summary(belief, flying)
        if (k + 1) % CHAPTER == 0 or k + 1 == left[0]:
            window = steps[-(CHAPTER + k % CHAPTER + 1) :]
            for back, (smoothed, sd) in enumerate(looking_back(*zip(*window, strict=True))):
                at = first[: len(smoothed)] + k + 1 - len(window) + back
                passed.found[2:, wave.row[at, packs[: len(smoothed)]]] = smoothed, sd
            steps = window


def _opened(packs: Array, begin: Array, bookmarks: Bookmarks, settings: Settings) -> Belief:
    """Beliefs with which packs begin, numbered as they stand side by side."""
    parts = [bookmarks[int(p), int(begin[p])] if begin[p] else histories.start(1, settings) for p in packs]
    return joined([part._replace(pack=np.full(len(part.pack), i)) for i, part in enumerate(parts)])
