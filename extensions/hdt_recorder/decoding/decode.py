"""Parameters of a recording by a map: times, values, and null where the recording was damaged."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.coding import Bytes, Words
from hdt_recorder.decoding.frames_767 import Recording767
from hdt_recorder.decoding.layout import Parameter, Piece
from hdt_recorder.decoding.timeline_717 import Flags, Recording717
from hdt_recorder.decoding.values import Labels, extract_bits, read_words

Floats = npt.NDArray[np.float64]
OVERLAP_DIFFERS = 0.1
"""Share of undamaged words above which bits recorded twice that differ invalidate all values, not these alone."""


@dataclass(frozen=True, slots=True)
class Series:
    """One parameter over a recording, in order of time.

    Attributes
    ----------
    t_s : (n,) float
        Seconds since the recording's first frame (ARINC 717), or on the recorder's clock (ARINC 767).
    value : (n,) float or None
        In the parameter's unit; undefined where not `valid`.
    text : Labels or None
    valid : (n,) bool
        False where the recording is damaged or the bits are no value.
    whole : (n,) bool
        Where the recording is undamaged.
    """

    parameter: Parameter
    t_s: Floats
    value: Floats | None
    text: Labels | None
    valid: Flags
    whole: Flags


def decode_717(recording: Recording717, parameters: Iterable[Parameter]) -> Iterator[Series]:
    """Decode each parameter of an ARINC 717 recording."""
    for parameter in parameters:
        if not parameter.unreadable:
            yield _every_frame(recording, parameter) if parameter.cycle == 1 else _superframe(recording, parameter)


def _every_frame(recording: Recording717, parameter: Parameter) -> Series:
    samples = parameter.samples
    n = recording.frame.size
    words = np.zeros((len(samples), n), np.uint64)
    whole = np.ones((len(samples), n), bool)
    for i, sample in enumerate(samples):
        parts = ((piece, _part(recording, piece, slice(None)), _whole(recording, piece)) for piece in sample.pieces)
        _merge_pieces(parts, words[i], whole[i])
    t_s = recording.t_s[:, None] + np.array([s.at_s for s in samples])
    return _series(parameter, t_s.ravel(), words.T.ravel(), whole.T.ravel())


def _superframe(recording: Recording717, parameter: Parameter) -> Series:
    """Decode a superframe parameter: one value a sample and cycle that begins within the recording."""
    cycle = parameter.cycle
    starts = np.flatnonzero((recording.count >= 0) & (recording.count % cycle == 0))
    words = np.zeros((len(parameter.samples), starts.size), np.uint64)
    whole = np.ones(words.shape, bool)
    last = recording.frame.size - 1
    for i, sample in enumerate(parameter.samples):
        parts = []
        for piece in sample.pieces:
            row = np.minimum(np.searchsorted(recording.frame, recording.frame[starts] + piece.frame), last)
            same = recording.frame[row] - recording.frame[starts] == piece.frame
            same &= recording.count[row] - recording.count[starts] == piece.frame
            parts.append((piece, _part(recording, piece, row), same & _whole(recording, piece)[row]))
        _merge_pieces(parts, words[i], whole[i])
    t_s = recording.t_s[starts][:, None] + np.array([s.at_s for s in parameter.samples])
    return _series(parameter, t_s.ravel(), words.T.ravel(), whole.T.ravel())


def _merge_pieces(parts: Iterable[tuple[Piece, Words, Flags]], words: Words, whole: Flags) -> None:
    """Merge the pieces of one word; where two hold the same bit they must agree, or they are no pieces of one word."""
    filled_bits = 0
    differ = np.zeros(0, bool)
    for piece, part, part_whole in parts:
        mask = (1 << piece.bits) - 1 << piece.into
        if overlap := filled_bits & mask:
            differ = differ if differ.size else np.zeros(words.size, bool)
            differ |= (words ^ part) & np.uint64(overlap) != 0
        words |= part
        whole &= part_whole
        filled_bits |= mask
    if differ.size:
        whole &= ~differ & ((whole & differ).sum() <= OVERLAP_DIFFERS * whole.sum())


def _part(recording: Recording717, piece: Piece, rows: slice | npt.NDArray[np.int64]) -> Words:
    bits = recording.words[piece.word, rows] >> piece.low & (1 << piece.bits) - 1
    return bits.astype(np.uint64) << np.uint64(piece.into)


def _whole(recording: Recording717, piece: Piece) -> Flags:
    """Return whether the subframe of a piece is undamaged, (n,)."""
    whole: Flags = recording.whole[piece.word * recording.whole.shape[0] // recording.words.shape[0]]
    return whole


def _series(parameter: Parameter, t_s: Floats, words: Words, whole: Flags) -> Series:
    values = read_words(words, parameter.coding)
    return Series(parameter, t_s, values.value, values.text, values.valid & whole, whole)


def decode_767(recording: Recording767, parameters: Iterable[Parameter]) -> Iterator[Series]:
    """Decode each parameter of an ARINC 767 recording."""
    for parameter in parameters:
        if not parameter.unreadable and parameter.frame_id in recording.frames:
            frames = recording.frames[parameter.frame_id]
            (sample,) = parameter.samples
            yield _series(parameter, frames.t_s, _bits(frames.data, sample.pieces[0]), frames.whole)


def _bits(data: Bytes, piece: Piece) -> Words:
    """Return bits of each row, counted from its first; up to 64 of them."""
    first = piece.low // 8
    last = (piece.low + piece.bits - 1) // 8
    number = np.zeros(data.shape[0], np.uint64)
    tail = np.uint64(7 - (piece.low + piece.bits - 1) % 8)
    for column in range(first, last):
        number = number << np.uint64(8) | data[:, column]
    number = number << np.uint64(8) - tail | data[:, last] >> tail.astype(np.uint8)
    return extract_bits(number, 0, piece.bits)
