"""Which sensor it is: medians of late flights, doubts at a record's end, the signatures and where they can't know."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.alerts import fault_isolation
from hdt_core.alerts.cases import Grid
from hdt_core.alerts.fault_isolation import (
    CHANNELS,
    HX_STEP,
    MEDIAN_WORTH,
    NO_SENSOR,
    SIZES,
    CrossCheck,
    Indications,
    _median_z,
    classify,
    signatures,
)
from hdt_core.health.detection import Shift, watch


@pytest.mark.parametrize("flights", [0, 1, 2, 5, 12])
def test_median_z_matches_numpy(flights):
    rng = np.random.default_rng(flights)
    z = rng.standard_normal((flights, 40))
    z[rng.random(z.shape) < 0.4] = np.nan
    z[rng.random(z.shape) < 0.2] = 0.0  # a spike that was taken out
    middle, worth = _median_z(z)
    for k, column in enumerate(z.T):
        values = column[np.isfinite(column) & (column != 0.0)]
        assert worth[k] == (max(values.size, 1e-9) if values.size < 3 else MEDIAN_WORTH * values.size)
        assert np.isnan(middle[k]) if not values.size else middle[k] == np.median(values) * np.sqrt(worth[k])


def test_doubt_at_record_end_stays_open():
    """The last aircraft has the shorter record: what the grid holds beyond it is padding and no flight."""
    grid = grid_of(
        [(tail, f, p) for tail, flights in (("T-1", 60), ("T-2", 30)) for f in range(flights) for p in (1, 2)]
    )
    still = np.where(grid.is_flight[:, :, None], np.zeros(len(CHANNELS)), np.nan)
    shift = watch(still, np.array([c.sd for c in CHANNELS]), np.zeros(still.shape, dtype=bool))
    evidence = Indications(grid, shift, np.zeros(grid.shape), grid.partner())
    assert [evidence.isolate(0, (unit, 25, None)) for unit in range(4)] == [None] * 4
    assert evidence.isolate(0, (3, 25, 40)) is None


def grid_of(flown: list[tuple[str, int, int]]) -> Grid:
    """Legs by tail, flight and pack, six hours apart."""
    rows = pl.DataFrame(flown, schema=["tail", "flight", "pack"], orient="row").with_columns(
        pl.col("pack").cast(pl.Int32), operator=pl.lit("TST"),
        flight_id=pl.col("tail") + pl.col("flight").cast(pl.String),
        departed_at=datetime(2024, 1, 1, tzinfo=UTC) + pl.col("flight") * timedelta(hours=6),
    )  # fmt: skip
    return Grid.from_frame(rows)


def two_packs(flights: int) -> Grid:
    """Two packs of one aircraft, the second without the fourth flight of all."""
    return grid_of([("T", f, p) for f in range(flights) for p in (1, 2) if (f, p) != (3, 2)])


def shifts_by_hand(z: np.ndarray, loss: np.ndarray, k: int, first: int) -> tuple[list[float], list[float]]:
    """Medians of the last four to twelve flights, two thirds of a flight worth each; and the loss since it began
    against that of the twenty flights up to eight before it, which wear of .001 a flight may have moved meanwhile."""
    n = min(max(k - first + 4, 4), 12)
    late = np.arange(max(k - n + 1, 0), k + 1)
    middles = []
    worths = []
    for column in z[late].T:
        values = column[np.isfinite(column) & (column != 0.0)]
        worth = len(values) * (2.0 / np.pi if len(values) > 2 else 1.0)
        middles.append(np.median(values) * np.sqrt(worth))
        worths.append(worth)
    before = np.arange(max(first - 28, 0), max(first - 8, 0))
    now, then = (loss[flights][np.isfinite(loss[flights])] for flights in (late, before))
    between = late.mean() + 0.5 - (before[0] + before[-1] + 1) / 2.0
    sd = np.sqrt(0.016**2 * np.pi / 2.0 * (1.0 / len(now) + 1.0 / len(then)) + (1e-3 * between) ** 2)
    return [*middles, (np.median(now) - np.median(then)) / sd], [*worths, (0.016 / sd) ** 2]


def recorded_shifts() -> tuple[Grid, Shift, np.ndarray]:
    """Sixty flights of two packs: their shifts, and losses that are known on six flights of seven."""
    rng = np.random.default_rng(3)
    z = rng.normal(size=(2, 60, 15))
    loss = rng.normal(0.1, 0.02, (2, 60))
    loss[:, ::7] = np.nan
    return two_packs(60), Shift(np.zeros(z.shape, bool), z, z, np.zeros(z.shape), np.zeros(z.shape)), loss


LATE_FLIGHTS = pytest.mark.parametrize(("k", "first"), [(40, 40), (45, 40), (55, 40), (12, 12)])


@LATE_FLIGHTS
def test_shifts_are_medians_of_late_flights(k: int, first: int):
    grid, shift, loss = recorded_shifts()
    if k == 40:
        loss[:, 37:40] = np.nan  # one late flight is known
    (shifts,), (worth,) = Indications(grid, shift, loss, grid.partner()).shifts_at(0, np.array([k]), first)
    own = shifts_by_hand(shift.z[0], loss[0], k, first)
    other = shifts_by_hand(shift.z[1], loss[1], k - 1, first - 1)
    assert shifts.tolist() == pytest.approx(own[0] + other[0])
    assert worth.tolist() == pytest.approx(own[1] + other[1])


@LATE_FLIGHTS
def test_lone_pack_has_own_half_only(k: int, first: int):
    (shifts,), (worth,) = Indications(*recorded_shifts(), np.array([-1, -1])).shifts_at(0, np.array([k]), first)
    assert np.isnan(shifts[16:]).all()
    assert worth[16:].tolist() == [1.0] * 16


def test_same_time_counts_flown_flights():
    grid, shift, loss = recorded_shifts()
    indications = Indications(grid, shift, loss, grid.partner())
    assert indications.same_time(0, np.array([2, 3, 4]), 1).tolist() == [2, 2, 3]


def isolate_with(monkeypatch, classify: object, end: int | None = None) -> tuple[int | None, dict[str, object]]:
    """Flight and facts of a name where the classifier gives these probabilities from the twentieth flight on."""
    grid = two_packs(150)
    flight = iter(range(20, 150))
    z = np.ones((2, 150, 15))
    shift = Shift(z > 0, z, 2.0 * z, z, z)
    monkeypatch.setattr(fault_isolation, "classify", lambda z, flights: classify(next(flight)))
    return Indications(grid, shift, np.zeros((2, 150)), grid.partner()).isolate(4, (0, 20, end)) or (None, {})


def test_sensor_is_named_at_95_percent(monkeypatch):
    def classify(k: int) -> list[tuple[str, str, float]]:
        mine = 0.951 if k >= 30 else 0.949
        return [("mach", "own", mine - 0.1), ("tat_k", "both", 0.1), ("hx", "own", 0.03), ("nothing", "own", 0.01)]

    assert isolate_with(monkeypatch, classify) == (30, {
        "sensor": "mach", "whose": "own", "p": pytest.approx(0.951), "biased": True, "channel": "tat_between_packs_k",
        "moved": 2.0, "sigma": pytest.approx(np.sqrt(12 * 2.0 / np.pi)),
    })  # fmt: skip


@pytest.mark.parametrize(
    ("p", "from_flight", "flight"), [(0.991, 20, None), (0.989, 20, 40), (0.991, 26, None), (0.991, 24, 40)]
)
def test_other_packs_sensor_ends_search(monkeypatch, p, from_flight, flight):
    """From the sixth flight on, at a probability of 99 %."""

    def classify(k: int) -> list[tuple[str, str, float]]:
        theirs = p if (from_flight <= k < from_flight + 1 or from_flight == 20) and k < 40 else 0.0
        return [("mach", "other", theirs), ("hx", "other", 0.0), ("tat_k", "own", 0.96 if k >= 40 else 0.0)]

    assert isolate_with(monkeypatch, classify)[0] == flight


@pytest.mark.parametrize(
    ("sure_at", "end", "flight"), [(119, None, 119), (120, None, None), (59, 60, 59), (60, 60, None)]
)
def test_search_ends_after_hundred_flights(monkeypatch, sure_at, end, flight):
    assert isolate_with(monkeypatch, lambda k: [("mach", "own", 0.96 * (k >= sure_at))], end)[0] == flight


SIGNATURES = signatures()
SENSORS = [k for k, (name, _) in enumerate(SIGNATURES.names) if name not in NO_SENSOR]
FLIGHTS = 9.0
AT = {c.name: k for k, c in enumerate((*CHANNELS, HX_STEP))}


def expected_shifts(k: int, size: float, rng: np.random.Generator) -> np.ndarray:
    """Shifts of nine flights under hypothesis k; one inlet law at a time, as aircraft record it."""
    z = size * np.sqrt(FLIGHTS) * SIGNATURES.shift[k] + rng.standard_normal(SIGNATURES.shift.shape[1])
    z[[AT["hx_in_over_pressure_k"], AT["hx_in_over_pressure_k"] + len(AT)]] = np.nan
    return z


@pytest.mark.parametrize("k", SENSORS, ids=lambda k: "-".join(SIGNATURES.names[k]))
@pytest.mark.parametrize("size", [-1.0, 1.0])
def test_classifier_names_sensor_of_pack(k: int, size: float):
    rng = np.random.default_rng(k)
    hits = [classify(expected_shifts(k, size, rng), FLIGHTS)[0][:2] == SIGNATURES.names[k] for _ in range(20)]
    # what only the hot inlet's law sees may be its own sensor or the discharge's
    assert np.mean(hits) >= (0.8 if SIGNATURES.names[k][0] not in ("cc_out_k", "hx_in_k") else 0.3)


@pytest.mark.parametrize("sensor", ["hx_in_k", "ram_door_open"])
def test_inlet_or_door_is_not_wear(sensor: str):
    z = expected_shifts(SIGNATURES.names.index((sensor, "own")), 1.0, np.random.default_rng(1))
    blamed = sum(p for name, whose, p in classify(z, FLIGHTS) if name not in NO_SENSOR and whose != "other")
    assert blamed > 0.95


def test_ambiguous_outlet_is_not_named():
    """Left against right alone can't tell whose outlet it is."""
    z = np.full(SIGNATURES.shift.shape[1], np.nan)
    z[AT["hx_out_between_packs_k"]] = 12.0
    assert classify(z, FLIGHTS)[0][2] == pytest.approx(0.5, abs=0.02)


