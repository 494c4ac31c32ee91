"""Rules of wear at their edges: just enough raises a case, just too little does not; how long it is held."""

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, departure, grid, spans, work, work_before
from scipy.stats import norm

from hdt_core.alerts.cases import FAILS_AT, Case, Limits
from hdt_core.alerts.wear import cc_cases, hx_cases, loss_rise, low_margin_cases, odds_above
from hdt_core.health.detection import Cusum, watch

N = FLIGHTS
NOTHING = work(departure(0)).clear()
NEVER = np.zeros((1, N), bool)
FLIGHT = np.arange(N)


def fouling(loss: object, log: pl.DataFrame = NOTHING, sick: object = False, planned: object = False, **more: object):
    """Cases of an exchanger whose loss is known to a hundredth and comes without a step."""
    columns = {"hx_fouling": loss, "hx_fouling_sd": 0.01, "hx_fouling_step_3": 0.0, "hx_passage_300": 0.1} | more
    return hx_cases(grid(**columns), log, Limits(), sick | NEVER, planned | NEVER)


@pytest.mark.parametrize(
    ("value", "sd", "odds"),
    [
        (0.16, 0.01, norm.cdf(1.0)), (0.15, 0.02, 0.5), (np.nan, 0.01, 0.0), (0.16, np.nan, norm.cdf(0.01)),
        (0.1, 0.0, 0.0),
    ],
)  # fmt: skip
def test_odds_are_of_normal_estimate(value, sd, odds):
    """An unknown deviation counts as one."""
    assert odds_above(np.array([value]), np.array([sd]), 0.15).tolist() == pytest.approx([odds])


def limit_at(limit: float, odds: float) -> float:
    """Loss, known to .01, that is above a limit with these odds."""
    return limit + 0.01 * norm.ppf(odds)


@pytest.mark.parametrize(("loss", "raised"), [(limit_at(0.15, 0.701), True), (limit_at(0.15, 0.699), False)])
def test_fouling_needs_seventy_percent(loss, raised):
    assert spans(fouling(loss)) == ([("HX_FOULING", 2, None)] if raised else [])


@pytest.mark.parametrize(
    ("pattern", "first"),
    [("1110", 32), ("1011", 33), ("1101", 33), ("0111", 33), ("10101", None), ("11001", None), ("1100011", None)],
)
def test_fouling_needs_three_flights_of_four(pattern, first):
    loss = np.full(N, 0.05)
    loss[30 : 30 + len(pattern)] = [0.2 if c == "1" else 0.05 for c in pattern]
    assert [case.raised_flight for case in fouling(loss)] == ([first] if first else [])


@pytest.mark.parametrize(("after", "ends"), [(0.066, False), (0.75 * 0.09, False), (0.069, True)])
def test_fouling_ends_below_soon_limit(after, ends):
    """Fifteen flights below three quarters of the limit for a loss that grows fast."""
    assert spans(fouling(np.where(FLIGHT < 40, 0.2, after))) == [("HX_FOULING", 2, None if ends else 54)]


@pytest.mark.parametrize(
    ("work", "cases"),
    [
        (work_before(30), [("HX_FOULING", 2, 30), ("HX_FOULING", 38, None)]),
        (work_before(30, action="CLEANED"), [("HX_FOULING", 2, 30), ("HX_FOULING", 38, None)]),
        (work_before(30, "CC"), [("HX_FOULING", 2, None)]),
    ],
    ids=["replaced", "cleaned", "other component"],
)
def test_new_unit_waits_five_flights(work, cases):
    assert spans(fouling(0.2, work)) == cases


@pytest.mark.parametrize(
    ("loss", "first"), [(np.where(FLIGHT < 20, 0.05, np.where(FLIGHT < 40, 0.051, 0.2)), 20), (0.2, 0)]
)
def test_case_states_first_worn_flight(loss, first):
    assert [case.facts["since"] for case in fouling(loss)] == [first]


def test_gain_needs_single_flights():
    assert np.isnan(fouling(0.2)[0].facts_at(45)["gained"])


