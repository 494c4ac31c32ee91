"""Silent, frozen and shifted sensors, and doors that jam or end too soon, at each edge of their rules."""

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, departure, grid, spans, work, work_before

from hdt_core.alerts import disturbances
from hdt_core.alerts.cases import Case, Grid, Limits
from hdt_core.alerts.disturbances import door_cases, outlet_doubtful, sensor_cases
from hdt_core.alerts.fault_isolation import CHANNELS, Indications
from hdt_core.health.detection import Shift, watch

FLIGHT = np.arange(FLIGHTS)
NOTHING = work(departure(0)).clear()
QUIET = np.zeros((1, FLIGHTS), dtype=bool)


def mach_cases(log: pl.DataFrame = NOTHING, empty_share: object = 0.0, still: object = False, **more: object):
    """Cases of the Mach number's sensor, which is empty in so many of its readings."""
    columns = {"running": True, "n_snapshots": 40, "mach_lost_share": empty_share, "mach_still": still} | more
    return sensor_cases(grid(**columns), log, Limits(), QUIET, QUIET)


def empty(share: float, first: int = 30) -> np.ndarray:
    return np.where(first <= FLIGHT, share, 0.0)


@pytest.mark.parametrize(
    ("empty_share", "more", "raised"),
    [
        (empty(0.201), {}, True), (empty(0.2), {}, False), (empty(0.21), {"running": False}, False),
        (empty(0.21), {"n_snapshots": 20}, True), (empty(0.21), {"n_snapshots": 19}, False),
        (empty(0.6, 3), {}, True), (empty(0.6, 2), {}, False), (empty(0.5, 2), {}, False), (empty(0.49, 2), {}, True),
    ],
)  # fmt: skip
def test_emptying_sensor_is_a_case(empty_share, more, raised):
    """A fifth of the readings and four of them; one that was half empty from the start was never there."""
    first = int(np.argmax(empty_share > 0.0))
    expected = [max(first + 1, 3 if empty_share[0] == 0.0 and first == 2 else 0)]
    assert [case.raised_flight for case in mach_cases(empty_share=empty_share, **more)] == (expected if raised else [])


@pytest.mark.parametrize(("flights", "expected"), [((30, 32), [("SENSOR_FAULT", 32, 40)]), ((30, 33), [])])
def test_dropout_needs_two_flights_of_three(flights, expected):
    assert spans(mach_cases(empty_share=np.where(np.isin(FLIGHT, flights), 0.3, 0.0))) == expected


@pytest.mark.parametrize(("after", "closed"), [(0.2 / 3.0, 48), (0.067, None)])
def test_dropout_persists_eight_flights(after, closed):
    """Above a third of its limit."""
    share = np.where(FLIGHT < 30, 0.0, np.where(FLIGHT <= 40, 0.3, after))
    assert [case.closed_flight for case in mach_cases(empty_share=share)] == [closed]


def test_sensor_work_closes_dropout():
    assert mach_cases(work_before(50, "SENSOR"), empty_share=empty(0.3))[0].closed_flight == 50


@pytest.mark.parametrize(("share", "kind"), [(0.951, "frozen"), (0.949, "dropout")])
def test_nearly_empty_sensor_is_frozen(share, kind):
    (case,) = mach_cases(empty_share=empty(share))
    facts = {"sensor": "mach", "kind": kind, "since": 30, "whose": "own"}
    assert case.facts == facts | {"share": pytest.approx(share)}


def test_still_sensor_is_frozen():
    (case,) = mach_cases(still=FLIGHT >= 30)
    assert (case.facts["kind"], case.raised_flight) == ("frozen", 31)


def checks(**columns: object) -> dict[str, object]:
    """A sound pack's cross checks, each with its scatter."""
    rng = np.random.default_rng(7)
    sds = {"inlet_minus_tat_k": 0.35, "tat_between_packs_k": 0.15, "hx_out_minus_target_k": 1.8}
    sds |= {"pack_over_compressor_flow_ln": 0.011, "cc_out_pressure_over_schedule_ln": 0.003}
    sound = {f"w_{name}": sd * rng.standard_normal(FLIGHTS) for name, sd in sds.items()}
    return sound | {name: sound.get(name, 0.0) + np.asarray(shift) for name, shift in columns.items()}


