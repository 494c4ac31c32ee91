"""Check that a parameter map belongs to a recording; a map that does not fit decodes nothing."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.coding import Bytes, Packing
from hdt_recorder.decoding.decode import Series, decode_717, decode_767
from hdt_recorder.decoding.frames_717 import find_packing, find_word_count
from hdt_recorder.decoding.frames_767 import Recording767, WholeFrames, arrange_767, find_frames
from hdt_recorder.decoding.layout import WHOLE, Map717, Map767, MapError, Parameter, ParameterMap
from hdt_recorder.decoding.timeline_717 import Recording717, arrange

COUNTS = 0.5
"""Least share of frames whose counter is one more than the frame's before."""
MOST_IMPOSSIBLE = 0.2
"""Share of parameters that are mostly impossible above which a map is another aircraft's. Maps of an A330 and of a 787
have 0.05 and 0.03 on recordings of their own; read one bit off, the 787's has half."""
IMPOSSIBLE = 0.5
"""Share of a parameter's values: no digit, no minute, no number, or outside the operational range."""
RATE_OFF = 0.1
TINY, HUGE = 1e-12, 1e12
"""A number computed on board that is smaller (and not zero) or larger was cut at the wrong bit."""
FEW_TESTED = 8
FIRST_BYTES, LOOK_BYTES, LOOK_FRAMES = 1 << 18, 1 << 22, 900
"""Part of a recording that is checked against the map."""


def recognise(data: Bytes, layout: ParameterMap) -> Recording717 | Recording767:
    """Return the frames of a recording that a map fits.

    Raises
    ------
    MapError
        Names what disagrees: words a second, frame counter, lengths, rates, revision, impossible values.
    """
    if isinstance(layout, Map767):
        return _recognise_767(data, layout)
    return _recognise_717(data, layout)


def decode(recording: Recording717 | Recording767, parameters: Iterable[Parameter]) -> Iterable[Series]:
    """Decode each parameter of a recording, one after the other."""
    if isinstance(recording, Recording767):
        return decode_767(recording, parameters)
    return decode_717(recording, parameters)


def _recognise_717(data: Bytes, layout: Map717) -> Recording717:
    packing = _packing(data, layout)
    _check_counter(data, packing, layout)
    recording = arrange(data, packing, layout)
    _check_values(decode(recording.excerpt(LOOK_FRAMES), layout.parameters.values()))
    return recording


def _packing(data: Bytes, layout: Map717) -> Packing:
    """Find the packing at the beginning, or where that is damaged, further on."""
    first = data[:FIRST_BYTES]
    if (packing := find_packing(first, layout.words, layout.sync_words)) is not None:
        return packing
    if (words := find_word_count(first, layout.sync_words)) not in {None, layout.words}:
        raise MapError(f"the recording has {words:,} words a second, the map {layout.words:,}")
    if (other := find_frames(first)).number.size > 1:
        raise MapError(f"the recording is ARINC 767 (frames {_some(other.number)}), the map ARINC 717")
    if (packing := find_packing(data[:LOOK_BYTES], layout.words, layout.sync_words)) is not None:
        return packing
    message = f"no ARINC 717 frame in {min(data.size, LOOK_BYTES):,} bytes"
    raise MapError(f"{message}, neither with the map's words a second nor with another number")


def _some(numbers: npt.NDArray[np.int64]) -> str:
    return ", ".join(str(n) for n in np.unique(numbers)[:8])


def _check_counter(data: Bytes, packing: Packing, layout: Map717) -> None:
    """Check the frame counter before the time axis is built on it."""
    if layout.counter is None:
        return
    raw = arrange(data[:LOOK_BYTES], packing, Map717(layout.words, {}, None, layout.sync_words, layout.subframe_s))
    piece = layout.counter.piece
    subframe = layout.counter.piece.word // layout.words
    whole = raw.whole[subframe]
    count = (raw.words[piece.word].astype(np.int64) >> piece.low) % (1 << piece.bits)
    both = whole[1:] & whole[:-1] & (np.diff(raw.frame) == 1)
    counts = (np.diff(count)[both] - 1) % (1 << piece.bits) == 0
    if counts.size >= FEW_TESTED and counts.mean() < COUNTS:
        place = f"subframe {subframe + 1} word {piece.word % layout.words + 1}"
        message = f"the frame counter ({place}) does not count: {counts.mean():.0%} of frames are one after the last"
        raise MapError(message)