@pytest.mark.parametrize(("loss", "raised"), [(0.269, 43), (0.271, 22)])
def test_doubt_delays_wear(loss, raised):
    """By fifteen flights, unless the loss is twelve points past its limit."""
    sick = (FLIGHT >= 20) & (FLIGHT <= 25)
    assert [case.raised_flight for case in fouling(np.where(FLIGHT < 20, 0.0, loss), sick=sick)] == [raised]


@pytest.mark.parametrize(("step", "raised"), [(-0.099, [2]), (-0.101, [])])
def test_recovered_track_raises_nothing(step, raised):
    assert [case.raised_flight for case in fouling(0.2, hx_fouling_step_3=step)] == raised


@pytest.mark.parametrize(
    ("planned", "loss", "raised"), [(False, 0.18, 1), (True, 0.18, 0), (True, 0.206, 1), (True, 0.204, 0)]
)
def test_planned_unit_waits_five_points(planned, loss, raised):
    assert len(fouling(loss, planned=planned)) == raised


@pytest.mark.parametrize(("rise", "raised"), [(0.181, [57]), (0.179, [])])
def test_rise_over_best_flights_is_wear(rise, raised):
    """Medians of ten flights, each estimated alone."""
    alone = np.where(FLIGHT < 50, 0.05, 0.05 + rise)
    assert [case.raised_flight for case in fouling(0.0, hx_fouling_flight=alone)] == raised


def test_loss_rise_is_above_lowest_median():
    alone = np.random.default_rng(0).normal(0.1, 0.02, (1, 60))
    alone[0, 20:25] = np.nan
    rise = loss_rise(alone, FLIGHT[None, :60] == 40)[0]
    expected = []
    for k in range(60):
        own = alone[0, (40 if k >= 40 else 0) : k + 1]
        finite = own[np.isfinite(own)]
        tens = [np.median(finite[i : i + 10]) for i in range(len(finite) - 9)]
        expected.append(tens[-1] - min(tens) if tens else np.nan)
    assert rise.tolist() == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(("sick_until", "n_cases"), [(50, 1), (66, 0), (56, 1)])
def test_loss_rise_excludes_doubtful_flights(sick_until, n_cases):
    """Thirty-one flights alone at 0.25; a doubt lingers for fifteen."""
    alone = np.where((FLIGHT >= 50) & (FLIGHT < 81), 0.25, 0.05)
    assert len(fouling(0.0, hx_fouling_flight=alone, sick=(FLIGHT >= 50) & (sick_until > FLIGHT))) == n_cases


@pytest.mark.parametrize(("status", "n_cases"), [("ok", 1), ("sensor_corrected", 0)])
def test_loss_rise_excludes_corrected_flights(status, n_cases):
    """The flight's own loss has the sensor's error still."""
    alone = np.where(FLIGHT >= 50, 0.25, 0.05)
    assert len(fouling(0.0, hx_fouling_flight=alone, hx_fouling_status=status)) == n_cases


@pytest.mark.parametrize(
    ("loss", "flights", "passage", "raised"),
    [
        (limit_at(0.09, 0.81), 99.0, np.nan, 1), (limit_at(0.09, 0.79), 99.0, np.nan, 0),
        (limit_at(0.09, 0.81), 101.0, np.nan, 0), (limit_at(0.09, 0.81), 99.0, 0.1, 0),
    ],
)  # fmt: skip
def test_fast_growing_loss_counts_early(loss, flights, passage, raised):
    """It would fail within a hundred flights, and its margin is not known."""
    slope = (FAILS_AT - loss) / flights
    trends = {"hx_fouling_slope_30_per_flight": 1.5 * slope, "hx_fouling_slope_100_per_flight": 0.5 * slope}
    assert len(fouling(loss, hx_passage_300=passage, **trends)) == raised


STEP = np.where((FLIGHT >= 50) & (FLIGHT < 53), 0.101, 0.0)
JUMP = np.where(FLIGHT == 50, 0.2, 0.0)


