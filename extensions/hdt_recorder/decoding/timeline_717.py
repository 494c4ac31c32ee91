"""Subframes of an ARINC 717 recording in their places on the time axis, by the frame counter where there is one."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.bitstream import Bytes, Packing, Words12
from hdt_recorder.decoding.frames_717 import Finder, Run
from hdt_recorder.decoding.layout import FILLED_GAP_S, Damage, Map717

A = TypeVar("A", bound=np.generic)
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Recording717:
    """Frames by time.

    Attributes
    ----------
    words : (subframes x words, n) uint16
        Column i is frame i; a damaged or missing subframe is zero there, and not `whole`.
    whole : (subframes, n) bool
    frame : (n,) int
        Number of the frame since the first.
    count : (n,) int
        Frames since one that begins a superframe, by the frame counter; -1 where it is not known.
    t_s : (n,) float
        Seconds since the start of the first frame.
    """

    words: Words12
    whole: Flags
    frame: Ints
    count: Ints
    t_s: npt.NDArray[np.float64]
    damage: Damage

    def excerpt(self, n: int) -> "Recording717":
        """The first `n` frames."""
        first = slice(n)
        parts = self.words[:, first], self.whole[:, first], self.frame[first], self.count[first], self.t_s[first]
        return Recording717(*parts, self.damage)


def arrange(data: Bytes, packing: Packing, layout: Map717) -> Recording717:
    """All frames of a recording, by time. Raises nothing: what can't be read is not `whole`, and counted."""
    finder = Finder(data, packing, layout.words, layout.sync_words)
    runs = list(finder.runs())
    parts = [part for run in runs for part in _split(run, finder)]
    placed = _Timeline(finder, layout, alone=len(parts) == 1)
    for part in parts:
        placed.add(part)
    taken = sum(r.whole.size for r in runs) * finder.step // packing.byte
    return _fill(placed, max(0, data.size - taken))


