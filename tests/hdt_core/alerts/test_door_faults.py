"""A jammed door and one whose travel ends too soon, at each edge of their rules."""

import numpy as np
import pytest
from one_pack import FLIGHTS, departure, grid, spans, work, work_before

from hdt_core.alerts.cases import Limits
from hdt_core.alerts.door_faults import door_cases

FLIGHT = np.arange(FLIGHTS)
NOTHING = work(departure(0)).clear()
JAM = {
    "running": True, "door_max": 0.4, "door_span": np.where(FLIGHT < 5, 0.3, 0.02), "door_n": 8,
    "ram_door_open_still": False, "w_hx_out_minus_target_k": 0.0,
}  # fmt: skip
"""A door that stays at 40 % from the sixth flight on; its lower stop lies at 10 %."""
PEG = {
    "running": True, "door_span": 0.3, "door_n": 30, "door_max": 0.4, "door_peg_n": 2, "door_off_peg_n": 3,
    "door_peg_excess_k": np.where((FLIGHT == 30) | (FLIGHT == 40), 1.31, 0.0),
}  # fmt: skip
"""A door that goes no further than 40 % on two flights, its outlet warm there."""


def door_spans(columns: dict, log=NOTHING) -> list[tuple[str, int, int | None]]:
    return [span[1:] for span in spans(door_cases(grid(**columns), log, Limits()))]


@pytest.mark.parametrize(
    ("changed", "jammed"),
    [
        ({}, True), ({"running": False}, False), ({"ram_door_open_still": True}, False), ({"door_n": 7}, False),
        ({"door_span": np.where(FLIGHT < 5, 0.3, 0.0351)}, False),
        ({"door_span": np.where(FLIGHT < 5, 0.3, 0.0349)}, True), ({"door_max": 0.1599}, False),
        ({"door_max": 0.1601}, True), ({"door_max": 0.95}, False), ({"door_max": 0.949}, True),
    ],
)  # fmt: skip
def test_a_jam_stays_where_it_is_away_from_its_stops(changed, jammed):
    stop = {"door_span": np.where(FLIGHT < 5, changed["door_max"] - 0.1, 0.02)} if "door_max" in changed else {}
    assert door_spans(JAM | changed | stop) == ([(6, None)] if jammed else [])


@pytest.mark.parametrize(("above_k", "jammed"), [(6.1, True), (5.9, False)])
def test_near_its_stop_a_door_is_jammed_where_the_outlet_runs_warmer_than_usual(above_k, jammed):
    resting = {
        "door_max": 0.12,
        "door_span": 0.02,
        "w_hx_out_minus_target_k": np.where(FLIGHT < 30, 1.0, 1.0 + above_k),
    }
    cases = door_spans(JAM | resting)
    assert cases[:1] == ([(31, 53)] if jammed else [])  # with twenty of the last forty it is usual


def test_what_is_usual_wants_five_flights_before():
    resting = {"door_max": 0.12, "door_span": 0.02}
    for first, jammed in ((5, True), (4, False)):
        above = np.where(first > FLIGHT, 0.0, np.where(first + 2 > FLIGHT, 7.0, 0.0))
        assert bool(door_spans(JAM | resting | {"w_hx_out_minus_target_k": above})) is jammed


def test_two_flights_of_three_make_a_jam_and_four_without_end_it():
    span = np.full(FLIGHTS, 0.3)
    span[[20, 22]] = 0.02
    assert door_spans(JAM | {"door_span": span}) == [(22, 26)]
    span[[20, 22, 23]] = 0.3, 0.3, 0.02
    assert door_spans(JAM | {"door_span": span}) == []


@pytest.mark.parametrize(
    ("changed", "is_lost_travel"),
    [
        ({}, True), ({"running": False}, False), ({"door_peg_n": 1}, False), ({"door_off_peg_n": 2}, False),
        ({"door_peg_excess_k": np.where((FLIGHT == 30) | (FLIGHT == 40), 1.29, 0.0)}, False),
        ({"door_max": 0.93}, False), ({"door_max": 0.929}, True),
        ({"door_max": 0.4, "door_span": 0.149}, False), ({"door_max": 0.4, "door_span": 0.151}, True),
    ],
)  # fmt: skip
def test_lost_travel_is_a_warm_outlet_at_the_widest_opening_twice(changed, is_lost_travel):
    assert door_spans(PEG | changed) == ([(40, None)] if is_lost_travel else [])


@pytest.mark.parametrize(
    ("second", "apart", "is_lost_travel"), [(70, 0.0, True), (71, 0.0, False), (40, 0.029, True), (40, 0.031, False)]
)
def test_the_same_stop_within_40_flights_and_3_hundredths(second, apart, is_lost_travel):
    hits = {"door_peg_excess_k": np.where((FLIGHT == 30) | (second == FLIGHT), 2.0, 0.0)}
    widest = np.where(FLIGHT < 35, 0.4, 0.4 + apart)
    assert [case[0] for case in door_spans(PEG | hits | {"door_max": widest})] == ([second] if is_lost_travel else [])


@pytest.mark.parametrize(("excess_k", "n", "first"), [(3.01, 3, 30), (2.99, 3, 40), (3.01, 2, 40)])
def test_beyond_doubt_one_flight_is_enough(excess_k, n, first):
    hits = {"door_peg_excess_k": np.where((FLIGHT == 30) | (FLIGHT == 40), excess_k, 0.0), "door_peg_n": n}
    assert [case[0] for case in door_spans(PEG | hits)] == [first]


def test_a_door_that_goes_wider_or_is_repaired_has_no_stop():
    for wider, end in ((0.459, None), (0.461, 60)):
        assert door_spans(PEG | {"door_max": np.where(FLIGHT < 60, 0.4, wider)}) == [(40, end)]
    assert door_spans(PEG, work_before(50, "RAM_DOOR", "ADJUSTED")) == [(40, 50)]
    assert door_spans(PEG, work_before(35, "RAM_DOOR")) == []
    assert door_spans(PEG, work_before(50, "RAM_DOOR", "INSPECTED")) == [(40, None)]


def test_a_case_says_where_since_when_and_by_how_much():
    hits = {"door_peg_excess_k": np.where(FLIGHT == 30, 1.5, np.where(FLIGHT == 40, 2.5, 0.0))}
    (case,) = door_cases(grid(**PEG | hits), NOTHING, Limits())
    assert case.facts == pytest.approx({"kind": "lost travel", "since": 30, "stop": 0.4, "excess_k": 2.5})
    (jam,) = door_cases(grid(**JAM), NOTHING, Limits())
    assert (jam.facts["kind"], jam.facts["since"], jam.facts["stop"], jam.facts["excess_k"]) == ("jam", 5, 0.4, 0.0)
