"""Cut, flipped and spliced recordings: no crash, and nothing is told that the recorder did not record at that time."""

import os

import numpy as np
import pytest
from recordings import DEMO_717, DEMO_767, frames_717, frames_767, pack, random_raw, raw_767

from hdt_recorder.decoding.coding import PACKINGS, Packing
from hdt_recorder.decoding.fit import decode
from hdt_recorder.decoding.frames_717 import find_packing
from hdt_recorder.decoding.frames_767 import arrange_767, find_frames
from hdt_recorder.decoding.timeline_717 import Recording717, arrange

FILES = int(os.environ.get("HDT_DAMAGED_FILES", "60"))
SYNCS = np.array([s * 64 for s in range(4)])
COUNTER = DEMO_717.counter.piece.word


def recording(seed: int, frames: int = 40) -> np.ndarray:
    raw = random_raw(DEMO_717, np.random.default_rng(seed), frames)
    return frames_717(DEMO_717, raw, first_count=100, filling=seed)


def arranged(data: bytes) -> Recording717:
    raw = np.frombuffer(data, np.uint8)
    return arrange(raw, find_packing(raw, 64) or PACKINGS[0], DEMO_717)


def series_of(words: np.ndarray) -> dict:
    """Series of every parameter by name."""
    return {s.parameter.name: s for s in decode(arranged(pack(words)), DEMO_717.parameters.values())}


def assert_true(arrangement: Recording717, words: np.ndarray) -> None:
    """Every whole subframe holds, word for word, what the frame with its count holds."""
    for i in np.flatnonzero(arrangement.whole.any(axis=0)):
        frame = int(arrangement.count[i]) % 4096 - 100
        assert 0 <= frame < len(words), frame
        for subframe in np.flatnonzero(arrangement.whole[:, i]):
            part = slice(64 * subframe, 64 * (subframe + 1))
            assert np.array_equal(arrangement.words[part, i], words[frame, part]), (frame, subframe)
    assert np.all(np.diff(arrangement.t_s) > 0)