def test_probabilities_sum_to_one():
    z = 5.0 * SIGNATURES.shift[0]
    z[3:] = np.nan
    assert sum(p for _, _, p in classify(z, FLIGHTS)) == pytest.approx(1.0)


def test_chance_is_no_fault():
    rng = np.random.default_rng(3)
    quiet = [classify(rng.standard_normal(SIGNATURES.shift.shape[1]), FLIGHTS) for _ in range(50)]
    assert max(sum(p for name, _, p in one if name not in NO_SENSOR) for one in quiet) < 0.5


def posterior_by_hand(z: np.ndarray, flights: float) -> dict[tuple[str, str], float]:
    """Bayes' rule in plain loops: each sensor's own, other's and shared fault and nothing, over 24 sizes either way."""
    steps = [sign * 0.15 * (4.0 / 0.15) ** (i / 11) for i in range(12) for sign in (-1.0, 1.0)]
    checks = (*CHANNELS, HX_STEP)
    weight = {}
    for sensor, size in [*SIZES.items(), ("nothing", 0.0)]:
        for whose in ("own", "other") if sensor in ("hx", "cc") else ("own", "other", "both"):
            if sensor == "nothing" and whose != "own":
                continue
            total = 0.0
            for step in steps:
                log = -0.5 * step**2 + np.log(abs(step))
                for half, mine in ((0, whose != "other"), (1, whose != "own")):
                    for c, check in enumerate(checks):
                        shift = z[half * len(checks) + c]
                        if np.isnan(shift):
                            continue
                        sign = float(mine)
                        if check.between:  # left minus right counts in the own half
                            sign = 0.0 if half else {"own": 1.0, "other": -1.0, "both": 0.0}[whose]
                        per_sd = step * size * flights**0.5 / check.sd
                        a = sign * per_sd * check.effects.get(sensor, 0.0)
                        b = np.hypot(0.3 * a, sign * per_sd * check.effect_sds.get(sensor, 0.0))
                        var = 1.0 + check.wander**2 * flights + b**2
                        p = np.exp(-0.5 * (shift - a) ** 2 / var) / var**0.5
                        if half:
                            wide = var + 20.0**2
                            p += 1e-3 * np.exp(-0.5 * (shift - a) ** 2 / wide) / wide**0.5
                        log += np.log(p)
                total += np.exp(log)
            is_one_change = whose == "both" and sensor not in ("tat_k", "total_pressure_pa", "mach", "altitude_m")
            odds = 0.001 if is_one_change else 10.0 if sensor in ("hx", "cc", "nothing") else 1.0
            weight[sensor, whose] = total * odds
    return {name: w / sum(weight.values()) for name, w in weight.items()}