@pytest.mark.parametrize(
    ("columns", "raised"),
    [
        ({}, True), ({"hx_fouling_step_3": 0.99 * STEP}, False), ({"loss": 0.0499}, False),
        ({"loss": 0.0501}, True), ({"ram_flow_loss_step_3": 0.039}, False),
        ({"ram_flow_loss_step_3": 0.04}, True),
        ({"hx_fouling_step_3": STEP - 0.0601 * (FLIGHT == 30)}, False),
        ({"hx_fouling_step_3": STEP - 0.0599 * (FLIGHT == 30)}, True),
    ],
)  # fmt: skip
def test_clog_needs_ram_flow_loss(columns, raised):
    """It comes at once, and after no recovery."""
    cases = fouling(**({"loss": 0.14, "hx_fouling_step_3": STEP} | columns))
    assert spans(cases) == [("HX_SUDDEN_CLOG", 50, None)] * raised
    assert [case.facts["jump"] for case in cases] == pytest.approx([0.101] * raised)


@pytest.mark.parametrize(
    ("fell", "log", "raised"), [(0, NOTHING, True), (1, NOTHING, False), (10, work_before(20), True)]
)
def test_return_after_recovery_is_no_clog(fell, log, raised):
    """Within ninety flights of it."""
    late = np.where(FLIGHT == 90, 0.101, np.where(fell == FLIGHT, -0.07, 0.0))
    assert bool(fouling(0.14, log, hx_fouling_step_3=late)) is raised


@pytest.mark.parametrize(
    ("component", "flight", "raised"), [("RAM_DOOR", 35, 0), ("SENSOR", 35, 0), ("RAM_DOOR", 34, 1)]
)
def test_repair_explains_step(component, flight, raised):
    """Of door or sensor, for fifteen flights."""
    assert len(fouling(0.14, work_before(flight, component), hx_fouling_step_3=JUMP)) == raised


def test_clog_states_its_first_flight():
    cases = fouling(np.where(FLIGHT < 50, 0.04, 0.14), hx_fouling_step_3=JUMP)
    assert [case.facts["since"] for case in cases] == [50]


@pytest.mark.parametrize(("rise", "names"), [(88, ["HX_SUDDEN_CLOG"]), (89, ["HX_SUDDEN_CLOG", "HX_FOULING"])])
def test_jump_joins_its_loss(rise, names):
    """Within forty flights they are one case."""
    cases = fouling(np.where(rise > FLIGHT, 0.14, 0.2), hx_fouling_step_3=JUMP)
    assert [case.diagnosis for case in cases] == names


@pytest.mark.parametrize(("after", "closed"), [(0.071, None), (0.069, 80)])
def test_clog_ends_at_half_loss(after, closed):
    cases = fouling(np.where(FLIGHT < 60, 0.14, after), hx_fouling_step_3=JUMP)
    assert spans(cases) == [("HX_SUDDEN_CLOG", 50, closed)]


@pytest.mark.parametrize(("last", "closed"), [(98, None), (85, 95)])
def test_low_margin_stays_while_loss_grows(last, closed):
    loss = np.where((FLIGHT >= 50) & (last >= FLIGHT), 0.1301, 0.1)
    assert spans(low(np.where(FLIGHT < 40, 0.95, 0.0), loss)) == [("HX_LOW_MARGIN", 3, closed)]


def compressor_cases(log: pl.DataFrame = NOTHING, doubtful: bool = False, **columns: object) -> list[Case]:
    return cc_cases(grid(**columns), log, Limits(), NEVER | doubtful)


def test_wavering_diameter_is_one_case():
    wavering = np.where(FLIGHT % 12 < 6, 0.965, 0.985)
    cases = compressor_cases(cc_effective_diameter_m=0.16 * np.where(FLIGHT < 40, 1.0, wavering), running=True)
    assert spans(cases) == [("CC_DEGRADED", 51, None)]


