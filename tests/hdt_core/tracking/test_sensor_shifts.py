"""A sensor that steps or drifts is taken out where a second one departs with the ratio; wear is left alone. By hand."""

import numpy as np
import polars as pl
import pytest

from hdt_core.tracking.sensor_shifts import Corrections, corrections

QUIET = [0.0] * 10
SLOPES = {
    "exit_apart_k": ("ratio_per_exit_k", -0.05), "flows_apart_ln": ("ratio_per_ln_flow", 0.8),
    "tat_apart_k": ("ratio_per_tat_k", 0.026), "inlet_apart_k": ("ratio_per_inlet_k", 0.014),
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


each_sensor = pytest.mark.parametrize(
    ("column", "least", "size"), [("exit_apart_k", 1.2, -0.05), ("flows_apart_ln", 0.03, 0.8)]
)


def test_inlet_shows_seven_tenths_of_its_error():
    """An inlet that reads 10 K too cold shows 7 K; the ratio falls by .14."""
    np.testing.assert_allclose(shift("inlet_apart_k", [-7.0] * 3, [-0.14] * 3), [0.0, -0.14, -0.14])


def test_blockage_is_not_taken_for_inlet():
    """It moves the inlet's law up, and the ratio down; an inlet that reads too warm would move the ratio up."""
    assert shift("inlet_apart_k", [4.0] * 3, [-0.3] * 3) == [0.0] * 3


def test_quiet_inlet_vouches_for_nothing():
    np.testing.assert_allclose(corrections(flights("inlet_apart_k", QUIET, QUIET)).unchecked, 1.0)


@each_sensor
def test_least_departure_counts_for_nothing(column, least, size):
    assert shift(column, [least] * 3, [size * least] * 3) == [0.0] * 3


@each_sensor
def test_departure_counts_from_second_flight(column, least, size):
    beyond = 1.001 * least
    np.testing.assert_allclose(shift(column, [beyond] * 3, [size * least] * 3), [0.0, *[beyond * size] * 2])
    np.testing.assert_allclose(shift(column, [-beyond] * 2, [-size * least] * 2), [0.0, -beyond * size])


def test_correction_has_sign_of_error():
    """An exit that reads 4 K too warm makes the ratio 0.2 too small: it is raised by that, a seventh of it as doubt."""
    result = corrections(flights("exit_apart_k", [*QUIET, 4.0, 4.0], [0.0] * 10 + [-0.2] * 2))
    np.testing.assert_allclose(result.shift[10:], [0.0, -0.2])
    np.testing.assert_allclose(result.variance[10:], [0.0, (0.15 * 0.2) ** 2])
    assert result.fault.tolist() == [False] * 11 + [True]


WITH_GAP = flights("exit_apart_k", [*QUIET, 0.0, float("nan"), 5.0, 0.0], [0.0] * 14)


def test_level_vouches_for_a_fifth():
    """One sensor of five, once five flights have shown its level, where it is measured and does not depart."""
    np.testing.assert_allclose(corrections(WITH_GAP).unchecked, [1.0] * 4 + [0.8] * 7 + [1.0, 1.0, 0.8])


def test_missing_witness_vouches_for_nothing():
    np.testing.assert_allclose(corrections(WITH_GAP.drop("exit_apart_k")).unchecked, 1.0)


GATE = 4.0 * (0.3 + 39 * 1.25 / np.sqrt(2.0)) / 40


@pytest.mark.parametrize(("beyond", "is_departure"), [(-0.01, False), (0.01, True)])
def test_scatter_is_no_departure(beyond, is_departure):
    """Steps of 1 K: a normal variable's mean step of 1 K is a deviation of 1.25 / sqrt 2 K, four of them 3.48 K."""
    shifts = shift("exit_apart_k", [GATE + beyond] * 2, [-0.05 * GATE] * 2, [0.5, -0.5] * 20)
    assert any(shifts) is is_departure


@pytest.mark.parametrize(("beyond", "expected"), [(1.19, 0.0), (1.21, -0.05 * 1.21)])
def test_level_follows_forty_flights(beyond, expected):
    usual = 1.0 - (39 / 40) ** 40
    shifts = shift("exit_apart_k", [usual + beyond] * 2, [-0.06] * 2, [0.0] * 40 + [1.0] * 40)
    np.testing.assert_allclose(shifts, [0.0, expected])


@pytest.mark.parametrize(
    ("apart_k", "ratio", "is_at_fault"),
    [
        *[(4.0, -0.2 * share, 0.4 < share < 2.0) for share in (0.39, 0.41, 1.99, 2.0, -1)],
        (5.0, -0.1, False),  # 0.4 of what 5 K do is not more than that
    ],
)
def test_ratio_must_move_too(apart_k, ratio, is_at_fault):
    assert any(shift("exit_apart_k", [apart_k] * 3, [ratio] * 3)) is is_at_fault


def test_level_averages_eight_departures():
    departures = [4.0, 5.0, 3.0, 4.4, 4.0, 3.6, 5.2, 4.0, 4.8, 3.2]
    levels = [np.mean(departures[: k + 1]) for k in range(8)]
    for departure in departures[8:]:
        levels.append(levels[-1] + (departure - levels[-1]) / 8)
    shifts = shift("exit_apart_k", departures, [-0.2] * 10)
    np.testing.assert_allclose(shifts, [0.0, *(-0.05 * np.array(levels[1:]))])


def test_changing_departure_is_no_shift():
    assert shift("exit_apart_k", [4.0, -4.0, 4.0], [-0.2, 0.2, -0.2]) == [0.0] * 3


@pytest.mark.parametrize(("n_quiet", "expected"), [(4, 0.0), (5, -0.2)])
def test_departure_needs_five_quiet_flights(n_quiet, expected):
    np.testing.assert_allclose(shift("exit_apart_k", [4.0] * 2, [-0.2] * 2, [0.0] * n_quiet), [0.0, expected])


each_fall = pytest.mark.parametrize(("fall", "is_at_fault"), [(0.0795, False), (0.0805, True)])


@each_fall
def test_ratio_before_is_remembered(fall, is_at_fault):
    """One flight at 0.06 raises what is held to 0.01: a fall of 0.08 from there, not less, is 0.4 of what 4 K do."""
    result = corrections(flights("exit_apart_k", [*QUIET, 0.0, 4.0, 4.0], [*QUIET, 0.06, *[0.01 - fall] * 2]))
    assert result.fault.any() == is_at_fault


def test_fault_ends_at_second_usual_flight():
    shifts = shift("exit_apart_k", [4.0, 4.0, 0.0, 5.0, 0.0, 0.0, 4.0], [-0.2, -0.2, 0.0, -0.2, 0.0, 0.0, -0.2])
    np.testing.assert_allclose(shifts, [0.0, -0.2, 0.0, -0.05 * 13.0 / 3.0, 0.0, 0.0, 0.0])


def test_next_departure_starts_from_corrected_ratio():
    """A pack that fouls while its sensor is off."""
    apart = [*QUIET, *[4.0] * 30, 0.0, 0.0, 4.0, 4.0]
    ratio = [0.0] * 10 + [-0.2] * 2 + [-0.5] * 28 + [-0.3] * 2 + [-0.5] * 2
    result = corrections(flights("exit_apart_k", apart, ratio))
    assert result.fault[-4:].tolist() == [False, False, False, True]


@each_fall
def test_first_usual_flight_keeps_level(fall, is_at_fault):
    """Its ratio of 0.06 would raise the level to 0.01; the second's does count."""
    shifts = shift("exit_apart_k", [4.0, 4.0, 0.0, 0.0, 4.0, 4.0], [-0.2, -0.2, 0.06, 0.0, -fall, -fall])
    assert (shifts[-1] != 0.0) == is_at_fault


def both_packs(own: float, other: float, n: int = 12) -> Corrections:
    """TAT probe off as both packs' compressors see it; the ratio says nothing."""
    packs = [
        flights("tat_apart_k", [*QUIET, *[apart] * n], [0.0] * (10 + n), pack)
        for pack, apart in ((1, own), (2, other))
    ]  # fmt: skip
    return corrections(pl.concat(packs))


@pytest.mark.parametrize(
    ("own", "other", "faults"),
    [
        *[(-3.0, other, faults) for other, faults in (
            (-1.17, [0, 0]), (-1.23, [1, 0]), (-1.6, [1, 1]), (-5.9, [1, 1]), (-6.1, [0, 1]), (3.0, [0, 0]))],
        (-5.0, -2.0, [0, 0]), (-5.0, -10.0, [0, 1]),  # 0.4 and 2 of 5 K
    ],
)  # fmt: skip
def test_tat_fault_needs_both_packs(own, other, faults):
    """The packs' compressors see it leave alike."""
    result = both_packs(own, other)
    assert [result.fault[:22].any(), result.fault[22:].any()] == faults
    if faults[0]:
        np.testing.assert_allclose(result.shift[11:22], 0.026 * own)


@pytest.mark.parametrize(("apart_k", "is_at_fault"), [(-0.8, False), (-0.81, True)])
def test_tat_fault_has_a_least_size(apart_k, is_at_fault):
    assert both_packs(apart_k, apart_k).fault.any() == is_at_fault


@pytest.mark.parametrize(
    ("other", "begins"), [([-0.2, -1.9, -1.9], 12), ([None, -3.0, -3.0], 12), ([-1.0, -1.6, -1.6], 11)]
)
def test_other_pack_confirms_by_mean(other, begins):
    """Its level is 0.3 K, on average of what it scatters; 0.4 of 3 K is 1.2 K below."""
    before = [0.0, 0.6] * 5
    theirs = [*before, *(v if v is None else v + 0.3 for v in other)]
    packs = [flights("tat_apart_k", v, [0.0] * 13, p) for v, p in (([*QUIET, *[-3.0] * 3], 1), (theirs, 2))]
    assert np.flatnonzero(corrections(pl.concat(packs)).fault[:13])[0] == begins


def is_confirmed(quiet: list[float | None], departs: list[float | None], own: list[float]) -> bool:
    """Whether the first pack's TAT is at fault by what the other pack says of it."""
    still = [0.0] * (10 + len(own))
    packs = [flights("tat_apart_k", v, still, p) for v, p in (([*QUIET, *own], 1), ([*quiet, *departs], 2))]
    return bool(corrections(pl.concat(packs)).fault[: 10 + len(own)].any())


@pytest.mark.parametrize(("level", "expected"), [([0.0], False), ([0.0, 0.0], True)])
def test_other_pack_needs_a_level(level, expected):
    """Of two flights."""
    quiet = [*level, *[None] * (10 - len(level))]
    assert is_confirmed(quiet, [-3.0] * 3, [-3.0] * 3) is expected


def test_each_departure_is_confirmed_anew():
    """What the other pack said of a flight long over has no part: half of 3 K is enough."""
    assert is_confirmed(QUIET, [0.0, 0.0, 0.0, -1.5, -1.5], [-3.0, 0.0, 0.0, -3.0, -3.0])


@pytest.mark.parametrize(("beyond", "is_at_fault"), [(0.79, False), (0.81, True)])
def test_vouched_level_lasts_200_flights(beyond, is_at_fault):
    """A drift of 1 K over 150 flights is seen: forty flights' memory would have followed it."""
    apart = [0.0] * 200 + [0.7] * 100
    apart += [0.7 * (1.0 - (199 / 200) ** 100) + beyond] * 3
    packs = pl.concat([flights("tat_apart_k", apart, [0.0] * len(apart), pack) for pack in (1, 2)])
    assert corrections(packs).fault.any() == is_at_fault


@pytest.mark.parametrize(
    ("departures", "expected"),
    [([0.1] * 12, [0.0] * 9 + [0.1] * 3), ([0.04] * 12, [0.0] * 12), ([-0.041] * 10, [0.0] * 9 + [-0.041])],
)
def test_door_vouches_for_itself(departures, expected):
    """Cruise moves by one, climb and descent by twice as much: their difference is the correction itself."""
    np.testing.assert_allclose(shift("door_apart_ln", departures, [0.0] * len(departures)), expected)


def test_sensors_are_corrected_in_turn():
    """The flow's witness judges what the exit's correction leaves."""
    rows = flights("exit_apart_k", [*QUIET, *[4.0] * 4], [0.0] * 10 + [-0.2, -0.2, -0.12, -0.12])
    flow = pl.Series([0.0] * 12 + [0.1] * 2)
    result = corrections(rows.with_columns(flows_apart_ln=flow, ratio_per_ln_flow=0.8))
    np.testing.assert_allclose(result.shift[10:], [0.0, -0.2, -0.2, -0.2 + 0.08])
    np.testing.assert_allclose(result.variance[-1], 0.15**2 * (0.2**2 + 0.08**2))


def test_wear_is_no_fault():
    assert not corrections(flights("exit_apart_k", [0.0] * 60, list(-0.01 * np.arange(60.0)))).fault.any()


DEPARTING = flights("exit_apart_k", [*QUIET, 4.0, 4.0], [0.0] * 10 + [-0.2] * 2)


@pytest.mark.parametrize(
    "change", [{"ratio_per_exit_k": None}, {"exit_apart_k": None}, {"ratio_per_exit_k": 0.0}], ids=str
)
def test_fault_needs_its_witness(change):
    assert not corrections(DEPARTING.with_columns(**change)).fault.any()


def test_no_flights_have_no_shift():
    assert corrections(DEPARTING.clear()).shift.shape == (0,)


def test_level_is_the_packs_own():
    """Five quiet flights of one pack are no level of the next one's."""
    packs = [flights("exit_apart_k", [0.0] * 12, [0.0] * 12, 1), flights("exit_apart_k", [4.0] * 12, [-0.2] * 12, 2)]
    assert not corrections(pl.concat(packs)).fault.any()


def test_departure_is_the_packs_own():
    last = flights("exit_apart_k", [*QUIET, 4.0], [0.0] * 10 + [-0.2], 1)
    first = flights("exit_apart_k", [4.0], [-0.2], 2)
    assert not corrections(pl.concat([last, first])).fault.any()