LATE = FLIGHT >= 50
SHIFTED = checks(w_inlet_minus_tat_k=2.0 * LATE)
"""Checks of a compressor inlet that reads 2 K high from flight 50 on."""


def test_shifted_sensor_is_described():
    (case,) = mach_cases(**SHIFTED)
    facts = {name: case.facts[name] for name in ("sensor", "whose", "channel")}
    assert facts == {"sensor": "cc_in_k", "whose": "own", "channel": "inlet_minus_tat_k"}
    assert (case.diagnosis, case.closed_flight) == ("SENSOR_FAULT", None)
    assert 50 <= case.facts["since"] <= case.raised_flight <= 58
    assert case.facts["p"] > 0.95
    assert case.facts["moved"] > 0.5


def test_repaired_sensor_starts_anew():
    assert mach_cases(work_before(50, "SENSOR"), **SHIFTED) == []


INLET = {"w_hx_in_over_discharge_k": -7.0 * LATE + 0.7 * np.random.default_rng(8).standard_normal(FLIGHTS)}
INLET["hx_fouling_flight"] = 0.08 * LATE + 0.016 * np.random.default_rng(9).standard_normal(FLIGHTS)
"""Checks of a hot inlet that reads 10 K low from flight 50 on."""


@pytest.mark.parametrize(("component", "closed"), [("HX", None), ("CC", None), ("SENSOR", 70)])
def test_work_on_parts_repairs_no_sensor(component, closed):
    (case,) = mach_cases(work_before(70, component), **INLET)
    assert (case.facts["sensor"], case.closed_flight) == ("hx_in_k", closed)


@pytest.mark.parametrize(("silent", "kinds"), [(range(55, 60), ["dropout"]), (range(20, 24), ["dropout", "shift"])])
def test_shift_echoing_silence_is_dropped(silent, kinds):
    cases = mach_cases(**SHIFTED, cc_in_k_lost_share=np.where(np.isin(FLIGHT, silent), 0.9, 0.0))
    assert [case.facts["kind"] for case in cases] == kinds


@pytest.mark.parametrize(("gap_k", "doubtful"), [(2.6, range(52, 62)), (2.4, [])])
def test_differing_outlets_are_doubtful(gap_k, doubtful):
    """Apart by more than 2.5 deviations on two flights of three."""
    # twenty flights of .8 K and forty-nine of none, about an offset of fifty flights
    sd = 0.8 * np.sqrt(20.0 / 69.0 * (1.0 + 1.0 / 50.0))
    gap = np.zeros(FLIGHTS)
    gap[[50, 52]] = gap_k * sd, 1.15 * gap_k * sd
    doubt = outlet_doubtful(grid(w_hx_out_between_packs_k=gap, running=True))[0]
    assert doubt.nonzero()[0].tolist() == list(doubtful)


def both(of_second: dict[str, object], **first: object) -> Grid:
    """Two packs on the same flights."""
    second = grid(**of_second).rows.with_columns(pl.lit(2, pl.Int32).alias("pack"))
    return Grid.from_frame(pl.concat([grid(**first).rows, second], how="diagonal"))


RUNNING = {"running": True, "n_snapshots": 40}
FLOW_SHIFTED = (
    checks(w_pack_over_compressor_flow_ln=0.08 * LATE, w_cc_out_pressure_over_schedule_ln=-0.02 * LATE) | RUNNING
)


def cases_of_both(of_second: dict[str, object], first: dict[str, object]) -> list[tuple[int, str, str]]:
    """Pack, sensor and whose it is, of each case."""
    none = np.zeros((2, FLIGHTS), dtype=bool)
    cases = sensor_cases(both(of_second, **first), NOTHING, Limits(), none, none)
    return sorted((c.unit, c.facts["sensor"], c.facts["whose"]) for c in cases)


def test_common_probe_is_case_of_both():
    shifted = checks(w_inlet_minus_tat_k=-2.0 * LATE) | RUNNING | {"w_hx_out_minus_target_k": -1.2 * LATE}
    assert cases_of_both(shifted, shifted) == [(0, "tat_k", "both"), (1, "tat_k", "both")]


