"""Samples of an ARINC 717 parameter from places as people write them: subframe, word and bits, counted from 1."""

from collections.abc import Sequence
from dataclasses import dataclass

from hdt_recorder.decoding.layout import Piece, Sample

BITS = 12


@dataclass(frozen=True, slots=True)
class Place:
    """Bits of a word. `frame` is the frame of the superframe, from 1; 0 for what every frame holds."""

    subframe: int
    word: int
    lowest_bit: int
    highest_bit: int
    frame: int = 0

    @property
    def bits(self) -> int:
        """Return how many bits."""
        return self.highest_bit - self.lowest_bit + 1


def sample_at(parts: Sequence[Place], overlaps: Sequence[int], words: int, subframes: int, subframe_s: float) -> Sample:
    """Build a sample from its parts, least significant first; part i shares `overlaps[i]` bits with the one before.

    Raises
    ------
    ValueError
        For a place outside the frame.
    """
    pieces, into = [], 0
    for part, overlap in zip(parts, overlaps, strict=True):
        inside = 1 <= part.subframe <= subframes and 1 <= part.word <= words
        if not inside or not 1 <= part.lowest_bit <= part.highest_bit <= BITS:
            where = f"subframe {part.subframe} word {part.word} bits {part.lowest_bit}-{part.highest_bit}"
            raise ValueError(f"{where} is outside the frame of {subframes} subframes of {words} words of {BITS} bits")
        word = (part.subframe - 1) * words + part.word - 1
        into -= overlap
        pieces.append(Piece(word, part.lowest_bit - 1, part.bits, into, max(part.frame - 1, 0)))
        into += part.bits
    first = pieces[0]
    return Sample(subframe_s * (first.word / words + first.frame * subframes), tuple(pieces))


def word_bits(sample: Sample) -> int:
    """Return the bits of the raw word that a sample puts together."""
    return max(p.into + p.bits for p in sample.pieces)
