"""How recorded bits become a value: declarations, filled in by a parameter map; words of 12 bits in bytes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]
Words12 = npt.NDArray[np.uint16]
Order = Literal["little", "big"]


@dataclass(frozen=True, slots=True)
class Packing:
    """How words lie in bytes. A place is counted in units: bytes where words are aligned, bits where they are not.

    Attributes
    ----------
    aligned : bool
        One word in two bytes, its four high bits unused; else 12 bits follow on 12 bits, from any bit on.
    order : "little" or "big"
        Which byte, or which bit of a byte, comes first in time: the least or the most significant.
    """

    aligned: bool
    order: Order

    @property
    def word(self) -> int:
        """Return the units of a word."""
        return 2 if self.aligned else 12

    @property
    def byte(self) -> int:
        """Return the units of a byte."""
        return 1 if self.aligned else 8

    def words_at(self, data: Bytes, places: npt.NDArray[np.int64]) -> Words12:
        """Return the word at each place; each must end within the data."""
        at, shift = (places, 0) if self.aligned else (places >> 3, (places & 7).astype(np.uint32))
        last = data.size - 1
        a, b, c = (np.take(data, np.minimum(at + i, last)).astype(np.uint32) for i in range(3))
        if self.order == "little":
            value = (a | b << 8 | c << 16) >> shift
        else:
            value = (a << 16 | b << 8 | c) >> (8 if self.aligned else 12 - shift)
        return (value & 0xFFF).astype(np.uint16)

    def words_from(self, data: Bytes, place: int, count: int) -> Words12:
        """Return `count` consecutive words; zeros beyond the end."""
        first, shift = divmod(place, self.byte)
        size = 2 * count if self.aligned else (12 * count + 7) // 8 + 3
        part = data[first : first + size]
        if part.size < size:
            part = np.concatenate([part, np.zeros(size - part.size, np.uint8)])
        if self.aligned:
            words = part.view("<u2" if self.order == "little" else ">u2")
            return words if words.size and words.max() <= 0xFFF else words & np.uint16(0xFFF)
        return self._unpack(part, shift)[:count]

    def _unpack(self, part: Bytes, shift: int) -> Words12:
        little = self.order == "little"
        if shift:
            here = part[:-1]
            there = part[1:]
            near = np.uint8(shift)
            far = np.uint8(8 - shift)
            part = here >> near | there << far if little else here << near | there >> far
        a, b, c = part[: part.size // 3 * 3].reshape(-1, 3).T.astype(np.uint16)
        pair = (a | (b & 15) << 8, b >> 4 | c << 4) if little else (a << 4 | b >> 4, (b & 15) << 8 | c)
        return np.stack(pair, axis=1).ravel()


PACKINGS = tuple(Packing(aligned, order) for aligned in (True, False) for order in ("little", "big"))


Floats = npt.NDArray[np.float64]
Words = npt.NDArray[np.uint64]
Kind = Literal["binary", "bcd", "discrete", "characters", "utc", "float"]
WORD = 64
"""Bits that are put together to a number at most."""
LENGTHS: dict[str, tuple[int, ...]] = {"float": (16, 32, 64), "utc": (17,)}
MOST_DECIMALS = 15
Step = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True)
class Polynomial:
    """Sum of `coefficients[i] * x**i`; a linear scale is `(offset, scale)`."""

    coefficients: tuple[float, ...]

    def __call__(self, x: Floats) -> Floats:
        """Return the value of `x`, elementwise; a plain scale costs one multiplication and rounds once."""
        offset, *higher = self.coefficients
        if len(higher) == 1:
            product = x * higher[0]
            return product + offset if offset else product
        value: Floats = np.polynomial.polynomial.polyval(x, np.asarray(self.coefficients))
        return value


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight pieces: from `starts[i]` on, `scales[i] * x + offsets[i]`. `starts` rises; below the first, no value."""

    starts: tuple[float, ...]
    scales: tuple[float, ...]
    offsets: tuple[float, ...]

    def __call__(self, x: Floats) -> Floats:
        """Return the value of `x`, elementwise."""
        place = np.searchsorted(self.starts, x, side="right") - 1
        within = np.maximum(place, 0)
        return np.where(place < 0, np.nan, np.take(self.scales, within) * x + np.take(self.offsets, within))


@dataclass(frozen=True, slots=True)
class LookupTable:
    """Straight lines between points; no value outside them. `x` rises."""

    x: tuple[float, ...]
    y: tuple[float, ...]

    def __call__(self, x: Floats) -> Floats:
        """Return the value of `x`, elementwise."""
        return np.interp(x, self.x, self.y, left=np.nan, right=np.nan)


@dataclass(frozen=True, slots=True)
class Coding:
    """Meaning of the bits of one raw word; bits are counted from 0, the least significant.

    Attributes
    ----------
    kind : Kind
        `binary` (BNR) with `steps`, `bcd`, `discrete` (packed bits too) with `texts`, `characters`, `utc`, or `float`
        (IEEE 754, as computed on board).
    low, bits : int
        The number: `bits` of them from `low` on, without the sign.
    sign : int, optional
        Place of the sign bit; two's complement.
    steps : tuple of Step
        Applied one after the other to the number.
    digits : tuple of (low, bits)
        Digits or characters, first the one that is written first.
    decimals, base : int, float
        How a BCD number is written: so many digits after the point, and added to.
    texts : dict
        Meaning of a number.
    """

    kind: Kind
    low: int = 0
    bits: int = 1
    sign: int | None = None
    steps: tuple[Step, ...] = ()
    digits: tuple[tuple[int, int], ...] = ()
    decimals: int = 0
    base: float = 0.0
    texts: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise `ValueError` for bits outside a word of 64, and for lengths that the kind can't have."""
        signs = () if self.sign is None else ((self.sign, 1),)
        for low, bits in ((self.low, self.bits), *self.digits, *signs):
            check_bits(low, bits)
        if self.bits not in LENGTHS.get(self.kind, (self.bits,)):
            raise ValueError(f"{self.bits} bits; {self.kind} has {' or '.join(map(str, LENGTHS[self.kind]))}")
        if not 0 <= self.decimals <= MOST_DECIMALS:
            raise ValueError(f"{self.decimals} decimals; 0 to {MOST_DECIMALS} are possible")


def check_bits(low: int, bits: int) -> None:
    """Raise `ValueError` for bits that are none of a word of 64."""
    if bits < 1 or low < 0 or low + bits > WORD:
        raise ValueError(f"bits {low + 1} to {low + bits} are outside a word of {WORD}")


def cut_digits(widths: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Return place and bits of each digit or character from their widths, the first written first."""
    return tuple((sum(widths[i + 1 :]), width) for i, width in enumerate(widths))
