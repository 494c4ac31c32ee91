"""Find frames of an ARINC 767 recording by sync, length and number, however the file was damaged.

A frame is `EB90`, its length in bytes (2), a time in milliseconds (4), its number (2), the data, and its number again
(2). There is no checksum: a frame counts as whole if both numbers agree, the length is that of the map, and its time
lies between those of its neighbours.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.coding import Bytes
from hdt_recorder.decoding.layout import FILLED_GAP_S, HEAD_767, Damage, Frame767

SYNC_767 = 0xEB90
HEAD_FRAME = 1
"""Number of the frame that names the recording's configuration."""
STEADY, RARE = 0.5, 0.02
"""If this share of frames comes at one fraction of the period, a fraction rarer than the second is a damaged time."""
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames of one number, in order of time; `data` is (n, bytes), zero where not `whole`."""

    data: Bytes
    t_s: npt.NDArray[np.float64]
    whole: Flags


@dataclass(frozen=True, slots=True)
class Recording767:
    """A recording's head, and its frames by number."""

    head: str
    frames: Mapping[int, Frames]
    damage: Damage

    def excerpt(self, n: int) -> "Recording767":
        """Return the first `n` frames of each number."""
        parts = {number: Frames(f.data[:n], f.t_s[:n], f.whole[:n]) for number, f in self.frames.items()}
        return Recording767(self.head, parts, self.damage)


@dataclass(frozen=True, slots=True)
class WholeFrames:
    """Whole frames as they lie in the file."""

    place: Ints
    size: Ints
    time_ms: Ints
    number: Ints


def find_frames(data: Bytes) -> WholeFrames:
    """Find every frame with agreeing sync, length and two numbers, none within another."""
    sync = np.flatnonzero((data[:-1] == SYNC_767 >> 8) & (data[1:] == SYNC_767 & 0xFF)).astype(np.int64)
    sync = sync[sync + HEAD_767 <= data.size]
    size = _number(data, sync + 2, 2)
    number = _number(data, sync + 8, 2)
    fits = (size >= HEAD_767) & (sync + size <= data.size)
    sync = sync[fits]
    size = size[fits]
    number = number[fits]
    agree = _number(data, sync + size - 2, 2) == number
    place = sync[agree]
    size = size[agree]
    separate = _without_overlap(place, size)
    place = place[separate]
    return WholeFrames(place, size[separate], _number(data, place + 4, 4), number[agree][separate])


def _number(data: Bytes, places: Ints, size: int) -> Ints:
    """Read big-endian numbers."""
    value = np.zeros(places.size, np.int64)
    for i in range(size):
        value = value << 8 | data[places + i]
    return value


def _without_overlap(place: Ints, size: Ints) -> Flags:
    """Return the frames that do not begin within the frame before."""
    separate = np.zeros(place.size, bool)
    end = 0
    for i, (begin, length) in enumerate(zip(place.tolist(), size.tolist(), strict=True)):
        if begin >= end:
            separate[i], end = True, begin + length
    return separate


def arrange_767(data: Bytes, candidates: WholeFrames, kinds: Mapping[int, Frame767]) -> Recording767:
    """Sort frames by number and time; those with an impossible length or time are not whole, and counted."""
    heads = np.flatnonzero(candidates.number == HEAD_FRAME)
    in_map = np.isin(candidates.number, list(kinds))
    sizes = np.array([kinds[n].size if n in kinds else -1 for n in candidates.number.tolist()], np.int64)
    whole = in_map & (candidates.size == sizes)
    whole[in_map] &= _between_neighbours(candidates.time_ms[in_map])
    for number, kind in kinds.items():
        of_kind = whole & (candidates.number == number)
        whole[of_kind] = _on_beat(candidates.time_ms[of_kind], kind)
    end_s = float(candidates.time_ms[whole].max(initial=0)) / 1000.0
    frames = {}
    missing = 0
    for number, kind in kinds.items():
        at = np.flatnonzero(whole & (candidates.number == number))
        frames[number] = _frames_of_kind(data, candidates, at, kind, end_s)
        missing += frames[number].t_s.size - at.size
    n_whole = sum(int(f.whole.sum()) for f in frames.values())
    breaks = int((np.diff(candidates.time_ms[whole]) < 0).sum())
    head = _text(data, candidates, int(heads[0])) if heads.size else ""
    n_bytes = int(candidates.size.sum())
    damage = Damage("frames", n_whole, int(in_map.sum()) - n_whole, missing, breaks, data.size - n_bytes)
    return Recording767(head, frames, damage)


def _text(data: Bytes, candidates: WholeFrames, head: int) -> str:
    begin = int(candidates.place[head])
    size = int(candidates.size[head])
    return bytes(data[begin + 10 : begin + size - 2]).decode("ascii", "replace")


def _between_neighbours(time_ms: Ints) -> Flags:
    """Return whether each time is at or after that of the frame before and at or before that of the frame after.

    Where the two neighbours themselves are out of order, another recording begins: both belong to theirs.
    """
    if time_ms.size < 3:
        return np.ones(time_ms.size, bool)
    before = time_ms[:-2]
    after = time_ms[2:]
    inner = (before > after) | ((time_ms[1:-1] >= before) & (time_ms[1:-1] <= after))
    return np.concatenate([[True], inner, [True]])


def _on_beat(time_ms: Ints, kind: Frame767) -> Flags:
    """Return whether a frame comes at a common fraction of its period; without a steady period, all do."""
    if not kind.rate_hz or not time_ms.size:
        return np.ones(time_ms.size, bool)
    _, which, times = np.unique(time_ms % round(1000.0 / kind.rate_hz), return_inverse=True, return_counts=True)
    steady = times.max() >= STEADY * time_ms.size
    common: Flags = times >= max(2.0, RARE * time_ms.size)
    return common[which] if steady else np.ones(time_ms.size, bool)


def _frames_of_kind(data: Bytes, candidates: WholeFrames, at: Ints, kind: Frame767, end_s: float) -> Frames:
    """Return frames of one number in order; those that a short gap took are there, not whole.

    Nor is the frame before a gap: what is missing may be the end of this one, and the beginning of the next.
    """
    time_s = candidates.time_ms[at] / 1000.0
    period_s = 1.0 / kind.rate_hz if kind.rate_hz else np.inf
    steps = np.round(np.diff(time_s) / period_s).astype(np.int64)
    gaps = np.flatnonzero((steps > 1) & ((steps - 1) * period_s <= FILLED_GAP_S))
    gap_times_s = [time_s[i] + period_s * np.arange(1, steps[i]) for i in gaps]
    after = [i + np.linspace(0.1, 0.9, steps[i] - 1) for i in gaps]
    order = np.argsort(np.concatenate([np.arange(at.size), *after]), kind="stable")
    t_s = np.concatenate([time_s, *gap_times_s])
    body = np.zeros((t_s.size, kind.size - HEAD_767), np.uint8)
    before_gap = np.append((steps != 1) & (kind.rate_hz is not None), end_s - time_s[-1:] > 1.5 * period_s)[: at.size]
    body[: at.size] = data[candidates.place[at][:, None] + np.arange(10, kind.size - 2)]
    return Frames(body[order], t_s[order], np.append(~before_gap, np.zeros(t_s.size - at.size, bool))[order])