def _recognise_767(data: Bytes, layout: Map767) -> Recording767:
    frames = find_frames(data)
    if not frames.number.size:
        words = find_word_count(data[:FIRST_BYTES])
        also = f"; it is ARINC 717 with {words:,} words a second" if words else ""
        raise MapError(f"no ARINC 767 frame in {data.size:,} bytes{also}")
    _check_lengths(frames, layout)
    _check_rates(frames, layout)
    recording = arrange_767(data, frames, layout.frames)
    if layout.revision and recording.head and layout.revision not in recording.head:
        head = " ".join(recording.head.split())
        raise MapError(f"the recording says {head[:80]!r}, the map is {layout.revision!r}")
    _check_values(decode(recording.excerpt(LOOK_FRAMES), layout.parameters.values()))
    return recording


def _check_lengths(frames: WholeFrames, layout: Map767) -> None:
    """Check the commonest length of each frame. Some frames may be absent from the map, but not all of them."""
    differences = []
    for number, kind in layout.frames.items():
        sizes = frames.size[frames.number == number]
        if sizes.size and (usual := int(np.bincount(sizes).argmax())) != kind.size:
            differences.append(f"frame {number} has {usual:,} bytes, by the map {kind.size:,}")
    if differences:
        raise MapError("; ".join(differences))
    if not np.isin(frames.number, list(layout.frames)).any():
        frame_ids = ", ".join(str(n) for n in layout.frames)
        raise MapError(f"the recording has frames {_some(frames.number)}; the map has {frame_ids}")


def _check_rates(frames: WholeFrames, layout: Map767) -> None:
    for number, kind in layout.frames.items():
        time_ms = frames.time_ms[frames.number == number]
        if kind.rate_hz and time_ms.size > FEW_TESTED:
            period_s = float(np.median(np.diff(time_ms))) / 1000.0
            if abs(period_s * kind.rate_hz - 1.0) > RATE_OFF:
                message = f"frame {number} comes every {period_s:.3g} s, by the map every {1 / kind.rate_hz:.3g} s"
                raise MapError(message)


def _check_values(series: Iterable[Series]) -> None:
    """Raise `MapError` naming the first parameters with impossible values, if there are too many of them."""
    n_tested = 0
    impossible = []
    for one in series:
        share = _share_impossible(one)
        n_tested += share is not None
        if share is not None and share > IMPOSSIBLE:
            impossible.append(one.parameter.name)
    if n_tested >= FEW_TESTED and len(impossible) > MOST_IMPOSSIBLE * n_tested:
        some = ", ".join(impossible[:5])
        raise MapError(f"impossible values in {len(impossible)} of {n_tested} parameters that tell ({some}, ...)")


def _share_impossible(one: Series) -> float | None:
    """Return the share of undamaged values that are impossible; None for a parameter that can't be tested."""
    p = one.parameter
    n = int(one.whole.sum())
    if not n or p.name.endswith(WHOLE) or p.coding.kind == "discrete":
        return None
    wrong = ~one.valid
    if one.value is not None:
        value = np.where(one.valid, one.value, 0.0)
        if p.coding.kind == "float":
            wrong |= (np.abs(value) > HUGE) | ((np.abs(value) < TINY) & (value != 0.0))
        elif p.coding.kind == "binary" and p.lowest is not None and p.highest is not None:
            wrong |= one.valid & ((value < p.lowest) | (value > p.highest))
    return float((wrong & one.whole).sum() / n)