@pytest.mark.parametrize("seed", range(4))
def test_posterior_follows_bayes_rule(seed: int):
    rng = np.random.default_rng(seed)
    z = 2.0 * rng.standard_normal(SIGNATURES.shift.shape[1])
    z[rng.random(z.size) < 0.2] = np.nan
    posterior = {(sensor, whose): p for sensor, whose, p in classify(z, 5.0 + seed)}
    assert posterior == pytest.approx(posterior_by_hand(z, 5.0 + seed), abs=1e-9)


MOVES = """
inlet_minus_tat_k 0.35 0.3: cc_in_k 1, tat_k -1
inlet_over_total_pressure_ln 0.003 0.3: cc_in_pa 1, total_pressure_pa -1
total_over_pitot_pressure_ln 0.0008 0.3: total_pressure_pa 1, mach -1, altitude_m 1
pack_over_compressor_flow_ln 0.011 0.3: pack_flow_kg_s 1, cc_flow_kg_s -1
tat_between_packs_k 0.15 0.3: tat_k 1
total_pressure_between_packs_ln 0.0008 0.3: total_pressure_pa 1
pack_flow_between_packs_ln 0.02 0.3: pack_flow_kg_s 1
compressor_flow_between_packs_ln 0.022 0.3: cc_flow_kg_s 1
cc_out_pressure_between_packs_ln 0.005 0.3: cc_out_pa 1
cc_out_pressure_over_schedule_ln 0.003 0.3: cc_out_pa 1, pack_flow_kg_s -0.26
hx_out_minus_target_k 1.8 0.6: hx_out_k 1, tat_k -0.6
hx_out_between_packs_k 0.8 0.3: hx_out_k 1
hx_in_over_discharge_k 0.7 0.6: hx_in_k 0.7, hx_out_k 0.3, ram_door_open 65 25, pack_flow_kg_s -57, hx 3 8, cc_out_k -0.56, tat_k -0.57
hx_in_over_pressure_k 0.9 0.6: hx_in_k 0.7, hx_out_k 0.3, ram_door_open 65 25, pack_flow_kg_s -57, hx 3 8, cc_in_pa 75, cc_out_pa -75, tat_k -1.35, cc 56 15
conductance_off_cruise_ln 0.018 0.3: ram_door_open -1.8 0.8, hx_out_k -0.006, hx_in_k 0.002, tat_k 0.005, hx 0.1 0.15
hx_fouling_flight 0.016 0: hx_out_k 0.03, hx_in_k -0.008, tat_k -0.024, pack_flow_kg_s -1.6, ram_door_open 1.6 0.8, hx 1
"""  # noqa: E501
"""The matrix on paper: check, scatter, wander; what one unit of each fault does to it, and the spread of that."""


