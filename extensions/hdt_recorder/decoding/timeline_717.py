"""Place subframes of an ARINC 717 recording on the time axis, by the frame counter where there is one."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.coding import Bytes, Packing, Words12
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
        Frames since one that begins a superframe, by the frame counter; -1 where unknown.
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
        """Return the first `n` frames."""
        first = slice(n)
        parts = self.words[:, first], self.whole[:, first], self.frame[first], self.count[first], self.t_s[first]
        return Recording717(*parts, self.damage)


def arrange(data: Bytes, packing: Packing, layout: Map717) -> Recording717:
    """Arrange all frames of a recording by time. Raises nothing: what can't be read is not `whole`, and counted."""
    finder = Finder(data, packing, layout.words, layout.sync_words)
    runs = list(finder.runs())
    parts = [part for run in runs for part in _split(run, finder)]
    timeline = _Timeline(finder, layout, alone=len(parts) == 1)
    for part in parts:
        timeline.add(part)
    n_bytes = sum(r.whole.size for r in runs) * finder.step // packing.byte
    return _fill(timeline, max(0, data.size - n_bytes))


def _split(run: Run, finder: Finder) -> Iterator[Run]:
    """Split a run where it was damaged: what follows may be spliced in, even with its sync words in place."""
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
        self.finder = finder
        self.layout = layout
        self.alone = alone
        self.per_frame = len(layout.sync_words)
        self.words: list[Words12] = []
        self.whole: list[Flags] = []
        self.at: list[Ints] = []
        self.shift: list[Ints] = []
        self.breaks = self.lost = 0
        self._before: tuple[Run, int] | None = None  # the last run, and where its last subframe was placed
        self._counted: tuple[int, int] | None = None  # the last accepted counter, and its frame

    @property
    def modulus(self) -> int:
        """Return the frames after which the counter begins anew."""
        return 1 << self.layout.counter.piece.bits if self.layout.counter else 1

    def add(self, run: Run) -> None:
        """Add the next run of the file; one that no counter places is left out."""
        at = self._estimate(run)
        whole = run.whole.copy()
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
        """Estimate a run's place in time from its place in the file and the number of its first subframe."""
        start = run.first
        if self._before is not None:
            before, last = self._before
            subframes = (run.place - before.place) / self.finder.step - (before.whole.size - 1)
            start = last + max(1, round(subframes))
            start += (run.first - start + 1) % self.per_frame - 1  # nearest with this number
            start += self.per_frame if start <= last else 0
        return start + np.arange(run.whole.size, dtype=np.int64)

    def _stretches(self, words: Words12, at: Ints, whole: Flags) -> list[_Stretch]:
        """Return plausible counters: two that agree, or one that agrees with the place in the file.

        What lies about a counter that stands alone is marked as damaged.
        """
        assert self.layout.counter is not None
        piece = self.layout.counter.piece
        places = np.flatnonzero((at % self.per_frame == piece.word // self.layout.words) & whole)
        count = (words[places, piece.word % self.layout.words].astype(np.int64) >> piece.low) % self.modulus
        ahead = (count - at[places] // self.per_frame) % self.modulus
        ends = np.ones(places.size + 1, bool)
        ends[1:-1] = ahead[1:] != ahead[:-1]
        stretches = []
        for i, j in pairwise(np.flatnonzero(ends)):
            if j - i > 1 or self._expects(int(ahead[i])) or (self.alone and places.size == 1):
                stretches.append(_Stretch(int(places[i]), int(places[j - 1]), int(count[i]), int(count[j - 1])))
            else:
                whole[places[i - 1] if i else 0 : places[j] if j < places.size else None] = False
        return stretches

    def _expects(self, ahead: int) -> bool:
        return self._counted is not None and (self._counted[0] - self._counted[1]) % self.modulus == ahead

    def _place(self, stretch: _Stretch, before: _Stretch | None, at: Ints, whole: Flags, shift: Ints) -> None:
        """Move a run, from this stretch on, to where the counter puts it; what lies about a jump may be spliced."""
        begin = 0
        if before is not None:
            begin = max(before.last + 1, stretch.first - int(at[stretch.first] % self.per_frame))
        frame = int(at[stretch.first]) // self.per_frame
        if self._counted is not None:
            count, counted_frame = self._counted
            step = (stretch.first_count - count) % self.modulus
            move = (step - (frame - counted_frame)) * self.per_frame
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


def _fill(timeline: _Timeline, skipped_bytes: int) -> Recording717:
    """Fill frames into a regular grid; those that a short gap took are there, not whole."""
    layout = timeline.layout
    per_frame = timeline.per_frame
    frame_s = per_frame * layout.subframe_s
    at = _join(timeline.at, np.empty(0, np.int64))
    words = _join(timeline.words, np.empty((0, layout.words), np.uint16))
    subframe_whole = _join(timeline.whole, np.empty(0, bool))
    present, first = np.unique(at // per_frame, return_index=True)
    gaps = np.diff(present) - 1
    short = np.flatnonzero((gaps > 0) & (gaps * frame_s <= FILLED_GAP_S))
    frame = np.sort(np.concatenate([present, *(np.arange(present[i] + 1, present[i + 1]) for i in short)]))
    n = frame.size
    row = np.searchsorted(frame, at // per_frame) * per_frame + at % per_frame
    whole = np.zeros(n * per_frame, bool)
    whole[row] = subframe_whole
    grid = words
    if row.size < whole.size:
        grid = np.zeros((n * per_frame, layout.words), np.uint16)
        grid[row] = words
    shift = _join(timeline.shift, np.empty(0, np.int64))[first]
    shift = shift[np.searchsorted(present, frame, side="right") - 1] if n else shift
    since_first = frame + shift - (layout.counter.first if layout.counter else 0) + timeline.modulus
    damage = Damage(
        unit="subframes", whole=int(subframe_whole.sum()), damaged=int((~subframe_whole).sum()) + timeline.lost,
        missing=int(n * per_frame - at.size), breaks=timeline.breaks, skipped_bytes=skipped_bytes,
    )  # fmt: skip
    return Recording717(
        np.ascontiguousarray(grid.reshape(n, per_frame * layout.words).T), whole.reshape(n, per_frame).T, frame,
        np.where(shift < 0, -1, since_first), (frame - (frame[0] if n else 0)) * frame_s, damage,
    )  # fmt: skip


def _join(parts: list[npt.NDArray[A]], none: npt.NDArray[A]) -> npt.NDArray[A]:
    """Concatenate all parts, without a copy where there is one."""
    return parts[0] if len(parts) == 1 else np.concatenate([none, *parts])
