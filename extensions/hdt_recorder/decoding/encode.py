"""Encode simulated values as recordings: binary numbers at one value a second."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.coding import Floats, Polynomial, Words
from hdt_recorder.decoding.layout import HEAD_767, Map717, Map767, Parameter

SYNC_767 = b"\xeb\x90"
HEAD_BYTES = 130


def encode_717(layout: Map717, values: Mapping[str, Floats]) -> bytes:
    """Encode an aligned ARINC 717 recording, 12-bit words in 16 bits: whole frames of `values`, (seconds,)."""
    subframes = len(layout.sync_words)
    n = min(v.size for v in values.values()) // subframes
    words = np.zeros((n, subframes * layout.words), np.uint16)
    words.reshape(n, subframes, layout.words)[:, :, 0] = layout.sync_words
    if layout.counter is not None:
        piece = layout.counter.piece
        words[:, piece.word] |= (np.arange(n) % (1 << piece.bits) << piece.low).astype(np.uint16)
    for name, series in values.items():
        raw = raw_words(layout.parameters[name], series[: n * subframes]).reshape(n, subframes)
        for column, sample in enumerate(layout.parameters[name].samples):
            for piece in sample.pieces:
                part = raw[:, column] >> np.uint64(piece.into) & np.uint64((1 << piece.bits) - 1)
                words[:, piece.word] |= (part << np.uint64(piece.low)).astype(np.uint16)
    return words.astype("<u2").tobytes()


def encode_767(layout: Map767, values: Mapping[str, Floats]) -> bytes:
    """Encode an ARINC 767 recording of one kind of frame a second: head, then frames; `values` are (seconds,)."""
    ((number, kind),) = layout.frames.items()
    n = min(v.size for v in values.values())
    bits = np.zeros((n, 8 * (kind.size - HEAD_767)), np.uint8)
    for name, series in values.items():
        (piece,) = layout.parameters[name].samples[0].pieces
        raw = raw_words(layout.parameters[name], series[:n])
        places = np.arange(piece.bits - 1, -1, -1, dtype=np.uint64)
        bits[:, piece.low : piece.low + piece.bits] = raw[:, None] >> places & np.uint64(1)
    body = np.packbits(bits, axis=1)
    time_ms = (1000 * np.arange(n)).astype(">u4").view(np.uint8).reshape(n, 4)
    frame_ids = np.tile(np.frombuffer(number.to_bytes(2, "big"), np.uint8), (n, 1))
    start = np.tile(np.frombuffer(SYNC_767 + kind.size.to_bytes(2, "big"), np.uint8), (n, 1))
    return _head(layout.revision) + np.hstack([start, time_ms, frame_ids, body, frame_ids]).tobytes()


def _head(revision: str) -> bytes:
    body = f"647A-00 {revision}".ljust(HEAD_BYTES).encode()
    number = (1).to_bytes(2, "big")
    size = (len(body) + HEAD_767).to_bytes(2, "big")
    return SYNC_767 + size + bytes(4) + number + body + number


def raw_words(parameter: Parameter, values: Floats) -> Words:
    """Return the nearest raw word of each value; a missing value repeats the last one, as recorders do.

    Raises
    ------
    ValueError
        The parameter is no binary number with one scale, or a value has no room in it.
    """
    coding = parameter.coding
    scale = coding.steps[0] if coding.steps else Polynomial((0.0, 1.0))
    if coding.kind != "binary" or len(coding.steps) > 1 or not isinstance(scale, Polynomial):
        raise ValueError(f"{parameter.name}: only binary numbers of one scale are written")
    offset, factor = scale.coefficients
    low = -(1 << coding.bits) if coding.sign is not None else 0
    high = (1 << coding.bits) - 1
    number = np.round((_fill_forward(values) - offset) / factor)
    if number.size and not low <= number.min() <= number.max() <= high:
        message = f"{parameter.name}: {values[np.argmax(np.abs(number))]:g} does not fit into {coding.bits} bits"
        raise ValueError(message)
    mask = (1 << coding.bits + (coding.sign is not None)) - 1
    return (number.astype(np.int64) & mask).astype(np.uint64)


def _fill_forward(values: Floats) -> npt.NDArray[np.float64]:
    """Replace missing values with the last finite one."""
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros(values.size)
    last = np.maximum.accumulate(np.where(finite, np.arange(values.size), 0))
    return np.asarray(np.where(finite[last], values[last], values[finite.argmax()]))
