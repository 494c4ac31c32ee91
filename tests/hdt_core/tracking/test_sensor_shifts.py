"""A sensor that steps or drifts is taken out where a second one departs with the ratio; wear is left alone. By hand."""

import numpy as np
import polars as pl
import pytest

from hdt_core.tracking.sensor_shifts import Corrections, corrections

QUIET = [0.0] * 10
SLOPES = {
    "exit_apart_k": ("ratio_per_exit_k", -0.05), "flows_apart_ln": ("ratio_per_ln_flow", 0.8),
    "tat_apart_k": ("ratio_per_tat_k", 0.026),
}  # fmt: skip


def flights(column: str, apart: list[float], ratio: list[float], pack: int = 1) -> pl.DataFrame:
    """One pack, a flight every six hours."""
    n = len(apart)
    slope, per = SLOPES.get(column, ("no_slope", 0.0))
    named = pl.DataFrame({"ln_ua_ratio": ratio, column: apart, slope: [per] * n}).cast(pl.Float64)
    return named.with_columns(
        operator=pl.lit("TST"), tail=pl.lit("T-01"), pack=pl.lit(pack, pl.Int32),
        flight_id=pl.format("T-01_{}", pl.int_range(n)),
    )  # fmt: skip


def shift(column: str, departures: list[float], ratios: list[float], before: list[float] = QUIET) -> list[float]:
    """What is taken out of the flights after the quiet ones, whose ratio stood at 0."""
    n = len(before)
    result = corrections(flights(column, [*before, *departures], [0.0] * n + ratios))
    assert not result.shift[:n].any()
    return result.shift[n:].tolist()


@pytest.mark.parametrize(("column", "least", "size"), [("exit_apart_k", 1.2, -0.05), ("flows_apart_ln", 0.03, 0.8)])
def test_departure_counts_from_second_flight(column, least, size):
    ours = [size * least] * 3
    assert shift(column, [least] * 3, ours) == [0.0] * 3
    np.testing.assert_allclose(shift(column, [1.001 * least] * 3, ours), [0.0, *[1.001 * least * size] * 2])
    np.testing.assert_allclose(shift(column, [-1.001 * least] * 2, [-size * least] * 2), [0.0, -1.001 * least * size])


def test_correction_has_sign_of_error():
    """An exit that reads 4 K too warm makes the ratio 0.2 too small: the ratio is raised by that again."""
    result = corrections(flights("exit_apart_k", [*QUIET, 4.0, 4.0], [0.0] * 10 + [-0.2] * 2))
    np.testing.assert_allclose(result.shift[10:], [0.0, -0.2])
    np.testing.assert_allclose(result.variance[10:], [0.0, (0.15 * 0.2) ** 2])
    assert result.fault.tolist() == [False] * 11 + [True]


def test_level_vouches_for_a_fifth():
    """Once five flights have shown its level, where it is measured and does not depart."""
    apart = [*QUIET, 0.0, float("nan"), 5.0, 0.0]
    result = corrections(flights("exit_apart_k", apart, [0.0] * 14))
    np.testing.assert_allclose(result.unchecked, [1.0] * 4 + [0.8] * 7 + [1.0, 1.0, 0.8])
    silent = flights("exit_apart_k", apart, [0.0] * 14).drop("exit_apart_k")
    np.testing.assert_allclose(corrections(silent).unchecked, 1.0)
    # Steps of 1 K: a normal variable's mean step of 1 K is a deviation of 1.25 / sqrt 2 K, four of them 3.48 K.
    before = [0.5, -0.5] * 20
    gate = 4.0 * (0.3 + 39 * 1.25 / np.sqrt(2.0)) / 40
    assert shift("exit_apart_k", [gate - 0.01] * 2, [-0.05 * gate] * 2, before) == [0.0] * 2
    assert any(shift("exit_apart_k", [gate + 0.01] * 2, [-0.05 * gate] * 2, before))
    before = [0.0] * 40 + [1.0] * 40
    usual = 1.0 - (39 / 40) ** 40
    assert shift("exit_apart_k", [usual + 1.19] * 2, [-0.06] * 2, before) == [0.0] * 2
    np.testing.assert_allclose(shift("exit_apart_k", [usual + 1.21] * 2, [-0.06] * 2, before), [0, -0.05 * 1.21])


@pytest.mark.parametrize(("share", "blamed"), [(0.39, False), (0.41, True), (1.99, True), (2.0, False), (-1, False)])
def test_ratio_must_move_too(share, blamed):
    assert any(shift("exit_apart_k", [4.0] * 3, [-0.2 * share] * 3)) == blamed
    assert not any(shift("exit_apart_k", [5.0] * 3, [-0.1] * 3))  # 0.4 of what 5 K do is not more than that


