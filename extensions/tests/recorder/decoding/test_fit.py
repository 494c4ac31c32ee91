"""A map that does not fit its recording is told by what disagrees, and decodes nothing."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import DATA, frames_717, frames_767, pack, random_raw

from hdt_recorder.decoding.coding import PACKINGS
from hdt_recorder.decoding.fit import recognise
from hdt_recorder.decoding.frames_717 import WORD_COUNTS
from hdt_recorder.decoding.layout import MapError, Piece, Sample
from hdt_recorder.decoding.plain_map import read_toml

DEMO_717 = read_toml((DATA / "demo_717.toml").read_text())
DEMO_767 = read_toml((DATA / "demo_767.toml").read_text())


def written_717() -> np.ndarray:
    raw = random_raw(DEMO_717, np.random.default_rng(2), 32)
    for name in ("ALTITUDE", "PACK_TEMP"):
        raw[name] %= 400  # within their operational range
    return np.frombuffer(pack(frames_717(DEMO_717, raw), PACKINGS[0]), np.uint8)


def uncounted(words: int, packing) -> np.ndarray:
    """Frames of random words, the counter too."""
    return np.frombuffer(
        pack(frames_717(replace(DEMO_717, words=words, counter=None), {}, frames=32), packing), np.uint8
    )


def written_767(layout=DEMO_767) -> np.ndarray:
    raw = random_raw(DEMO_767, np.random.default_rng(2), 200)
    seconds = {n: r[: int(40 * layout.parameters[n].rate_hz)] for n, r in raw.items()}
    return np.frombuffer(frames_767(layout, seconds), np.uint8)


@pytest.mark.parametrize("words", WORD_COUNTS[1:])
@pytest.mark.parametrize("packing", [PACKINGS[0], PACKINGS[2]], ids=["aligned", "stream"])
def test_another_number_of_words_is_told(words, packing):
    data = uncounted(words, packing)
    with pytest.raises(MapError, match=f"the recording has {words:,} words a second, the map 64"):
        recognise(data, DEMO_717)


def test_a_frame_counter_elsewhere_is_told():
    data = uncounted(64, PACKINGS[0])
    with pytest.raises(MapError, match=r"frame counter \(subframe 1 word 2\) does not count: \d+% of frames"):
        recognise(data, DEMO_717)


def test_impossible_values_are_told():
    """All parameters a few words further on: the counter counts, but minutes, digits and temperatures can't be."""
    names = ["ALTITUDE", "PACK_TEMP", "FREQUENCY", "UTC"]
    parameters = {f"{n}{i}": replace(DEMO_717.parameters[n], name=f"{n}{i}") for n in names for i in range(4)}

    def shift(p, by: int):
        samples = tuple(Sample(s.at_s, tuple(replace(x, word=x.word + by) for x in s.pieces)) for s in p.samples)
        return replace(p, samples=samples)

    data = written_717()
    recognise(data, replace(DEMO_717, parameters=parameters))
    elsewhere = {n: shift(p, 12) for n, p in parameters.items()}
    with pytest.raises(MapError, match=r"impossible values in \d+ of 16 parameters that tell \("):
        recognise(data, replace(DEMO_717, parameters=elsewhere))


def test_the_other_standard_is_told():
    with pytest.raises(MapError, match=r"the recording is ARINC 767 .* the map ARINC 717"):
        recognise(written_767(), DEMO_717)
    with pytest.raises(MapError, match="it is ARINC 717 with 64 words a second"):
        recognise(written_717(), DEMO_767)


def test_no_recording_is_told():
    for layout in (DEMO_717, DEMO_767):
        with pytest.raises(MapError, match=r"no ARINC \d+ frame in 9,000 bytes"):
            recognise(np.zeros(9000, np.uint8), layout)


def test_another_length_of_a_frame_is_told():
    frames = {**DEMO_767.frames, 3: replace(DEMO_767.frames[3], size=30)}
    with pytest.raises(MapError, match="frame 3 has 21 bytes, by the map 30"):
        recognise(written_767(), replace(DEMO_767, frames=frames))


def test_another_rate_is_told():
    frames = {**DEMO_767.frames, 4: replace(DEMO_767.frames[4], rate_hz=10.0)}
    with pytest.raises(MapError, match=r"frame 4 comes every 0\.2 s, by the map every 0\.1 s"):
        recognise(written_767(), replace(DEMO_767, frames=frames))


def test_another_revision_is_told():
    with pytest.raises(MapError, match="the recording says '647A-00 DEMO_MAP_7', the map is 'DEMO_MAP_8'"):
        recognise(written_767(), replace(DEMO_767, revision="DEMO_MAP_8"))


def test_floats_cut_at_the_wrong_bit_are_told():
    wide = DEMO_767.parameters["PRESSURE"]
    misaligned = {
        f"P{i}": replace(wide, name=f"P{i}", samples=(Sample(0.0, (Piece(0, 33 + i % 7, 32),)),)) for i in range(1, 17)
    }
    misaligned = {n: p for n, p in misaligned.items() if p.samples[0].pieces[0].low != 33}
    with pytest.raises(MapError, match="impossible values"):
        recognise(written_767(), replace(DEMO_767, parameters=misaligned))
