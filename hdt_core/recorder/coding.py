"""How the bits of a recorded number become a value: declarations, filled in by a parameter map."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Words = npt.NDArray[np.uint64]
Kind = Literal["binary", "bcd", "discrete", "characters", "utc", "float"]
Step = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True)
class Polynomial:
    """Sum of `coefficients[i] * x**i`; a linear scale is `(offset, scale)`."""

    coefficients: tuple[float, ...]

    def __call__(self, x: Floats) -> Floats:
        """Value of `x`, elementwise; a plain scale costs one multiplication and rounds once."""
        offset, *higher = self.coefficients
        if len(higher) == 1:
            scaled = x * higher[0]
            return scaled + offset if offset else scaled
        value: Floats = np.polynomial.polynomial.polyval(x, np.asarray(self.coefficients))
        return value


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight pieces: from `starts[i]` on, `scales[i] * x + offsets[i]`. `starts` rises; below the first, no value."""

    starts: tuple[float, ...]
    scales: tuple[float, ...]
    offsets: tuple[float, ...]

    def __call__(self, x: Floats) -> Floats:
        """Value of `x`, elementwise."""
        place = np.searchsorted(self.starts, x, side="right") - 1
        within = np.maximum(place, 0)
        return np.where(place < 0, np.nan, np.take(self.scales, within) * x + np.take(self.offsets, within))


@dataclass(frozen=True, slots=True)
class Table:
    """Straight lines between points; no value outside them. `x` rises."""

    x: tuple[float, ...]
    y: tuple[float, ...]

    def __call__(self, x: Floats) -> Floats:
        """Value of `x`, elementwise."""
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


def cut_digits(widths: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Place and bits of each digit or character from their widths, the first written first."""
    return tuple((sum(widths[i + 1 :]), width) for i, width in enumerate(widths))