def test_own_sensor_is_case_of_one():
    assert cases_of_both(checks() | RUNNING, FLOW_SHIFTED) == [(0, "pack_flow_kg_s", "own")]


@pytest.mark.parametrize(("of_second", "whose"), [(empty(0.9), "both"), (empty(0.9, 34), "own")])
def test_sensor_lost_by_both_is_one_cause(of_second, whose):
    """On the flight that raises it; a second sensor that fails days later is another."""
    lost = [RUNNING | {"hx_in_k_lost_share": share} for share in (of_second, empty(0.9))]
    assert (0, "hx_in_k", whose) in cases_of_both(*lost)


def test_common_flow_change_is_one_cause():
    expected = [(0, "pack_flow_kg_s", "both"), (1, "pack_flow_kg_s", "both")]
    assert cases_of_both(FLOW_SHIFTED, FLOW_SHIFTED) == expected


def case(raised: int, closed: int | None = None, unit: int = 0, sensor: str = "mach", p: float = 0.96) -> Case:
    facts = {"sensor": sensor, "p": p, "kind": "shift", "since": raised, "whose": "own"}
    return Case(unit, "SENSOR", "SENSOR_FAULT", raised, closed, facts)


@pytest.mark.parametrize(
    ("shift", "echo"),
    [
        (case(38), True), (case(37), False), (case(62), True), (case(63), False), (case(50, sensor="tat_k"), False),
        (case(50, unit=1), False),
    ],
)  # fmt: skip
def test_echo_is_within_twelve_flights(shift: Case, echo: bool):
    assert disturbances._repeats(shift, [case(50, 50)]) is echo


def test_open_silence_has_later_echoes():
    assert disturbances._repeats(case(90), [case(50)])


def merge(*cases: Case) -> list[tuple[int, str, int, int | None]]:
    grid = both({"running": True}, running=True)
    z = np.zeros((2, FLIGHTS, 15))
    evidence = Indications(grid, Shift(z > 0, z, z, z, z), np.zeros((2, FLIGHTS)), grid.partner())
    merged = disturbances._merge_cases(list(cases), evidence)
    return [(c.unit, c.facts["sensor"], c.raised_flight, c.closed_flight) for c in merged]


@pytest.mark.parametrize(
    ("cases", "merged"),
    [
        ((case(62, sensor="tat_k"), case(50)), [(0, "mach", 50, None)]),
        ((case(63, sensor="tat_k"), case(50)), [(0, "mach", 50, None), (0, "tat_k", 63, None)]),
        ((case(50, p=0.96), case(50, sensor="tat_k", p=0.97)), [(0, "tat_k", 50, None)]),
    ],
)
def test_surer_name_stands_within_twelve_flights(cases, merged):
    assert merge(*cases) == merged


@pytest.mark.parametrize(
    ("cases", "merged"),
    [
        ((case(50, 60), case(72, 80)), [(0, "mach", 50, 80)]),
        ((case(50, 60), case(72)), [(0, "mach", 50, None)]),
        ((case(50, 90), case(70, 80)), [(0, "mach", 50, 90)]),
        ((case(50, 60), case(73, 80)), [(0, "mach", 50, 60), (0, "mach", 73, 80)]),
    ],
)
def test_same_sensor_continues_its_case(cases, merged):
    assert merge(*cases) == merged


def inlet_case(raised: int, closed: int | None = None, unit: int = 0) -> Case:
    return case(raised, closed, unit, "cc_in_k")


@pytest.mark.parametrize(
    ("cases", "merged"),
    [
        ((inlet_case(50), inlet_case(60, unit=1)), [(0, "cc_in_k", 50, None)]),
        ((inlet_case(50), inlet_case(70, unit=1)), [(0, "cc_in_k", 50, 71), (1, "cc_in_k", 70, None)]),
        ((inlet_case(50, 60), inlet_case(70, unit=1)), [(0, "cc_in_k", 50, 60), (1, "cc_in_k", 70, None)]),
        # both packs may record one Mach number
        ((case(50), case(55, unit=1)), [(0, "mach", 50, None), (1, "mach", 55, None)]),
    ],
)
def test_packs_share_common_probe_only(cases, merged):
    assert merge(*cases) == merged