@pytest.mark.parametrize(
    ("loss", "sd", "raised"), [(0.0601, 0.001, [3]), (0.0599, 0.001, []), (0.0629, 0.01, [3]), (0.0627, 0.01, [])]
)
def test_compressor_limit_is_six_percent(loss, sd, raised):
    """And five per cent with a probability of 0.9."""
    cases = compressor_cases(cc_efficiency_loss=loss, cc_efficiency_loss_sd=sd)
    assert [case.raised_flight for case in cases] == raised


def efficiency_cases(loss: object, log: pl.DataFrame = NOTHING) -> list[tuple[str, int, int | None]]:
    return spans(compressor_cases(log, cc_efficiency_loss=loss, cc_efficiency_loss_sd=0.005))


@pytest.mark.parametrize(("after", "closed"), [(0.0349, 59), (0.7 * 0.05, 59), (0.0351, None)])
def test_compressor_case_persists_twenty_flights(after, closed):
    assert efficiency_cases(np.where(FLIGHT < 40, 0.08, after)) == [("CC_DEGRADED", 3, closed)]


def test_new_compressor_has_own_case():
    assert efficiency_cases(0.08, work_before(30, "CC")) == [("CC_DEGRADED", 3, 30), ("CC_DEGRADED", 39, None)]


@pytest.mark.parametrize(("every", "cases"), [(5, [("CC_DEGRADED", 4, None)]), (2, [])])
def test_compressor_case_needs_four_of_five(every, cases):
    assert efficiency_cases(np.where(FLIGHT % every == 0, 0.04, 0.08)) == cases


def diameter_cases(by: float, **more: object) -> list[Case]:
    diameter = 0.16 * np.where(FLIGHT < 40, 1.0, 1.0 - by)
    return compressor_cases(cc_effective_diameter_m=diameter, running=True, **more)


def test_smaller_diameter_is_a_case():
    """6 % are 5.5 of half the expected 2.2 %: 4.5 a flight at most, less .75, pass 8 with the third flight; the
    smoothed departure passes -2.5 % with the third, too."""
    (case,) = diameter_cases(0.06)
    assert case.raised_flight in (42, 43)
    assert case.facts_at(60)["shrunk"] == pytest.approx(np.log(0.94), abs=0.005)


@pytest.mark.parametrize(("by", "raised"), [(-0.06, False), (0.024, False), (0.027, True)])
def test_diameter_limit_is_a_fortieth(by, raised):
    assert bool(diameter_cases(by)) is raised


@pytest.mark.parametrize(
    "more",
    [{"doubtful": True}, {"cc_efficiency_loss": np.where(FLIGHT == 3, 0.0, np.nan)}],
    ids=["doubt", "efficiency"],
)
def test_smaller_diameter_yields_to_efficiency(more):
    """Nor does it count while the speed or a pressure is in doubt."""
    assert diameter_cases(0.06, **more) == []


def low(passage: object = 0.91, loss: object = 0.1, log: pl.DataFrame = NOTHING, sick: object = False) -> list[Case]:
    return low_margin_cases(grid(hx_passage_300=passage, hx_fouling=loss), log, Limits(), sick | NEVER)


@pytest.mark.parametrize(
    ("passage", "loss", "raised"), [(0.901, 0.1, 1), (0.9, 0.1, 0), (0.91, 0.15, 1), (0.91, 0.151, 0)]
)
def test_low_margin_needs_ninety_percent(passage, loss, raised):
    """A message within 300 flights with that probability, which wear does not explain."""
    assert spans(low(passage, loss)) == [("HX_LOW_MARGIN", 3, None)] * raised


@pytest.mark.parametrize(("every", "cases"), [(5, [("HX_LOW_MARGIN", 4, None)]), (2, [])])
def test_low_margin_needs_four_of_five(every, cases):
    assert spans(low(np.where(FLIGHT % every == 1, 0.8, 0.95))) == cases


@pytest.mark.parametrize(("after", "closed"), [(0.539, 59), (0.6 * 0.9, 59), (0.541, None)])
def test_low_margin_persists_twenty_flights(after, closed):
    assert spans(low(np.where(FLIGHT < 40, 0.95, after))) == [("HX_LOW_MARGIN", 3, closed)]