def test_level_averages_eight_departures():
    departures = [4.0, 5.0, 3.0, 4.4, 4.0, 3.6, 5.2, 4.0, 4.8, 3.2]
    levels = [np.mean(departures[: k + 1]) for k in range(8)]
    levels.append(levels[-1] + (departures[8] - levels[-1]) / 8)
    levels.append(levels[-1] + (departures[9] - levels[-1]) / 8)
    shifts = shift("exit_apart_k", departures, [-0.2] * 10)
    np.testing.assert_allclose(shifts, [0.0, *(-0.05 * np.array(levels[1:]))])
    assert shift("exit_apart_k", [4.0, -4.0, 4.0], [-0.2, 0.2, -0.2]) == [0.0] * 3
    assert shift("exit_apart_k", [4.0] * 2, [-0.2] * 2, [0.0] * 4) == [0.0] * 2
    np.testing.assert_allclose(shift("exit_apart_k", [4.0] * 2, [-0.2] * 2, [0.0] * 5), [0.0, -0.2])


def test_ratio_before_is_remembered():
    """One flight at 0.06 raises what is held to 0.01: a fall of 0.08 from there, not less, is 0.4 of what 4 K do."""
    for fall, blamed in ((0.0795, False), (0.0805, True)):
        result = corrections(flights("exit_apart_k", [*QUIET, 0.0, 4.0, 4.0], [*QUIET, 0.06, *[0.01 - fall] * 2]))
        assert result.fault.any() == blamed
    shifts = shift("exit_apart_k", [4.0, 4.0, 0.0, 5.0, 0.0, 0.0, 4.0], [-0.2, -0.2, 0.0, -0.2, 0.0, 0.0, -0.2])
    np.testing.assert_allclose(shifts, [0.0, -0.2, 0.0, -0.05 * 13.0 / 3.0, 0.0, 0.0, 0.0])
    # A pack that fouls while its sensor is off: the corrected ratio is what the next departure is measured from.
    apart = [*QUIET, *[4.0] * 30, 0.0, 0.0, 4.0, 4.0]
    fouled = -0.3
    ratio = [0.0] * 10 + [-0.2] * 2 + [fouled - 0.2] * 28 + [fouled] * 2 + [fouled - 0.2] * 2
    result = corrections(flights("exit_apart_k", apart, ratio))
    assert result.fault[[-4, -3, -2, -1]].tolist() == [False, False, False, True]


@pytest.mark.parametrize(("fall", "blamed"), [(0.0795, False), (0.0805, True)])
def test_first_usual_flight_keeps_level(fall, blamed):
    """Its ratio of 0.06 would raise the level to 0.01; the second's does count."""
    shifts = shift("exit_apart_k", [4.0, 4.0, 0.0, 0.0, 4.0, 4.0], [-0.2, -0.2, 0.06, 0.0, -fall, -fall])
    assert (shifts[-1] != 0.0) == blamed


def both_packs(own: float, other: float, n: int = 12) -> Corrections:
    """TAT probe off as both packs' compressors see it; the ratio says nothing."""
    packs = [
        flights("tat_apart_k", [*QUIET, *[apart] * n], [0.0] * (10 + n), pack)
        for pack, apart in ((1, own), (2, other))
    ]  # fmt: skip
    return corrections(pl.concat(packs))


@pytest.mark.parametrize(
    ("other", "blamed"),
    [(-1.17, [0, 0]), (-1.23, [1, 0]), (-1.6, [1, 1]), (-5.9, [1, 1]), (-6.1, [0, 1]), (3.0, [0, 0])],
)
def test_tat_fault_needs_both_packs(other, blamed):
    result = both_packs(-3.0, other)
    assert [result.fault[:22].any(), result.fault[22:].any()] == blamed
    if blamed[0]:
        np.testing.assert_allclose(result.shift[11:22], 0.026 * -3.0)
    for edge, own_blamed, other_blamed in ((-2.0, 0, 0), (-10.0, 0, 1)):  # 0.4 and 2 of 5 K
        at_edge = both_packs(-5.0, edge).fault
        assert [at_edge[:22].any(), at_edge[22:].any()] == [own_blamed, other_blamed]
    assert not both_packs(-0.8, -0.8).fault.any()
    assert both_packs(-0.81, -0.81).fault.any()


