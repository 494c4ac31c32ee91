"""Recordings that we wrote ourselves come back, whatever the packing and rate; a map that does not fit is told of."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import DEMO_717, DEMO_767, frames_717, frames_767, pack, random_raw, raw_767, read

from hdt_recorder.decoding.coding import PACKINGS, Coding
from hdt_recorder.decoding.fit import recognise
from hdt_recorder.decoding.frames_717 import WORD_COUNTS
from hdt_recorder.decoding.layout import Counter, Map717, MapError, Parameter, Piece, Sample

ids = [f"{'aligned' if p.aligned else 'stream'} {p.order}" for p in PACKINGS]


def texts(series) -> list:
    return [series.text.names[c] if k else None for c, k in zip(series.text.codes, series.valid, strict=True)]


def signed(raw: int, bits: int) -> int:
    return raw - (1 << bits) if raw >> (bits - 1) else raw


def digits(raw: int) -> int:
    """Of 3, 4, 4 and 4 bits."""
    return 1000 * (raw >> 12) + 100 * (raw >> 8 & 15) + 10 * (raw >> 4 & 15) + (raw & 15)


MEANT_717 = {
    "ALTITUDE": lambda r: float(signed(r, 18)),
    "PACK_TEMP": lambda r: 0.25 * signed(r, 12) + 1.5,
    "PITCH": lambda r: 0.17578125 * signed(r, 10),
    "FLOW": lambda r: 0.001 * r if r < 1000 else 0.002 * r - 1.0,
    "VALVE": float,
    "MODE": float,
    "FREQUENCY": lambda r: 100.0 + digits(r) / 100.0,
    "UTC": lambda r: (r >> 12) * 3600.0 + (r >> 6 & 63) * 60.0 + (r & 63),
    "WEIGHT": lambda r: 40.0 * r,
    "COMPUTED": lambda r: struct.unpack("<f", struct.pack("<I", r))[0],
}


@pytest.mark.parametrize("packing", PACKINGS, ids=ids)
@pytest.mark.parametrize("before_bits", [0, 24, 8 * 37])
def test_every_717_value_comes_back(packing, before_bits):
    raw = random_raw(DEMO_717, np.random.default_rng(3), 48)
    series = read(pack(frames_717(DEMO_717, raw, first_count=0), packing, before_bits))
    for name, mean in MEANT_717.items():
        assert series[name].valid.all(), name
        np.testing.assert_allclose(series[name].value, [mean(int(r)) for r in raw[name]], rtol=1e-12, err_msg=name)
    meanings = {0: "OFF", 1: "LOW", 2: "NORMAL", 5: "HIGH"}
    assert texts(series["MODE"]) == [meanings.get(int(r)) for r in raw["MODE"]]
    assert texts(series["CITY"]) == [int(r).to_bytes(4, "big").decode() for r in raw["CITY"]]
    assert texts(series["FREQUENCY"]) == [f"{100 + digits(int(r)) / 100:.2f}" for r in raw["FREQUENCY"]]
    assert texts(series["UTC"]) == [f"{r >> 12:02d}:{r >> 6 & 63:02d}:{r & 63:02d}" for r in map(int, raw["UTC"])]


def test_times_follow_places_in_frame():
    raw = random_raw(DEMO_717, np.random.default_rng(0), 32)
    series = read(pack(frames_717(DEMO_717, raw, first_count=0)))
    np.testing.assert_allclose(series["PACK_TEMP"].t_s, np.arange(128) + 4 / 64)
    np.testing.assert_allclose(series["PITCH"].t_s, np.arange(512) / 4 + 5 / 64)
    np.testing.assert_allclose(series["WEIGHT"].t_s, [18.1875, 50.1875, 82.1875, 114.1875])  # frames 5 and 13, word 13


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(WORD_COUNTS), st.sampled_from(PACKINGS), st.integers(0, 95), st.integers(1, 20), st.data())
def test_any_frame_comes_back(words, packing, before_bits, parameters, data):
    """Parameters in random bits of random words, at random rates."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    free = rng.permutation(np.arange(2, words))
    by_name = {}
    for i, word in enumerate(free[:parameters]):
        bits = int(rng.integers(1, 13))
        rate = int(rng.choice([1, 2, 4]))
        low = int(rng.integers(0, 13 - bits))
        samples = tuple(Sample(float(s), (Piece(s * words + int(word), low, bits),)) for s in range(0, 4, 4 // rate))
        by_name[f"P{i}"] = Parameter(f"P{i}", Coding("binary", bits=bits), samples, rate / 4)
    layout = Map717(words, by_name, Counter(Piece(words + 1, 0, 12)))
    raw = random_raw(layout, rng, 5)
    before = before_bits // 8 * 8 if packing.aligned else before_bits
    series = read(pack(frames_717(layout, raw, first_count=4094), packing, before), layout)
    for name, values in raw.items():
        assert series[name].valid.all()
        np.testing.assert_array_equal(series[name].value, values.astype(float))


MEANT_767 = {
    "SPEED": float,
    "OUTLET_TEMP": lambda r: 0.025 * signed(r, 16),
    "ON": float,
    "PRESSURE": lambda r: struct.unpack("<f", struct.pack("<I", r))[0],
    "RATE": lambda r: 0.01 * signed(r, 13),
    "WIDE": lambda r: struct.unpack("<d", struct.pack("<Q", r))[0],
    "DIGIT": lambda r: 100.0 * (r >> 8) + 10.0 * (r >> 4 & 15) + (r & 15),
}


@pytest.mark.parametrize("seed", range(5))
def test_every_767_value_comes_back(seed):
    raw = raw_767(seed, 60)
    series = read(frames_767(DEMO_767, raw), DEMO_767)
    for name, mean in MEANT_767.items():
        assert series[name].valid.all(), name
        np.testing.assert_allclose(series[name].value, [mean(int(r)) for r in raw[name]], rtol=1e-12, err_msg=name)
    assert texts(series["LETTER"]) == [int(r).to_bytes(2, "big").decode() for r in raw["LETTER"]]
    np.testing.assert_allclose(np.diff(series["RATE"].t_s), 0.2)
    np.testing.assert_allclose(np.diff(series["DIGIT"].t_s), 4.0)


@pytest.mark.parametrize(
    ("name", "raw"),
    [("FREQUENCY", 0x00A0), ("UTC", 60), ("UTC", 60 << 6), ("UTC", 24 << 12), ("COMPUTED", 0x7FC00000)],
)
def test_bits_without_value_are_null(name, raw):
    """A digit of ten, second or minute 60, hour 24, not a number."""
    samples = random_raw(DEMO_717, np.random.default_rng(1), 32)
    samples[name][5] = raw
    series = read(pack(frames_717(DEMO_717, samples, first_count=0)))
    assert np.flatnonzero(~series[name].valid).tolist() == [5]


def written_717() -> np.ndarray:
    raw = random_raw(DEMO_717, np.random.default_rng(2), 32)
    for name in ("ALTITUDE", "PACK_TEMP"):
        raw[name] %= 400  # within their operational range
    return np.frombuffer(pack(frames_717(DEMO_717, raw)), np.uint8)


def uncounted(words: int, packing) -> np.ndarray:
    """Frames of random words, the counter too."""
    frames = frames_717(replace(DEMO_717, words=words, counter=None), {}, frames=32)
    return np.frombuffer(pack(frames, packing), np.uint8)


def written_767() -> np.ndarray:
    return np.frombuffer(frames_767(DEMO_767, raw_767(2)), np.uint8)


FRAMES = DEMO_767.frames
LONGER = replace(DEMO_767, frames=FRAMES | {3: replace(FRAMES[3], size=30)})
FASTER = replace(DEMO_767, frames=FRAMES | {4: replace(FRAMES[4], rate_hz=10.0)})
REVISED = replace(DEMO_767, revision="DEMO_MAP_8")


@pytest.mark.parametrize("words", WORD_COUNTS[1:])
@pytest.mark.parametrize("packing", [PACKINGS[0], PACKINGS[2]], ids=["aligned", "stream"])
def test_wrong_word_count_is_named(words, packing):
    data = uncounted(words, packing)
    with pytest.raises(MapError, match=f"the recording has {words:,} words a second, the map 64"):
        recognise(data, DEMO_717)


@pytest.mark.parametrize(
    ("written", "layout", "message"),
    [
        (lambda: uncounted(64, PACKINGS[0]), DEMO_717, r"counter \(subframe 1 word 2\) does not count: \d+% of frames"),
        (written_767, DEMO_717, r"the recording is ARINC 767 .* the map ARINC 717"),
        (written_717, DEMO_767, "it is ARINC 717 with 64 words a second"),
        (lambda: np.zeros(9000, np.uint8), DEMO_717, "no ARINC 717 frame in 9,000 bytes"),
        (lambda: np.zeros(9000, np.uint8), DEMO_767, "no ARINC 767 frame in 9,000 bytes"),
        (written_767, LONGER, "frame 3 has 21 bytes, by the map 30"),
        (written_767, FASTER, r"frame 4 comes every 0\.2 s, by the map every 0\.1 s"),
        (written_767, REVISED, "the recording says '647A-00 DEMO_MAP_7', the map is 'DEMO_MAP_8'"),
    ],
)
def test_unfitting_map_names_disagreement(written, layout, message):
    with pytest.raises(MapError, match=message):
        recognise(written(), layout)


def test_impossible_values_are_refused():
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


def test_misaligned_floats_are_refused():
    wide = DEMO_767.parameters["PRESSURE"]
    misaligned = {
        f"P{i}": replace(wide, name=f"P{i}", samples=(Sample(0.0, (Piece(0, 33 + i % 7, 32),)),)) for i in range(1, 17)
    }
    misaligned = {n: p for n, p in misaligned.items() if p.samples[0].pieces[0].low != 33}
    with pytest.raises(MapError, match="impossible values"):
        recognise(written_767(), replace(DEMO_767, parameters=misaligned))