def test_new_unit_has_own_low_margin():
    assert spans(low(log=work_before(30))) == [("HX_LOW_MARGIN", 3, 30), ("HX_LOW_MARGIN", 35, None)]


def test_doubt_delays_low_margin():
    assert spans(low(sick=FLIGHT < 20)) == [("HX_LOW_MARGIN", 23, None)]


@pytest.mark.parametrize(("passage", "first"), [(np.where(FLIGHT < 20, 0.9, 0.95), 20), (0.91, 0)])
def test_low_margin_states_first_flight(passage, first):
    assert [case.facts["since"] for case in low(passage)] == [first]


def test_old_units_jump_is_own_case():
    cases = fouling(np.where(FLIGHT < 61, 0.14, 0.2), work_before(60), hx_fouling_step_3=JUMP)
    assert spans(cases) == [("HX_SUDDEN_CLOG", 50, 60), ("HX_FOULING", 68, None)]


def test_jump_after_loss_is_own_case():
    cases = fouling(0.2, hx_fouling_step_3=JUMP)
    assert [(c.diagnosis, c.raised_flight) for c in cases] == [("HX_SUDDEN_CLOG", 50), ("HX_FOULING", 2)]


@pytest.mark.parametrize(("lost_until", "closed"), [(60, 80), (85, 99)])
def test_joint_case_ends_with_later(lost_until, closed):
    """Thirty flights after a jump, or fifteen after the loss."""
    loss = np.where((FLIGHT >= 52) & (lost_until > FLIGHT), 0.2, np.where(FLIGHT < 52, 0.14, 0.05))
    assert spans(fouling(loss, hx_fouling_step_3=JUMP)) == [("HX_SUDDEN_CLOG", 50, closed)]


@pytest.mark.parametrize(("shrinks", "grows"), [(25, 60), (21, 60), (15, 99)])
def test_diameter_watch_starts_after_twenty_flights(shrinks, grows):
    """Three quarters of a deviation of 2.2 % are no news; a sum of 8 calls, of 1 ends; the level is never forgotten."""
    diameter = 0.16 * np.where((shrinks <= FLIGHT) & (grows > FLIGHT), 0.93, 1.0)
    settings = Cusum(slack=0.75, decide=8.0, clear=1.0, ceiling=14.0, clip=4.5, learn_flights=20, memory_flights=10**6)
    state = watch(np.log(diameter)[None, :, None], np.array([0.022]), NEVER[:, :, None], settings)
    departure = state.departure[0, :, 0]
    called = (state.alarm & (state.sum_low > state.sum_high))[0, :, 0] & (departure < -0.025)
    ends = int(np.flatnonzero(called | (departure < -0.0175))[-1]) + 20
    expected = [("CC_DEGRADED", int(np.argmax(called)), ends if ends < N else None)] if called.any() else []
    assert spans(compressor_cases(cc_effective_diameter_m=diameter, running=True)) == expected


@pytest.mark.parametrize(("shrinks", "grows"), [(25, 60), (21, 60), (15, 99)])
def test_diameter_at_rest_raises_nothing(shrinks, grows):
    diameter = 0.16 * np.where((shrinks <= FLIGHT) & (grows > FLIGHT), 0.93, 1.0)
    assert compressor_cases(cc_effective_diameter_m=diameter, running=shrinks > FLIGHT) == []


def test_limits_are_as_declared():
    assert Limits() == Limits(
        fouling=0.15, fouling_odds=0.7, fouling_soon=0.09, soon_odds=0.8, soon_flights=100.0, clog=0.1, ram_flow=0.04,
        passage=0.9, compressor=0.05, lost_share=0.2, still_span=0.035, peg_k=1.3, fouling_keep=0.75, passage_keep=0.6,
        compressor_excess=1.2, compressor_keep=0.7, wear_persistence=(3, 4, 15), clog_persistence=(1, 1, 30),
        margin_persistence=(4, 5, 20), compressor_persistence=(4, 5, 20), jam_persistence=(2, 3, 4),
        dropout_persistence=(2, 3, 8),
    )  # fmt: skip