@pytest.fixture
def watch_calls(monkeypatch) -> list[tuple[np.ndarray, np.ndarray]]:
    """Values of the checks and restarts that the detector is given."""
    calls = []
    monkeypatch.setattr(
        disturbances, "watch", lambda values, sd, new: calls.append((values, new)) or watch(values, sd, new)
    )
    return calls


@pytest.mark.parametrize(
    ("component", "column", "restarts"),
    [
        ("HX", "hx_in_over_discharge_k", [50]), ("HX", "hx_in_over_pressure_k", [50]),
        ("HX", "conductance_off_cruise_ln", [50]), ("HX", "inlet_minus_tat_k", []),
        ("CC", "hx_in_over_pressure_k", [50]), ("CC", "hx_in_over_discharge_k", [50]),
        ("CC", "conductance_off_cruise_ln", []),
        ("RAM_DOOR", "hx_out_minus_target_k", [50]), ("RAM_DOOR", "inlet_minus_tat_k", []),
    ],
)  # fmt: skip
def test_work_restarts_checks_of_unit(watch_calls, component: str, column: str, restarts: list[int]):
    mach_cases(work_before(50, component), **checks())
    new = watch_calls[0][1][0, :, [c.name for c in CHANNELS].index(column)]
    assert new.nonzero()[0].tolist() == restarts


CALM = {f"w_{c.name}": 0.0 for c in CHANNELS} | RUNNING


def test_faulty_flights_are_no_evidence(watch_calls):
    """Doors at fault and silent sensors say nothing."""
    door = (FLIGHT >= 60)[None]
    jam = (FLIGHT >= 70)[None]
    sensor_cases(grid(**checks() | CALM | {"cc_in_k_lost_share": empty(0.9)}), NOTHING, Limits(), door, jam)
    of_door = dict.fromkeys(("hx_out_minus_target_k", "hx_out_between_packs_k"), 60)
    of_jam = dict.fromkeys(("hx_in_over_discharge_k", "hx_in_over_pressure_k", "conductance_off_cruise_ln"), 70)
    first = {c.name: 30 if "cc_in_k" in c.effects else (of_door | of_jam).get(c.name, FLIGHTS) for c in CHANNELS}
    silent = {c.name: np.isnan(watch_calls[0][0][0, :, k]).tolist() for k, c in enumerate(CHANNELS)}
    assert silent == {name: (flight <= FLIGHT).tolist() for name, flight in first.items()}


def test_other_packs_silence_hushes_comparison(watch_calls):
    """It hushes the check between the packs and no other."""
    columns = CALM | {"tat_k_lost_share": 0.0}
    none = np.zeros((2, FLIGHTS), dtype=bool)
    sensor_cases(both(columns | {"tat_k_lost_share": empty(0.9)}, **columns), NOTHING, Limits(), none, none)
    hushed = [c.name for k, c in enumerate(CHANNELS) if np.isnan(watch_calls[0][0][0, 40, k])]
    assert hushed == ["tat_between_packs_k"]