@pytest.mark.parametrize(
    ("other", "begins"), [([-0.2, -1.9, -1.9], 12), ([None, -3.0, -3.0], 12), ([-1.0, -1.6, -1.6], 11)]
)
def test_other_pack_confirms_by_mean(other, begins):
    """Its level is 0.3 K, on average of what it scatters; 0.4 of 3 K is 1.2 K below."""
    before = [0.0, 0.6] * 5
    theirs = [*before, *(v if v is None else v + 0.3 for v in other)]
    packs = [flights("tat_apart_k", v, [0.0] * 13, p) for v, p in (([*QUIET, *[-3.0] * 3], 1), (theirs, 2))]
    assert np.flatnonzero(corrections(pl.concat(packs)).fault[:13])[0] == begins


def other_says(quiet: list[float | None], departs: list[float | None], own: list[float]) -> bool:
    """Whether the first pack's TAT is at fault by what the other pack says of it."""
    still = [0.0] * (10 + len(own))
    packs = [flights("tat_apart_k", v, still, p) for v, p in (([*QUIET, *own], 1), ([*quiet, *departs], 2))]
    return bool(corrections(pl.concat(packs)).fault[: 10 + len(own)].any())


def test_other_pack_needs_a_level():
    assert not other_says([0.0, *[None] * 9], [-3.0] * 3, [-3.0] * 3)
    assert other_says([0.0, 0.0, *[None] * 8], [-3.0] * 3, [-3.0] * 3)
    # what it said of a flight long over has no part: half of 3 K is enough
    assert other_says(QUIET, [0.0, 0.0, 0.0, -1.5, -1.5], [-3.0, 0.0, 0.0, -3.0, -3.0])


@pytest.mark.parametrize(("beyond", "blamed"), [(0.79, False), (0.81, True)])
def test_vouched_level_lasts_200_flights(beyond, blamed):
    """A drift of 1 K over 150 flights is seen: forty flights' memory would have followed it."""
    apart = [0.0] * 200 + [0.7] * 100
    apart += [0.7 * (1.0 - (199 / 200) ** 100) + beyond] * 3
    packs = pl.concat([flights("tat_apart_k", apart, [0.0] * len(apart), pack) for pack in (1, 2)])
    assert corrections(packs).fault.any() == blamed


def test_door_vouches_for_itself():
    """Cruise moves by one, climb and descent by twice as much: their difference is the correction itself."""
    shifts = shift("door_apart_ln", [0.1] * 12, [0.0] * 12)
    np.testing.assert_allclose(shifts, [0.0] * 9 + [0.1] * 3)
    assert shift("door_apart_ln", [0.04] * 12, [0.0] * 12) == [0.0] * 12
    np.testing.assert_allclose(shift("door_apart_ln", [-0.041] * 10, [0.0] * 10), [0.0] * 9 + [-0.041])
    # The flow's witness judges what the exit's correction leaves.
    n = 4
    rows = flights("exit_apart_k", [*QUIET, *[4.0] * n], [0.0] * 10 + [-0.2, -0.2, -0.12, -0.12])
    flow = pl.Series([0.0] * 12 + [0.1] * 2)
    result = corrections(rows.with_columns(flows_apart_ln=flow, ratio_per_ln_flow=0.8))
    np.testing.assert_allclose(result.shift[10:], [0.0, -0.2, -0.2, -0.2 + 0.08])
    np.testing.assert_allclose(result.variance[-1], 0.15**2 * (0.2**2 + 0.08**2))
    assert not corrections(flights("exit_apart_k", [0.0] * 60, list(-0.01 * np.arange(60.0)))).fault.any()
    silent = flights("exit_apart_k", [*QUIET, 4.0, 4.0], [0.0] * 10 + [-0.2] * 2)
    assert not corrections(silent.with_columns(ratio_per_exit_k=None)).fault.any()
    assert not corrections(silent.with_columns(exit_apart_k=None)).fault.any()
    assert not corrections(silent.with_columns(ratio_per_exit_k=0.0)).fault.any()
    assert corrections(silent.clear()).shift.shape == (0,)
    # Five quiet flights of one pack are no level of the next one's.
    packs = [flights("exit_apart_k", [0.0] * 12, [0.0] * 12, 1), flights("exit_apart_k", [4.0] * 12, [-0.2] * 12, 2)]
    assert not corrections(pl.concat(packs)).fault.any()
    last = flights("exit_apart_k", [*QUIET, 4.0], [0.0] * 10 + [-0.2], 1)
    first = flights("exit_apart_k", [4.0], [-0.2], 2)
    assert not corrections(pl.concat([last, first])).fault.any()
