"""Claim: all parameters of a ten-hour ARINC 717 recording of 1,024 words a second in 5 s of one core, map to arrays.

The recording is made up: random words, half of them numbers, the others four discretes each, 2,555 parameters with 92
million values. The peer is NumPy, which turns every word of the same file into a float64 and does nothing else. CPU of
one thread, best of the rounds, contestants in turn. Run: `python -m benchmarks.recorder`.
"""

from collections.abc import Callable

import numpy as np

from benchmarks.harness import best_cpu_s
from hdt_recorder.decoding.coding import Coding, Polynomial
from hdt_recorder.decoding.fit import decode, recognise
from hdt_recorder.decoding.layout import SYNC_WORDS, Counter, Map717, Parameter, Piece, Sample

HOURS, WORDS, ROUNDS = 10, 1024, 3


def parameters() -> dict[str, Parameter]:
    by_name = {}
    number = Coding("binary", bits=11, sign=11, steps=(Polynomial((0.0, 0.25)),))
    switch = Coding("discrete", texts={0: "OFF", 1: "ON"})
    for word in range(2, WORDS):
        for low, coding, bits in [(0, number, 12)] if word % 2 else [(i, switch, 1) for i in range(4)]:
            at = tuple(Sample(float(s), (Piece(s * WORDS + word, low, bits),)) for s in range(4))
            by_name[f"P{word}_{low}"] = Parameter(f"P{word}_{low}", coding, at, 1.0)
    return by_name


def recording() -> np.ndarray:
    """Words, (seconds, words a second)."""
    seconds = HOURS * 3600
    words = np.random.default_rng(0).integers(0, 4096, (seconds, WORDS), dtype=np.uint16)
    words[:, 0] = np.resize(SYNC_WORDS, seconds)
    words[::4, 1] = np.arange(seconds // 4) % 4096
    return words


def stream(words: np.ndarray) -> np.ndarray:
    """Twelve bits after twelve bits, the least significant first."""
    a, b = words.reshape(-1, 2).T
    return np.stack([a & 255, a >> 8 | (b & 15) << 4, b >> 4], axis=1).astype(np.uint8).ravel()


def main() -> None:
    layout = Map717(WORDS, parameters(), Counter(Piece(1, 0, 12)))
    words = recording()
    aligned, bits = words.view(np.uint8).ravel(), stream(words)
    values = 0

    def read(data: np.ndarray) -> None:
        nonlocal values
        values = sum(s.t_s.size for s in decode(recognise(data, layout), layout.parameters.values()))

    contestants: dict[str, Callable[[], object]] = {
        "NumPy, every word a float64": lambda: aligned.view("<u2").astype(np.float64),
        "ours, words in 16 bits": lambda: read(aligned),
        "ours, stream of bits": lambda: read(bits),
    }
    best = best_cpu_s(contestants, ROUNDS)
    peer = next(iter(best.values()))
    print(
        f"{HOURS} h, {WORDS:,} words a second, {len(layout.parameters):,} parameters, {values / 1e6:.0f} million values"
    )
    for name, seconds in best.items():
        print(f"{name:28}  {seconds:6.2f} s  {seconds / peer:6.1f} times the peer")


if __name__ == "__main__":
    main()