def read_check(line: str) -> CrossCheck:
    head, _, faults = line.partition(": ")
    name, sd, wander = head.split()
    own = [fault.split() for fault in faults.split(", ")]
    effects = {sensor: float(by) for sensor, by, *_ in own}
    effect_sds = {sensor: float(blur[0]) for sensor, _, *blur in own if blur}
    return CrossCheck(name, float(sd), effects, "between" in name, effect_sds, float(wander))


def test_signature_matrix_is_as_declared():
    declared = [read_check(line) for line in MOVES.strip().splitlines()]
    assert {c.name: c for c in (*CHANNELS, HX_STEP)} == {c.name: c for c in declared}


def test_fault_sizes_are_as_declared():
    assert SIZES == {
        "tat_k": 3.5, "cc_in_k": 3.5, "total_pressure_pa": 0.03, "cc_in_pa": 0.05, "mach": 0.01,
        "pack_flow_kg_s": 0.07, "cc_flow_kg_s": 0.07, "cc_out_pa": 0.05, "hx_in_k": 4.0, "hx_out_k": 4.0,
        "cc_out_k": 4.0, "ram_door_open": 0.08, "hx": 0.08, "cc": 0.05,
    }  # fmt: skip


@pytest.mark.parametrize("inlet", [-2.0, 0.0, 3.0])
def test_exchanger_step_is_no_sensor_fault(inlet: float):
    """A blockage takes ram flow, too, and the hot inlet feels it."""
    z = np.zeros(SIGNATURES.shift.shape[1])
    z[AT["hx_fouling_flight"]] = 12.0
    z[AT["hx_in_over_discharge_k"]] = inlet
    z[AT["hx_in_over_pressure_k"]] = np.nan
    assert classify(z, FLIGHTS)[0][:2] == ("hx", "own")
