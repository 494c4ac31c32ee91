"""Raw words to values: binary, BCD, discrete, characters, UTC, and what was computed on board."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hdt_recorder.decoding.coding import Coding, Floats, Words

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Labels:
    """Texts, each held once: element i is `names[codes[i]]`, None where a number has no meaning."""

    codes: npt.NDArray[np.int32]
    names: tuple[str | None, ...]


@dataclass(frozen=True, slots=True)
class Values:
    """Values of words; undefined where not `valid`.

    Attributes
    ----------
    value : (n,) float64 or None
        Numbers; None for characters.
    text : Labels or None
        Text, not numbers: characters, times, meanings of a discrete, a BCD number as written.
    valid : (n,) bool
        False where the bits are no value: a digit above nine, minute 61, NaN.
    """

    value: Floats | None
    text: Labels | None
    valid: Flags


def read_words(words: Words, coding: Coding) -> Values:
    """Decode the raw words of one parameter, (n,) uint64."""
    with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is not finite, and not valid
        return _READERS[coding.kind](words, coding)


def extract_bits(words: Words, low: int, bits: int) -> Words:
    """Return the number of `bits` bits from bit `low` on."""
    return (words >> np.uint64(low)) & np.uint64((1 << bits) - 1)


def _binary(words: Words, coding: Coding) -> Values:
    value = extract_bits(words, coding.low, coding.bits).astype(np.float64)
    if coding.sign is not None:
        value -= extract_bits(words, coding.sign, 1) * float(1 << coding.bits)
    for step in coding.steps:
        value = step(value)
    return Values(value, None, np.isfinite(value))


def _bcd(words: Words, coding: Coding) -> Values:
    value = np.zeros(words.size)
    valid = np.ones(words.size, bool)
    for low, bits in coding.digits:
        digit = extract_bits(words, low, bits)
        value = 10.0 * value + digit
        valid &= digit <= 9
    if coding.sign is not None:
        value = np.where(extract_bits(words, coding.sign, 1) == 1, -value, value)
    text = _label(value, lambda v: f"{v / 10**coding.decimals + coding.base:.{coding.decimals}f}")
    for step in coding.steps:
        value = step(value)
    return Values(value, text, valid)


def _discrete(words: Words, coding: Coding) -> Values:
    number = extract_bits(words, coding.low, coding.bits)
    top = max(coding.texts, default=-1)
    names = (*(coding.texts.get(i) for i in range(top + 1)), None)
    codes = np.minimum(number, np.uint64(top + 1)).astype(np.int32)
    return Values(number.astype(np.float64), Labels(codes, names) if coding.texts else None, np.ones(words.size, bool))


def _characters(words: Words, coding: Coding) -> Values:
    codes = [extract_bits(words, low, bits) for low, bits in coding.digits]
    text = _label(words, lambda w: "".join(chr(int(w) >> low & (1 << bits) - 1) for low, bits in coding.digits))
    return Values(None, text, np.logical_and.reduce([c < 128 for c in codes]))


def _utc(words: Words, coding: Coding) -> Values:
    """Decode hours (5 bits), minutes (6), seconds (6), binary, as ARINC 429 label 150 has them."""
    second, minute, hour = (extract_bits(words, coding.low + low, bits) for low, bits in ((0, 6), (6, 6), (12, 5)))
    value = (hour * np.uint64(3600) + minute * np.uint64(60) + second).astype(np.float64)
    text = _label(value, lambda v: f"{int(v) // 3600:02d}:{int(v) // 60 % 60:02d}:{int(v) % 60:02d}")
    return Values(value, text, (second < 60) & (minute < 60) & (hour < 24))


def _label(numbers: npt.NDArray[Any], write: Callable[[Any], str]) -> Labels:
    """Return the text of each number, written once for each that occurs."""
    distinct, codes = np.unique(numbers, return_inverse=True)
    return Labels(codes.astype(np.int32), tuple(write(v) for v in distinct))


def _float(words: Words, coding: Coding) -> Values:
    kind = {16: np.float16, 32: np.float32, 64: np.float64}[coding.bits]
    bits = extract_bits(words, coding.low, coding.bits).astype(f"uint{coding.bits}")
    value = bits.view(kind).astype(np.float64)
    for step in coding.steps:
        value = step(value)
    return Values(value, None, np.isfinite(value))


_READERS = {
    "binary": _binary, "bcd": _bcd, "discrete": _discrete, "characters": _characters, "utc": _utc, "float": _float,
}  # fmt: skip