def _split(run: Run, finder: Finder) -> Iterator[Run]:
    """A run where it was damaged: what comes after may be spliced in, even if its sync words stand where they must."""
    begins = np.flatnonzero(run.whole & np.append(True, ~run.whole[:-1]))
    for begin, end in pairwise([0, *begins[begins > 0].tolist(), run.whole.size]):
        number = (run.first + begin) % len(finder.syncs)
        yield Run(run.place + begin * finder.step, number, run.whole[begin:end])


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Frame counters of a run that agree: indices of the first and last subframe that holds one, and what they hold."""

    first: int
    last: int
    first_count: int
    last_count: int


class _Timeline:
    """Runs by time. `at` is 4 x frame + number of the subframe, `shift` the counter less the frame, -1 if unknown."""

    def __init__(self, finder: Finder, layout: Map717, alone: bool) -> None:
        self.finder, self.layout, self.alone = finder, layout, alone
        self.per_frame = len(layout.sync_words)
        self.words: list[Words12] = []
        self.whole: list[Flags] = []
        self.at: list[Ints] = []
        self.shift: list[Ints] = []
        self.breaks = self.lost = 0
        self._before: tuple[Run, int] | None = None  # the last run, and where its last subframe was placed
        self._counted: tuple[int, int] | None = None  # the last counter that was believed, and its frame

    @property
    def modulus(self) -> int:
        """Frames after which the counter begins anew."""
        return 1 << self.layout.counter.piece.bits if self.layout.counter else 1

    def add(self, run: Run) -> None:
        """The next run of the file; one that no counter places is left out."""
        at, whole = self._estimate(run), run.whole.copy()
        shift = np.full(at.size, -1, np.int64)
        words = self.finder.read(run)
        if self.layout.counter is not None:
            stretches = self._stretches(words, at, whole)
            if not stretches:
                self.lost += at.size
                return
            for stretch, before in zip(stretches, [None, *stretches], strict=False):
                self._place(stretch, before, at, whole, shift)
        self._before = run, int(at[-1])
        self.words.append(words)
        self.whole.append(whole)
        self.at.append(at)
        self.shift.append(shift)

    def _estimate(self, run: Run) -> Ints:
        """Where the place in the file and the number of its first subframe put a run."""
        start = run.first
        if self._before is not None:
            before, last = self._before
            passed = (run.place - before.place) / self.finder.step - (before.whole.size - 1)
            start = last + max(1, round(passed))
            start += (run.first - start + 1) % self.per_frame - 1  # nearest with this number
            start += self.per_frame if start <= last else 0
        return start + np.arange(run.whole.size, dtype=np.int64)

    def _stretches(self, words: Words12, at: Ints, whole: Flags) -> list[_Stretch]:
        """Counters that can be believed: two that agree, or one that says what the file's place does.

        What lies about a counter that stands alone is marked as damaged.
        """
        assert self.layout.counter is not None
        piece = self.layout.counter.piece
        seen = np.flatnonzero((at % self.per_frame == piece.word // self.layout.words) & whole)
        count = (words[seen, piece.word % self.layout.words].astype(np.int64) >> piece.low) % self.modulus
        ahead = (count - at[seen] // self.per_frame) % self.modulus
        ends = np.ones(seen.size + 1, bool)
        ends[1:-1] = ahead[1:] != ahead[:-1]
        believed = []
        for i, j in pairwise(np.flatnonzero(ends)):
            if j - i > 1 or self._expects(int(ahead[i])) or (self.alone and seen.size == 1):
                believed.append(_Stretch(int(seen[i]), int(seen[j - 1]), int(count[i]), int(count[j - 1])))
            else:
                whole[seen[i - 1] if i else 0 : seen[j] if j < seen.size else None] = False
        return believed

    def _expects(self, ahead: int) -> bool:
        return self._counted is not None and (self._counted[0] - self._counted[1]) % self.modulus == ahead

    def _place(self, stretch: _Stretch, before: _Stretch | None, at: Ints, whole: Flags, shift: Ints) -> None:
        """Move a run, from this stretch on, to where the counter puts it; what lies about a jump may be spliced."""
        begin = 0
        if before is not None:
            begin = max(before.last + 1, stretch.first - int(at[stretch.first] % self.per_frame))
        frame = int(at[stretch.first]) // self.per_frame
        if self._counted is not None:
            count, seen = self._counted
            step = (stretch.first_count - count) % self.modulus
            move = (step - (frame - seen)) * self.per_frame
            end = int(at[begin - 1]) if begin else (self._before[1] if self._before else -1)
            if before is not None and move:
                whole[before.last : stretch.first + 1] = False
            if 1 <= step <= self.modulus // 2 and at[begin] + move > end:
                at[begin:] += move
            else:  # earlier than what came before: another recording begins, with a frame of its own
                self.breaks += 1
                at[begin:] += self.per_frame if at[begin] // self.per_frame == end // self.per_frame else 0
        shift[begin:] = (stretch.first_count - int(at[stretch.first]) // self.per_frame) % self.modulus
        self._counted = stretch.last_count, int(at[stretch.last]) // self.per_frame


def _fill(placed: _Timeline, skipped: int) -> Recording717:
    """Frames in a regular grid; those that a short gap took are there, not whole."""
    layout, per_frame = placed.layout, placed.per_frame
    frame_s = per_frame * layout.subframe_s
    at = _join(placed.at, np.empty(0, np.int64))
    words, held = _join(placed.words, np.empty((0, layout.words), np.uint16)), _join(placed.whole, np.empty(0, bool))
    present, first = np.unique(at // per_frame, return_index=True)
    gaps = np.diff(present) - 1
    short = np.flatnonzero((gaps > 0) & (gaps * frame_s <= FILLED_GAP_S))
    frame = np.sort(np.concatenate([present, *(np.arange(present[i] + 1, present[i + 1]) for i in short)]))
    n = frame.size
    row = np.searchsorted(frame, at // per_frame) * per_frame + at % per_frame
    whole = np.zeros(n * per_frame, bool)
    whole[row] = held
    grid = words
    if row.size < whole.size:
        grid = np.zeros((n * per_frame, layout.words), np.uint16)
        grid[row] = words
    shift = _join(placed.shift, np.empty(0, np.int64))[first]
    shift = shift[np.searchsorted(present, frame, side="right") - 1] if n else shift
    since_first = frame + shift - (layout.counter.first if layout.counter else 0) + placed.modulus
    damage = Damage(
        unit="subframes", whole=int(held.sum()), damaged=int((~held).sum()) + placed.lost,
        missing=int(n * per_frame - at.size), breaks=placed.breaks, skipped_bytes=skipped,
    )  # fmt: skip
    return Recording717(
        np.ascontiguousarray(grid.reshape(n, per_frame * layout.words).T), whole.reshape(n, per_frame).T, frame,
        np.where(shift < 0, -1, since_first), (frame - (frame[0] if n else 0)) * frame_s, damage,
    )  # fmt: skip


def _join(parts: list[npt.NDArray[A]], none: npt.NDArray[A]) -> npt.NDArray[A]:
    """All parts one after the other, without a copy where there is one."""
    return parts[0] if len(parts) == 1 else np.concatenate([none, *parts])
