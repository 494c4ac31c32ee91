"""Parameter maps: where a recording holds its parameters, whatever format the map came in."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from hdt_recorder.decoding.coding import Coding, check_bits

SYNC_WORDS = (0o1107, 0o2670, 0o5107, 0o6670)
"""First word of subframes 1 to 4, ARINC 717."""


MOST_WORDS, MOST_SUBFRAMES = 1 << 13, 32
"""Bounds of a frame: ARINC 717 goes to 4,096 words, ARINC 647A to 32 subframes."""


class MapError(ValueError):
    """Raised for a parameter map that can't be read or does not fit the recording; names what disagrees."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Bits that lie together. `word` counts from 0 within the frame; ARINC 767 has bit `low` of the whole frame.

    Attributes
    ----------
    word : int
        Word of the frame, all subframes one after the other (ARINC 717); 0 for ARINC 767.
    low, bits : int
        `bits` bits from `low` on: of the word, from its least significant (717); of the frame, from its first (767).
    into : int
        Place of the least of them in the raw word that is put together.
    frame : int
        Frame of the superframe, from 0.
    """

    word: int
    low: int
    bits: int
    into: int = 0
    frame: int = 0

    def __post_init__(self) -> None:
        """Raise `ValueError` for what no frame can have."""
        check_bits(self.into, self.bits)
        if min(self.word, self.low, self.frame) < 0:
            raise ValueError(f"word {self.word + 1}, bit {self.low + 1}, frame {self.frame + 1} is counted from 1")


@dataclass(frozen=True, slots=True)
class Sample:
    """One value a frame (or superframe): `at_s` seconds after its start, put together from `pieces`."""

    at_s: float
    pieces: tuple[Piece, ...]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A recorded quantity.

    Attributes
    ----------
    samples : tuple of Sample
        Values of one frame, in order of time; of one superframe where `cycle` is more than 1.
    cycle : int
        Frames of a superframe, 1 for what every frame holds.
    frame_id : int
        The ARINC 767 frame that holds it.
    rate_hz : float
        Values a second.
    lowest, highest : float, optional
        Operational range; a value outside is recorded as it is and is evidence against the map.
    unreadable : str
        Why it has no value, where the map gives a rule that only a person can follow.
    """

    name: str
    coding: Coding
    samples: tuple[Sample, ...]
    rate_hz: float
    unit: str = ""
    description: str = ""
    cycle: int = 1
    frame_id: int = 0
    lowest: float | None = None
    highest: float | None = None
    unreadable: str = ""


@dataclass(frozen=True, slots=True)
class Counter:
    """A number that grows by one each frame, and the value that it has in the first frame of a superframe."""

    piece: Piece
    first: int = 0


@dataclass(frozen=True, slots=True)
class Map717:
    """An ARINC 717 frame: four subframes of `words` words of 12 bits, `subframe_s` seconds each."""

    words: int
    parameters: Mapping[str, Parameter]
    counter: Counter | None = None
    sync_words: tuple[int, ...] = SYNC_WORDS
    subframe_s: float = 1.0

    def __post_init__(self) -> None:
        """Raise `MapError` for a frame that can't be, and for parameters outside it."""
        if not (1 < self.words <= MOST_WORDS and self.subframe_s > 0.0 and 1 < len(self.sync_words) <= MOST_SUBFRAMES):
            shape = f"{len(self.sync_words)} subframes of {self.words} words and {self.subframe_s} s"
            raise MapError(f"{shape}; there are 2 to {MOST_SUBFRAMES}, of 2 to {MOST_WORDS:,} words")
        if len(set(self.sync_words)) < len(self.sync_words) or not all(0 <= s < 1 << 12 for s in self.sync_words):
            raise MapError("sync words differ from each other and have 12 bits")
        size = self.words * len(self.sync_words)
        pieces_by_name = ((n, s.pieces) for n, p in self.parameters.items() for s in p.samples)
        counter_pieces = [("the frame counter", (self.counter.piece,))] if self.counter else []
        for name, pieces in (*counter_pieces, *pieces_by_name):
            if any(p.word >= size or p.low + p.bits > 12 for p in pieces):
                shape = f"{name} lies outside the frame of {len(self.sync_words)} subframes of {self.words} words"
                raise MapError(shape)


@dataclass(frozen=True, slots=True)
class Frame767:
    """One kind of frame: its length with head and tail, and how often it comes."""

    frame_id: int
    title: str
    size: int
    rate_hz: float | None


@dataclass(frozen=True, slots=True)
class Map767:
    """ARINC 767 frames by number, and their parameters. `revision` is the name that a recording's head must hold."""

    frames: Mapping[int, Frame767]
    parameters: Mapping[str, Parameter]
    revision: str = ""


ParameterMap = Map717 | Map767
WHOLE = ".whole"
"""Ends the name of a parameter as it must be meant, beside as its map lists it; see `vec_frames`."""
FILLED_GAP_S = 600.0
"""A shorter gap is damage, and its frames are there as nulls; a longer one is a recorder that stood still."""
HEAD_767 = 12
"""Bytes of an ARINC 767 frame beside its data: sync, length, time, number, and the number again."""


def lay_out(parameters: Iterable[Parameter], frame_id: int, rate_hz: float | None) -> tuple[list[Parameter], int]:
    """Lay out the parameters of an ARINC 767 frame bit after bit; return them and the frame's length in bytes."""
    result = []
    low = 0
    for p in parameters:
        bits = p.coding.bits + (p.coding.sign is not None)
        place = Sample(0.0, (Piece(0, low, bits),))
        result.append(replace(p, samples=(place,), frame_id=frame_id, rate_hz=rate_hz or 0.0))
        low += bits
    return result, HEAD_767 + (low + 7) // 8


@dataclass(frozen=True, slots=True)
class Damage:
    """Count what a recording lost, in subframes (ARINC 717) or frames (ARINC 767).

    Attributes
    ----------
    whole, damaged, missing : int
        Units that can be read; that are there and can't; that a gap took.
    breaks : int
        Times that the recorder's clock or counter was set back: another recording begins.
    skipped_bytes : int
        Bytes that belong to no unit.
    """

    unit: str
    whole: int
    damaged: int
    missing: int
    breaks: int
    skipped_bytes: int


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
    pieces = []
    into = 0
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