def damage(words: np.ndarray, packing: Packing, rng: np.random.Generator) -> tuple[bytes, np.ndarray]:
    """Damaged bytes, and the words as they then stand: a flip within a subframe is a word like any other."""
    flipped = words.copy()
    for _ in range(rng.integers(0, 6)):
        frame = rng.integers(len(words))
        word = rng.choice([*SYNCS, COUNTER, *range(words.shape[1])])
        flipped[frame, word] ^= 1 << rng.integers(12)
    data = bytearray(pack(flipped, packing, int(rng.integers(0, 3)) * 8))
    for _ in range(rng.integers(0, 4)):
        at = int(rng.integers(len(data)))
        size = int(rng.integers(1, 900))
        kind = rng.integers(4)
        if kind == 0:  # lost
            del data[at : at + size]
        elif kind == 1:  # of another file
            data[at:at] = rng.bytes(size)
        elif kind == 2:  # overwritten, a sync word too: other words within a subframe are words like any other
            size = max(size, 200)
            data[at : at + size] = rng.bytes(len(data[at : at + size]))
        else:  # an earlier part again
            begin = int(rng.integers(len(data)))
            data[at:at] = data[begin : begin + size]
        if not data:
            break
    return bytes(data[: int(rng.integers(len(data) // 2, len(data) + 1))]), flipped


@pytest.mark.parametrize("packing", PACKINGS, ids=lambda p: f"{'aligned' if p.aligned else 'stream'} {p.order}")
def test_damaged_717_file_invents_nothing(packing):
    n_whole = 0
    for seed in range(FILES // len(PACKINGS)):
        rng = np.random.default_rng([seed, PACKINGS.index(packing)])
        words = recording(seed)
        data, flipped = damage(words, packing, rng)
        flipped[:, COUNTER] = words[:, COUNTER]  # a frame whose counter was flipped may not be told at all
        arrangement = arranged(data)
        assert_true(arrangement, flipped)
        for series in decode(arrangement, DEMO_717.parameters.values()):
            assert series.value is None or np.isfinite(series.value[series.valid]).all()
        n_whole += int(arrangement.whole.sum()) / (4 * 40)
    assert n_whole / (FILES // len(PACKINGS)) > 0.5  # most of most files comes through


def test_flipped_sync_word_costs_both_sides():
    words = recording(0)
    words[10, SYNCS[2]] ^= 4
    arrangement = arranged(pack(words))
    assert np.argwhere(~arrangement.whole).tolist() == [[1, 10], [2, 10]]
    assert arrangement.damage.damaged == 2
    (series,) = decode(arrangement, [DEMO_717.parameters["PACK_TEMP"]])
    assert np.flatnonzero(~series.valid).tolist() == [41, 42]


def test_lost_word_costs_its_subframe():
    data = pack(recording(2), PACKINGS[2])
    position = 64 * 12 // 8 * 30 + 21
    arrangement = arranged(data[:position] + data[position + 3 :])
    assert np.argwhere(~arrangement.whole).tolist() == [[2, 7]]


def test_standing_still_costs_no_row():
    words = recording(3)
    words[20:, COUNTER] += 1000
    arrangement = arranged(pack(words))
    assert len(arrangement.t_s) == 40
    assert arrangement.t_s[20] - arrangement.t_s[19] == 4004.0


def test_missing_frames_are_null():
    words = recording(1)
    arrangement = arranged(pack(np.delete(words, np.s_[12:17], axis=0)))
    assert arrangement.damage.missing == 20
    np.testing.assert_allclose(arrangement.t_s, 4.0 * np.arange(40))
    # the subframes between the two counters may be spliced
    assert np.flatnonzero(~arrangement.whole.any(axis=0)).tolist() == list(range(11, 17))
    (series,) = decode(arrangement, [DEMO_717.parameters["PACK_TEMP"]])
    invalid = np.flatnonzero(~series.valid)
    assert (invalid.min(), invalid.max()) == (44, 68)


def test_incomplete_superframe_has_no_value():
    words = recording(4, frames=64)
    begins = 12  # 100 + 12 is a multiple of 16
    assert series_of(words)["CITY"].valid.all()
    words[begins + 1, SYNCS[2]] ^= 1  # CITY has a letter in subframe 3 of each of its first four frames
    damaged = series_of(words)
    assert damaged["CITY"].valid.tolist() == [False, True, True, True]
    assert damaged["WEIGHT"].valid.tolist() == [True] * 6 + [False] * 2  # the last superframe was cut short


def test_damaged_767_file_invents_nothing():
    """Bytes within a frame's data can't be told from good ones: all else is damaged here."""
    whole_frames = 0.0
    for seed in range(FILES):
        rng = np.random.default_rng([seed, 767])
        data = bytearray(frames_767(DEMO_767, raw_767(seed)))
        truth = {n: dict(zip(f.t_s, map(bytes, f.data), strict=True)) for n, f in arranged_767(data).frames.items()}
        heads = np.concatenate([p + np.arange(10) for p in find_frames(np.frombuffer(data, np.uint8)).place])
        for at in rng.choice(heads, rng.integers(0, 6)):
            data[at] ^= 1 << rng.integers(8)
        for _ in range(rng.integers(0, 4)):
            at = int(rng.integers(len(data)))
            size = int(rng.integers(1, 300))
            data[at : at + size] = b"" if rng.integers(2) else rng.bytes(size) + data[at : at + size]
        arrangement = arranged_767(data[: int(rng.integers(len(data) // 2, len(data) + 1))])
        for number, frames in arrangement.frames.items():
            for t_s, body in zip(frames.t_s[frames.whole], frames.data[frames.whole], strict=True):
                assert truth[number][t_s] == bytes(body)
            whole_frames += frames.whole.sum() / sum(map(len, truth.values()))
        list(decode(arrangement, DEMO_767.parameters.values()))
    assert whole_frames / FILES > 0.5


def arranged_767(data: bytes):
    raw = np.frombuffer(bytes(data), np.uint8)
    return arrange_767(raw, find_frames(raw), DEMO_767.frames)


def test_lost_767_frame_is_null():
    data = frames_767(DEMO_767, raw_767(0))
    frames = find_frames(np.frombuffer(data, np.uint8))
    third = np.flatnonzero(frames.number == 3)[20]
    recorded = arranged_767(data[: frames.place[third]] + data[frames.place[third] + frames.size[third] :])
    assert recorded.damage.missing == 1
    (series,) = decode(recorded, [DEMO_767.parameters["SPEED"]])
    # the frame before it may be the beginning of the one and the end of the other
    assert np.flatnonzero(~series.valid).tolist() == [19, 20]
    np.testing.assert_allclose(np.diff(series.t_s), 1.0)


def test_jittering_times_lose_nothing():
    rng = np.random.default_rng(9)
    data = bytearray(frames_767(DEMO_767, raw_767(9)))
    frames = find_frames(np.frombuffer(data, np.uint8))
    for place, number, time_ms in zip(frames.place, frames.number, frames.time_ms, strict=True):
        if number == 4:
            data[place + 4 : place + 8] = int(time_ms + rng.integers(3)).to_bytes(4, "big")
    assert arranged_767(data).frames[4].whole.all()


@pytest.mark.parametrize("data", [b"", b"\x47", b"\xeb\x90", bytes(5000), b"\xeb\x90" * 3000], ids=range(5))
def test_other_bytes_have_no_frames(data):
    assert find_packing(np.frombuffer(data, np.uint8), 64) is None
    assert not arranged_767(data).frames[3].whole.any()