JAM = {
    "running": True, "door_max": 0.4, "door_span": np.where(FLIGHT < 5, 0.3, 0.02), "door_n": 8,
    "ram_door_open_still": False, "w_hx_out_minus_target_k": 0.0,
}  # fmt: skip
"""A door that stays at 40 % from the sixth flight on; its lower stop lies at 10 %."""
TWICE = (FLIGHT == 30) | (FLIGHT == 40)
PEG = {
    "running": True, "door_span": 0.3, "door_n": 30, "door_max": 0.4, "door_peg_n": 2, "door_off_peg_n": 3,
    "door_peg_excess_k": np.where(TWICE, 1.31, 0.0),
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
def test_jam_is_away_from_stops(changed, jammed):
    stop = {"door_span": np.where(FLIGHT < 5, changed["door_max"] - 0.1, 0.02)} if "door_max" in changed else {}
    assert door_spans(JAM | changed | stop) == ([(6, None)] if jammed else [])


STOP = JAM | {"door_max": 0.12, "door_span": 0.02}
"""A door that stays near its lower stop."""


@pytest.mark.parametrize(("above_k", "jams"), [(6.1, [(31, 53)]), (5.9, [])])
def test_warm_outlet_marks_jam_at_stop(above_k, jams):
    """Warmer than usual by six kelvin; with twenty of the last forty it is usual."""
    above = np.where(FLIGHT < 30, 1.0, 1.0 + above_k)
    assert door_spans(STOP | {"w_hx_out_minus_target_k": above})[:1] == jams


@pytest.mark.parametrize(("first", "jammed"), [(5, True), (4, False)])
def test_usual_outlet_needs_five_flights(first, jammed):
    above = np.where((first <= FLIGHT) & (first + 2 > FLIGHT), 7.0, 0.0)
    assert bool(door_spans(STOP | {"w_hx_out_minus_target_k": above})) is jammed


@pytest.mark.parametrize(("flights", "jams"), [((20, 22), [(22, 26)]), ((20, 23), [])])
def test_jam_needs_two_of_three_flights(flights, jams):
    """Four flights without end it."""
    assert door_spans(JAM | {"door_span": np.where(np.isin(FLIGHT, flights), 0.02, 0.3)}) == jams


@pytest.mark.parametrize(
    ("changed", "is_lost_travel"),
    [
        ({}, True), ({"running": False}, False), ({"door_peg_n": 1}, False), ({"door_off_peg_n": 2}, False),
        ({"door_peg_excess_k": np.where(TWICE, 1.29, 0.0)}, False),
        ({"door_max": 0.93}, False), ({"door_max": 0.929}, True),
        ({"door_max": 0.4, "door_span": 0.149}, False), ({"door_max": 0.4, "door_span": 0.151}, True),
    ],
)  # fmt: skip
def test_lost_travel_needs_warm_outlet_twice(changed, is_lost_travel):
    assert door_spans(PEG | changed) == ([(40, None)] if is_lost_travel else [])


@pytest.mark.parametrize(
    ("second", "apart", "is_lost_travel"), [(70, 0.0, True), (71, 0.0, False), (40, 0.029, True), (40, 0.031, False)]
)
def test_lost_travel_repeats_at_same_stop(second, apart, is_lost_travel):
    """Within forty flights and three hundredths of the door's travel."""
    hits = {"door_peg_excess_k": np.where((FLIGHT == 30) | (second == FLIGHT), 2.0, 0.0)}
    widest = np.where(FLIGHT < 35, 0.4, 0.4 + apart)
    assert [case[0] for case in door_spans(PEG | hits | {"door_max": widest})] == ([second] if is_lost_travel else [])


@pytest.mark.parametrize(("excess_k", "n", "first"), [(3.01, 3, 30), (2.99, 3, 40), (3.01, 2, 40)])
def test_large_excess_needs_one_flight(excess_k, n, first):
    hits = {"door_peg_excess_k": np.where(TWICE, excess_k, 0.0), "door_peg_n": n}
    assert [case[0] for case in door_spans(PEG | hits)] == [first]


@pytest.mark.parametrize(("wider", "end"), [(0.459, None), (0.461, 60)])
def test_wider_door_ends_lost_travel(wider, end):
    assert door_spans(PEG | {"door_max": np.where(FLIGHT < 60, 0.4, wider)}) == [(40, end)]


@pytest.mark.parametrize(
    ("flight", "action", "cases"),
    [(50, "ADJUSTED", [(40, 50)]), (35, "REPLACED", []), (50, "INSPECTED", [(40, None)])],
)
def test_door_work_ends_lost_travel(flight, action, cases):
    assert door_spans(PEG, work_before(flight, "RAM_DOOR", action)) == cases


def test_lost_travel_is_described():
    hits = {"door_peg_excess_k": np.where(FLIGHT == 30, 1.5, np.where(FLIGHT == 40, 2.5, 0.0))}
    (case,) = door_cases(grid(**PEG | hits), NOTHING, Limits())
    assert case.facts == pytest.approx({"kind": "lost travel", "since": 30, "stop": 0.4, "excess_k": 2.5})


def test_jam_is_described():
    (jam,) = door_cases(grid(**JAM), NOTHING, Limits())
    assert [jam.facts[name] for name in ("kind", "since", "stop", "excess_k")] == ["jam", 5, 0.4, 0.0]
