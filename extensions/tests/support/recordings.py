"""Writes flight recordings: raw words into frames, frames into bytes; and maps as a ground station exports them."""

import io
import zipfile
from datetime import datetime
from pathlib import Path

import numpy as np

from hdt_recorder.decoding.coding import PACKINGS, Packing
from hdt_recorder.decoding.fit import decode, recognise
from hdt_recorder.decoding.layout import Map717, Map767
from hdt_recorder.decoding.plain_map import read_toml

DATA = Path(__file__).parents[1] / "recorder/data"
DEMO_717, DEMO_767 = (read_toml((DATA / f"demo_{standard}.toml").read_text()) for standard in (717, 767))


def read(data: bytes, layout: Map717 | Map767 = DEMO_717) -> dict:
    """Series of every parameter of a recording, by name."""
    recording = recognise(np.frombuffer(data, np.uint8), layout)
    return {s.parameter.name: s for s in decode(recording, layout.parameters.values())}


def frames_717(
    layout: Map717, raw: dict[str, np.ndarray], first_count: int = 7, filling: int = 0, frames: int = 0
) -> np.ndarray:
    """Words (frames, subframes x words); `raw` holds (values,) a parameter, as many as the frames have samples."""
    per_frame = len(layout.sync_words)
    n = frames or max(len(r) // len(layout.parameters[k].samples) * layout.parameters[k].cycle for k, r in raw.items())
    rng = np.random.default_rng(filling)
    words = rng.integers(0, 4096, (n, per_frame * layout.words)).astype(np.uint64)
    counter = layout.counter
    if counter is not None:
        words[:, counter.piece.word] = (np.arange(n) + first_count) % (1 << counter.piece.bits) << counter.piece.low
    for name, values in raw.items():
        parameter = layout.parameters[name]
        place = values.reshape(-1, len(parameter.samples))
        starts = np.flatnonzero((np.arange(n) + first_count) % parameter.cycle == 0)[: len(place)]
        for i, sample in enumerate(parameter.samples):
            for piece in sample.pieces:
                mask = (1 << piece.bits) - 1
                rows = starts + piece.frame
                inside = rows < n
                part = place[: starts.size, i][inside] >> np.uint64(piece.into) & np.uint64(mask)
                other_bits = words[rows[inside], piece.word] & ~np.uint64(mask << piece.low)
                words[rows[inside], piece.word] = other_bits | part << np.uint64(piece.low)
    words = words.astype(np.uint16)
    words.reshape(n, per_frame, -1)[:, :, 0] = layout.sync_words
    return words


def pack(words: np.ndarray, packing: Packing = PACKINGS[0], before_bits: int = 0) -> bytes:
    """Words one after the other, as a file holds them, after some bits of another recording."""
    if packing.aligned:
        return bytes(before_bits // 8) + words.ravel().astype("<u2" if packing.order == "little" else ">u2").tobytes()
    bits = (words.ravel()[:, None] >> np.arange(12)) & 1  # least significant first
    stream = (bits if packing.order == "little" else bits[:, ::-1]).ravel().astype(np.uint8)
    stream = np.concatenate([np.zeros(before_bits, np.uint8), stream])
    return np.packbits(stream, bitorder=packing.order).tobytes()


def frames_767(layout: Map767, raw: dict[str, np.ndarray], begin_ms: int = 1_012_050) -> bytes:
    """A recording: its head, then all frames in order of time; `raw` holds a value a frame."""
    head = _frame(1, 0, f"647A-00 {layout.revision}".ljust(130).encode())
    frames = []
    for number, kind in layout.frames.items():
        own = [p for p in layout.parameters.values() if p.frame_id == number]
        for i in range(min(len(raw[p.name]) for p in own)):
            body = 0
            for p in own:
                (piece,) = p.samples[0].pieces
                body |= int(raw[p.name][i]) << ((kind.size - 12) * 8 - piece.low - piece.bits)
            time_ms = begin_ms + number + round(1000 * i / kind.rate_hz)
            frames.append((time_ms, number, body.to_bytes(kind.size - 12, "big")))
    return head + b"".join(_frame(number, time_ms, body) for time_ms, number, body in sorted(frames))


def _frame(number: int, time_ms: int, body: bytes) -> bytes:
    tail = number.to_bytes(2, "big")
    return b"\xeb\x90" + (len(body) + 12).to_bytes(2, "big") + time_ms.to_bytes(4, "big") + tail + body + tail


def random_raw(layout: Map717 | Map767, rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    """Raw words that are values: digits below ten, minutes below sixty, letters, finite numbers."""
    return {name: _raw(p.coding, rng, n // p.cycle * len(p.samples)) for name, p in layout.parameters.items()}


def raw_767(seed: int, seconds: int = 40) -> dict[str, np.ndarray]:
    """Of the demo map, a value a frame."""
    raw = random_raw(DEMO_767, np.random.default_rng(seed), 5 * seconds)
    return {name: values[: int(seconds * DEMO_767.parameters[name].rate_hz)] for name, values in raw.items()}


def _raw(coding, rng: np.random.Generator, n: int) -> np.ndarray:
    def number(low: int, high: int) -> np.ndarray:
        return rng.integers(low, high, n, dtype=np.uint64)

    if coding.kind == "float":
        kind = {32: np.float32, 64: np.float64}[coding.bits]
        return rng.normal(300, 80, n).astype(kind).view(f"u{coding.bits // 8}").astype(np.uint64)
    if coding.kind == "utc":
        return number(0, 60) | number(0, 60) << np.uint64(6) | number(0, 24) << np.uint64(12)
    if coding.kind in ("bcd", "characters"):
        low, high = (0, 10) if coding.kind == "bcd" else (65, 91)
        word = np.zeros(n, np.uint64)
        for place, bits in coding.digits:
            word |= number(low, min(high, 1 << bits)) << np.uint64(place)
        return word
    return number(0, 1 << (coding.bits + (coding.sign is not None)))


def message_file(*texts: str) -> bytes:
    """Printed reports as a recorder keeps them: each told by its length, all cut into blocks."""
    stream = b""
    for i, text in enumerate(texts, 1):
        body = text.replace("\n", "\r\n").encode()
        end = b"\x03" if i == len(texts) else b"\x17"
        stream += b"\x02\x02" + body + f"{len(body):05}{i:04}0013000".encode() + end * 2
    blocks = [stream[i : i + 1000].ljust(1000, b"F") for i in range(0, len(stream), 1000)]
    heads = (b"".join(n.to_bytes(4, "little") for n in (7, 1022 * i, 2, 1002, 0)) for i in range(1, len(blocks) + 1))
    return b"".join(head + b"\x11" + block + b"\x12" for head, block in zip(heads, blocks, strict=True)) + b"\r\n"


def printed_report(
    aircraft: str, at: datetime, altitude_ft: float, bleed_state: str = "1.20 111 11 0 11 111 1.20"
) -> str:
    """A report of the A330 that is a head and no more; `bleed_state` is what it says of flow, valves and cross-feed."""
    return f"""
               A330 ENGINE TRIM BALANCE REPORT <08>       PAGE 01 OF 01

C1 .{aircraft} {at:%d%b%y} {at:%H.%M.%S} ZJHK ZGSZ TST1234    4000 114
C2 010 06.0 000000 D1033PW04C_TST       000 000 000
C3 -21.7 {altitude_ft:05.0f} 0.801 11- {bleed_state} 0
""".upper()


def vec(**files: str) -> bytes:
    """A ground station's archive: each file in UTF-16, `par`, `fra` or `frd` its ending."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for ending, text in files.items():
            archive.writestr(f"000001.{ending}", text.replace("\n", "\r\n").encode("utf-16"))
    return buffer.getvalue()
