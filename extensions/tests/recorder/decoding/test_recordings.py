"""Recordings that we wrote ourselves come back: every kind of value, every packing, every rate."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import DATA, frames_717, frames_767, pack, random_raw

from hdt_recorder.decoding.coding import PACKINGS, Coding
from hdt_recorder.decoding.fit import decode, recognise
from hdt_recorder.decoding.frames_717 import WORD_COUNTS
from hdt_recorder.decoding.layout import Counter, Map717, Parameter, Piece, Sample
from hdt_recorder.decoding.plain_map import read_toml

DEMO_717 = read_toml((DATA / "demo_717.toml").read_text())
DEMO_767 = read_toml((DATA / "demo_767.toml").read_text())
ids = [f"{'aligned' if p.aligned else 'stream'} {p.order}" for p in PACKINGS]


def read(data: bytes, layout) -> dict:
    recording = recognise(np.frombuffer(data, np.uint8), layout)
    return {s.parameter.name: s for s in decode(recording, layout.parameters.values())}


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
def test_every_value_of_an_arinc_717_recording_comes_back(packing, before_bits):
    raw = random_raw(DEMO_717, np.random.default_rng(3), 48)
    series = read(pack(frames_717(DEMO_717, raw, first_count=0), packing, before_bits), DEMO_717)
    for name, mean in MEANT_717.items():
        assert series[name].valid.all(), name
        np.testing.assert_allclose(series[name].value, [mean(int(r)) for r in raw[name]], rtol=1e-12, err_msg=name)
    meanings = {0: "OFF", 1: "LOW", 2: "NORMAL", 5: "HIGH"}
    assert texts(series["MODE"]) == [meanings.get(int(r)) for r in raw["MODE"]]
    assert texts(series["CITY"]) == [int(r).to_bytes(4, "big").decode() for r in raw["CITY"]]
    assert texts(series["FREQUENCY"]) == [f"{100 + digits(int(r)) / 100:.2f}" for r in raw["FREQUENCY"]]
    assert texts(series["UTC"]) == [f"{r >> 12:02d}:{r >> 6 & 63:02d}:{r & 63:02d}" for r in map(int, raw["UTC"])]


def test_times_are_those_of_the_places_in_the_frame():
    raw = random_raw(DEMO_717, np.random.default_rng(0), 32)
    series = read(pack(frames_717(DEMO_717, raw, first_count=0), PACKINGS[0]), DEMO_717)
    np.testing.assert_allclose(series["PACK_TEMP"].t_s, np.arange(128) + 4 / 64)
    np.testing.assert_allclose(series["PITCH"].t_s, np.arange(512) / 4 + 5 / 64)
    np.testing.assert_allclose(series["WEIGHT"].t_s, [18.1875, 50.1875, 82.1875, 114.1875])  # frames 5 and 13, word 13


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(WORD_COUNTS), st.sampled_from(PACKINGS), st.integers(0, 95), st.integers(1, 20), st.data())
def test_any_bits_of_any_frame_come_back(words, packing, before_bits, parameters, data):
    """Parameters in random bits of random words, at random rates."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    free = rng.permutation(np.arange(2, words))
    by_name = {}
    for i, word in enumerate(free[:parameters]):
        bits, rate = int(rng.integers(1, 13)), int(rng.choice([1, 2, 4]))
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
def test_every_value_of_an_arinc_767_recording_comes_back(seed):
    raw = demo_767(seed, 60)
    series = read(frames_767(DEMO_767, raw), DEMO_767)
    for name, mean in MEANT_767.items():
        assert series[name].valid.all(), name
        np.testing.assert_allclose(series[name].value, [mean(int(r)) for r in raw[name]], rtol=1e-12, err_msg=name)
    assert texts(series["LETTER"]) == [int(r).to_bytes(2, "big").decode() for r in raw["LETTER"]]
    np.testing.assert_allclose(np.diff(series["RATE"].t_s), 0.2)
    np.testing.assert_allclose(np.diff(series["DIGIT"].t_s), 4.0)


def demo_767(seed: int, seconds: int) -> dict[str, np.ndarray]:
    raw = random_raw(DEMO_767, np.random.default_rng(seed), 5 * seconds)
    rates = {p.name: p.rate_hz for p in DEMO_767.parameters.values()}
    return {name: values[: int(seconds * rates[name])] for name, values in raw.items()}


@pytest.mark.parametrize(
    ("name", "raw"),
    [("FREQUENCY", 0x00A0), ("UTC", 60), ("UTC", 60 << 6), ("UTC", 24 << 12), ("COMPUTED", 0x7FC00000)],
)
def test_bits_that_are_no_value_are_null(name, raw):
    """A digit of ten, second or minute 60, hour 24, not a number."""
    samples = random_raw(DEMO_717, np.random.default_rng(1), 32)
    samples[name][5] = raw
    series = read(pack(frames_717(DEMO_717, samples, first_count=0), PACKINGS[0]), DEMO_717)
    assert np.flatnonzero(~series[name].valid).tolist() == [5]
