"""Find subframes of an ARINC 717 recording by their sync words, however the file was damaged.

A subframe counts as whole if its own sync word and the next one stand where they must: bits lost or won between the two
would move the second. Changed bits within it can't be detected: ARINC 717 has neither parity nor checksum.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.coding import PACKINGS, Bytes, Packing, Words12
from hdt_recorder.decoding.layout import SYNC_WORDS

WORD_COUNTS = tuple(64 << i for i in range(6))
"""Words a second, 64 to 2,048."""
LOST_AFTER = 3
"""Sync words missing in a row after which the subframes are searched anew; fewer are damage in place."""
_CHUNK = 1 << 18


@dataclass(frozen=True, slots=True)
class Run:
    """Subframes that follow each other without a bit lost or won between their sync words.

    Attributes
    ----------
    place : int
        Start of the first, in the packing's units.
    first : int
        Its number, from 0.
    whole : (n,) bool
        Which of them are undamaged.
    """

    place: int
    first: int
    whole: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Finder:
    """Find subframes of `words` words in `data`."""

    data: Bytes
    packing: Packing
    words: int
    syncs: tuple[int, ...] = SYNC_WORDS

    @property
    def size(self) -> int:
        """Return the units in the data."""
        return self.data.size * self.packing.byte

    @property
    def step(self) -> int:
        """Return the units of a subframe."""
        return self.words * self.packing.word

    def runs(self) -> Iterator[Run]:
        """Yield all runs of the recording, in order."""
        place = 0
        while (start := self.lock(place, self.size)) is not None:
            run, last_sync = self._follow(*start)
            yield run
            place = last_sync + self.packing.word

    def lock(self, start: int, stop: int) -> tuple[int, int] | None:
        """Return place and number of the first subframe from `start` on with two more sync words, if there is one."""
        numbers = self._numbers()
        stop = min(stop, self.size - 2 * self.step - self.packing.word + 1)
        for begin in range(start, stop, _CHUNK):
            places = np.arange(begin, min(begin + _CHUNK, stop), dtype=np.int64)
            number = numbers[self.packing.words_at(self.data, places)]
            for ahead in (0, 1, 2):
                successor = numbers[self.packing.words_at(self.data, places + ahead * self.step)]
                matches = (number >= 0) & (successor == (number + ahead) % len(self.syncs))
                places = places[matches]
                number = number[matches]
            if places.size:
                return int(places[0]), int(number[0])
        return None

    def _numbers(self) -> npt.NDArray[np.int8]:
        """Return the subframe that each word begins, from 0; -1 for a word that is no sync word."""
        numbers = np.full(4096, -1, np.int8)
        numbers[list(self.syncs)] = range(len(self.syncs))
        return numbers

    def _matches(self, place: int, number: int, count: int) -> npt.NDArray[np.bool_]:
        """Return whether the sync words of up to `count` subframes from here on stand in their places."""
        count = min(count, (self.size - place - self.packing.word) // self.step + 1)
        places = place + self.step * np.arange(count, dtype=np.int64)
        sync_words = np.resize(np.roll(self.syncs, -number), count)
        return np.equal(self.packing.words_at(self.data, places), sync_words)

    def _follow(self, place: int, number: int) -> tuple[Run, int]:
        """Return the run that begins here, and the place of its last sync word."""
        count = 256
        matches = self._matches(place, number, 256)
        while (loss := _first_loss(matches)) is None and matches.size == count:
            count *= 4
            matches = self._matches(place, number, count)
        n = int(np.flatnonzero(matches[:loss])[-1]) + 1
        rest = self.size - (place + n * self.step)
        ends = matches[n] if matches.size > n else 0 <= rest < self.packing.byte
        whole = matches[:n] & np.append(matches[1:n], ends)
        return Run(place, number, whole), place + (n - 1) * self.step

    def read(self, run: Run) -> Words12:
        """Read the words of a run, (n, words)."""
        return self.packing.words_from(self.data, run.place, run.whole.size * self.words).reshape(-1, self.words)


def _first_loss(matches: npt.NDArray[np.bool_]) -> int | None:
    misses = ~matches
    run_of_misses = misses[: misses.size - LOST_AFTER + 1].copy()
    for i in range(1, LOST_AFTER):
        run_of_misses &= misses[i : misses.size - LOST_AFTER + 1 + i]
    return int(np.argmax(run_of_misses)) if run_of_misses.any() else None


def find_packing(data: Bytes, words: int, syncs: tuple[int, ...] = SYNC_WORDS) -> Packing | None:
    """Find how the words of a recording lie in its bytes; None if it has no subframes of `words` words.

    Read in the wrong order of bits a sync word is nearly one still, so that the packing with most subframes is taken.
    """
    whole = {p: sum(int(r.whole.sum()) for r in Finder(data, p, words, syncs).runs()) for p in PACKINGS}
    best = max(PACKINGS, key=lambda p: whole[p])
    return best if whole[best] else None


def find_word_count(data: Bytes, syncs: tuple[int, ...] = SYNC_WORDS) -> int | None:
    """Find the words a second of a recording, whatever the map; None if it is no ARINC 717."""
    return next((n for n in WORD_COUNTS if find_packing(data, n, syncs) is not None), None)
