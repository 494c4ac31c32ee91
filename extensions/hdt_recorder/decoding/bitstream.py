"""Words of 12 bits in the bytes of a file: aligned in 16 bits, or one after the other as a stream of bits."""

from dataclasses import dataclass
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
            here, there, near, far = part[:-1], part[1:], np.uint8(shift), np.uint8(8 - shift)
            part = here >> near | there << far if little else here << near | there >> far
        a, b, c = part[: part.size // 3 * 3].reshape(-1, 3).T.astype(np.uint16)
        pair = (a | (b & 15) << 8, b >> 4 | c << 4) if little else (a << 4 | b >> 4, (b & 15) << 8 | c)
        return np.stack(pair, axis=1).ravel()


PACKINGS = tuple(Packing(aligned, order) for aligned in (True, False) for order in ("little", "big"))
