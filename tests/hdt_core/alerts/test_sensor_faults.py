"""Silent, frozen and shifted sensors, at each edge of their rules."""

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, departure, grid, spans, work, work_before

from hdt_core.alerts.cases import Limits
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.sensor_faults import outlet_doubtful, sensor_cases

FLIGHT = np.arange(FLIGHTS)
NOTHING = work(departure(0)).clear()
QUIET = np.zeros((1, FLIGHTS), dtype=bool)


def found(log: pl.DataFrame = NOTHING, lost: object = 0.0, still: object = False, **more: object):
    """Cases of the Mach number's sensor, which is empty in so many of its readings."""
    told = {"running": True, "n_snapshots": 40, "mach_lost_share": lost, "mach_still": still} | more
    return sensor_cases(grid(**told), log, Limits(), QUIET, QUIET)


def empty(share: float, first: int = 30) -> np.ndarray:
    return np.where(first <= FLIGHT, share, 0.0)


@pytest.mark.parametrize(
    ("lost", "more", "raised"),
    [
        (empty(0.201), {}, True), (empty(0.2), {}, False), (empty(0.21), {"running": False}, False),
        (empty(0.21), {"n_snapshots": 20}, True), (empty(0.21), {"n_snapshots": 19}, False),
        (empty(0.6, 3), {}, True), (empty(0.6, 2), {}, False), (empty(0.5, 2), {}, False), (empty(0.49, 2), {}, True),
    ],
)  # fmt: skip
def test_a_sensor_that_spoke_on_three_flights_is_empty_too_often(lost, more, raised):
    """A fifth of the readings and four of them; one that was half empty from the start was never there."""
    first = int(np.argmax(lost > 0.0))
    expected = [max(first + 1, 3 if lost[0] == 0.0 and first == 2 else 0)]
    assert [case.raised for case in found(lost=lost, **more)] == (expected if raised else [])


def test_two_flights_of_three_are_held_for_eight_above_a_third_of_the_limit():
    lost = np.where(np.isin(FLIGHT, (30, 32)), 0.3, 0.0)
    assert spans(found(lost=lost)) == [("SENSOR_FAULT", 32, 40)]
    assert found(lost=np.where(np.isin(FLIGHT, (30, 33)), 0.3, 0.0)) == []
    for after, closed in ((0.066, 48), (0.067, None)):
        held = np.where(FLIGHT < 30, 0.0, np.where(FLIGHT <= 40, 0.3, after))
        assert [case.closed for case in found(lost=held)] == [closed]
    assert found(work_before(50, "SENSOR"), lost=empty(0.3))[0].closed == 50


@pytest.mark.parametrize(("share", "kind"), [(0.951, "frozen"), (0.949, "dropout")])
def test_what_is_all_but_empty_or_stands_still_is_frozen(share, kind):
    (case,) = found(lost=empty(share))
    assert case.facts == {"sensor": "mach", "kind": kind, "since": 30, "share": pytest.approx(share)}
    (still,) = found(still=FLIGHT >= 30)
    assert (still.facts["kind"], still.raised) == ("frozen", 31)


def checks(**columns: object) -> dict[str, object]:
    """A sound pack's cross checks, each with its scatter."""
    rng = np.random.default_rng(7)
    sds = {"inlet_minus_tat_k": 0.35, "tat_between_packs_k": 0.15, "hx_out_minus_target_k": 1.8}
    sds |= {"pack_over_compressor_flow_ln": 0.011, "cc_out_pressure_over_schedule_ln": 0.003}
    sound = {f"w_{name}": sd * rng.standard_normal(FLIGHTS) for name, sd in sds.items()}
    return sound | {name: sound.get(name, 0.0) + np.asarray(shift) for name, shift in columns.items()}


LATE = FLIGHT >= 50


def test_a_shifted_sensor_is_named_with_what_moved_since_when():
    (case,) = found(**checks(w_inlet_minus_tat_k=2.0 * LATE))
    assert (case.diagnosis, case.facts["sensor"], case.facts["whose"]) == ("SENSOR_FAULT", "cc_in_k", "own")
    assert case.facts["channel"] == "inlet_minus_tat_k"
    assert 50 <= case.facts["since"] <= case.raised <= 58
    assert case.facts["p"] > 0.95
    assert case.facts["moved"] > 0.5
    assert case.closed is None


def test_a_shift_that_only_echoes_a_silence_is_no_news():
    silent = {"cc_in_k_lost_share": np.where((FLIGHT >= 55) & (FLIGHT < 60), 0.9, 0.0)}
    shifted = checks(w_inlet_minus_tat_k=2.0 * LATE)
    names = [case.facts["kind"] for case in found(**shifted, **silent)]
    assert names == ["dropout"]
    before = {"cc_in_k_lost_share": np.where((FLIGHT >= 20) & (FLIGHT < 24), 0.9, 0.0)}
    assert [case.facts["kind"] for case in found(**shifted, **before)] == ["dropout", "shift"]


def test_a_repaired_sensor_starts_anew():
    cases = found(work_before(50, "SENSOR"), **checks(w_inlet_minus_tat_k=2.0 * LATE))
    assert cases == []


@pytest.mark.parametrize(("gap_k", "doubtful"), [(2.6, True), (2.4, False)])
def test_outlets_that_differ_by_more_than_two_and_a_half_deviations_twice_of_three(gap_k, doubtful):
    # twenty flights of .8 K and forty-nine of none, about an offset of fifty flights
    sd = 0.8 * np.sqrt(20.0 / 69.0 * (1.0 + 1.0 / 50.0))
    gap = np.zeros(FLIGHTS)
    gap[[50, 52]] = gap_k * sd, 1.15 * gap_k * sd
    doubt = outlet_doubtful(grid(w_hx_out_between_packs_k=gap, running=True))[0]
    assert bool(doubt.any()) is doubtful
    if doubtful:
        assert doubt.nonzero()[0].tolist() == list(range(52, 62))


def both(of_second: dict[str, object], **first: object) -> Grid:
    """Two packs on the same flights."""
    one, two = grid(**first).rows, grid(**of_second).rows.with_columns(pl.lit(2, pl.Int32).alias("pack"))
    return Grid.cut(pl.concat([one, two], how="diagonal"))


def test_a_probe_that_both_packs_record_is_a_case_of_both_and_another_of_one():
    told = {"running": True, "n_snapshots": 40}
    shifted = checks(w_inlet_minus_tat_k=-2.0 * LATE) | told
    shifted |= {"w_hx_out_minus_target_k": -1.2 * LATE}
    none = np.zeros((2, FLIGHTS), dtype=bool)
    cases = sensor_cases(both(shifted, **shifted), NOTHING, Limits(), none, none)
    assert sorted((c.unit, c.facts["sensor"], c.facts["whose"]) for c in cases) == [
        (0, "tat_k", "both"), (1, "tat_k", "both")
    ]  # fmt: skip
    one = checks(w_pack_over_compressor_flow_ln=0.08 * LATE, w_cc_out_pressure_over_schedule_ln=-0.02 * LATE) | told
    (case,) = sensor_cases(both(checks() | told, **one), NOTHING, Limits(), none, none)
    assert (case.unit, case.facts["sensor"]) == (0, "pack_flow_kg_s")
