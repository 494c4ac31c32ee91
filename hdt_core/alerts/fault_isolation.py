"""Isolate the faulty sensor after a shift of a cross check, by Bayes' rule over the signatures of all checks.

Each fault moves a set of cross checks in known proportions. The size of the fault is unknown and integrated out against
a normal prior (modified Bayes classification as in Ma, Lu and Liu 2015, with the amplitude marginalised).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from hdt_core.alerts.cases import Grid
from hdt_core.flight.cross_checks import INLET_SHARE
from hdt_core.flight.quality import SHARED_SENSORS
from hdt_core.health.detection import Shift
from hdt_core.robust import Array


@dataclass(frozen=True, slots=True)
class CrossCheck:
    """A cross check: name, flight-to-flight standard deviation of a sound unit, and its shift by a unit of each fault.

    The scatter follows from the sensors' noise, quantisation and a flight's own trim; each unit's own is learned.
    `between` marks a left-minus-right difference: the same fault of the other pack shifts it the other way.
    `effect_sds` are standard deviations of effects that differ by case: film, blockage and a new unit. `wander` is the
    slow error of the check itself, season and ageing, in its flight-to-flight standard deviation.
    """

    name: str
    sd: float
    effects: dict[str, float]
    between: bool = False
    effect_sds: dict[str, float] = field(default_factory=dict)
    wander: float = 0.3


SCHEDULE_SLOPE = 0.6
"""Outlet target against total temperature in the warm part of a pack's schedule. [K/K]"""

DELIVERY_GAIN = 0.26
"""Relative change of delivery pressure with flow: pack and ducts lose about 12 of 93 kPa, as the square of it. [-]"""

INLET_MOVES = {"hx_in_k": INLET_SHARE, "hx_out_k": 0.3, "ram_door_open": 65.0, "pack_flow_kg_s": -57.0, "hx": 3.0}
INLET_BLURS = {"ram_door_open": 25.0, "hx": 8.0}
"""Effects on the law of the hot inlet in cruise, a mean of discharge and ram outlet temperature, and their standard
deviations. A film moves it by -5 K for the whole conductance, a blockage by 10. [K]"""

CHANNELS = (
    CrossCheck("inlet_minus_tat_k", 0.35, {"cc_in_k": 1.0, "tat_k": -1.0}),
    CrossCheck("inlet_over_total_pressure_ln", 0.003, {"cc_in_pa": 1.0, "total_pressure_pa": -1.0}),
    # a Mach number one unit too high: d ln pt / dM = 1.4 M / (1 + 0.2 M2), which is 0.97 at 0.78 and 1.03 at 0.84
    CrossCheck("total_over_pitot_pressure_ln", 0.0008, {"total_pressure_pa": 1.0, "mach": -1.0, "altitude_m": 1.0}),
    CrossCheck("pack_over_compressor_flow_ln", 0.011, {"pack_flow_kg_s": 1.0, "cc_flow_kg_s": -1.0}),
    CrossCheck("tat_between_packs_k", 0.15, {"tat_k": 1.0}, between=True),
    CrossCheck("total_pressure_between_packs_ln", 0.0008, {"total_pressure_pa": 1.0}, between=True),
    CrossCheck("pack_flow_between_packs_ln", 0.02, {"pack_flow_kg_s": 1.0}, between=True),
    CrossCheck("compressor_flow_between_packs_ln", 0.022, {"cc_flow_kg_s": 1.0}, between=True),
    CrossCheck("cc_out_pressure_between_packs_ln", 0.005, {"cc_out_pa": 1.0}, between=True),
    CrossCheck("cc_out_pressure_over_schedule_ln", 0.003, {"cc_out_pa": 1.0, "pack_flow_kg_s": -DELIVERY_GAIN}),
    CrossCheck("hx_out_minus_target_k", 1.8, {"hx_out_k": 1.0, "tat_k": -SCHEDULE_SLOPE}, wander=0.6),
    CrossCheck("hx_out_between_packs_k", 0.8, {"hx_out_k": 1.0}, between=True),
    CrossCheck(
        "hx_in_over_discharge_k", 0.7, INLET_MOVES | {"cc_out_k": -0.56, "tat_k": -0.57}, False, INLET_BLURS, 0.6
    ),
    # where the discharge temperature is not recorded it is that of a nominal machine at this pressure ratio
    CrossCheck(
        "hx_in_over_pressure_k",
        0.9,
        INLET_MOVES | {"cc_in_pa": 75.0, "cc_out_pa": -75.0, "tat_k": -1.35, "cc": 56.0},
        effect_sds=INLET_BLURS | {"cc": 15.0},
        wander=0.6,
    ),
    CrossCheck(
        "conductance_off_cruise_ln",
        0.018,
        {"ram_door_open": -1.8, "hx_out_k": -0.006, "hx_in_k": 0.002, "tat_k": 0.005, "hx": 0.1},
        effect_sds={"ram_door_open": 0.8, "hx": 0.15},
    ),
)
"""Cross checks that a film of dirt does not shift: a shift of these starts an isolation."""

HX_STEP = CrossCheck(
    "hx_fouling_flight",
    0.016,
    {"hx_out_k": 0.03, "hx_in_k": -0.008, "tat_k": -0.024, "pack_flow_kg_s": -1.6, "ram_door_open": 1.6, "hx": 1.0},
    effect_sds={"ram_door_open": 0.8},
    wander=0.0,
)
"""Apparent loss since the shift against that before it: it starts no isolation but weighs in it.
Effects of a reading one unit too high are those of a cross-flow exchanger in cruise (NTU about 1.7)."""

SIZES = {
    "tat_k": 3.5, "cc_in_k": 3.5, "total_pressure_pa": 0.03, "cc_in_pa": 0.05, "mach": 0.01, "pack_flow_kg_s": 0.07,
    "cc_flow_kg_s": 0.07, "cc_out_pa": 0.05, "hx_in_k": 4.0, "hx_out_k": 4.0, "cc_out_k": 4.0, "ram_door_open": 0.08,
    "hx": 0.08, "cc": 0.05,
}  # fmt: skip
"""Prior standard deviation of each fault's size, in its unit (pressures and flows by their logarithm): ten times the
sensor's noise, about what an operator would write up."""
NO_SENSOR = ("hx", "cc", "nothing")
"""Hypotheses without a faulty sensor: a real change of exchanger or compressor, or chance alone."""
PART_CHANGE_ODDS = 10.0
"""Odds of such a change, and of nothing but chance, against the fault of one sensor: parts wear on every flight, a
sensor fails once in some thousands."""
BOTH_PACKS_ODDS = 0.001
"""Odds that scale, map or software of a signal changed on both packs, against the fault of one sensor: a type's map is
revised once in some years, and seldom in one signal."""
EFFECT_ERROR = 0.3
"""Relative error of one entry of the matrix: types and flights differ."""
STRAY, STRAY_SD = 1e-3, 20.0
"""Chance that something else shifts a channel of the other pack meanwhile, as a new unit does, and the shift's size.
[standard deviations]"""
STEPS = np.concatenate([-np.geomspace(0.15, 4.0, 12)[::-1], np.geomspace(0.15, 4.0, 12)])
"""Sizes of a fault, in standard deviations of its prior, over which it is summed; smaller ones are no fault."""


class Signatures(NamedTuple):
    """Effects of n hypotheses (sensor; pack: `own`, `other`, `both`) on the channels of own and other pack.

    `shift` and its standard deviation `blur`, (n, 2 (C + 1)), for a fault of the size in `SIZES`, in standard
    deviations of one flight; `CHANNELS` and `HX_STEP`, own pack then other. Left-minus-right checks count once, in the
    own half. `nonzero` are the hypotheses and channels where either is not zero, few of all; `wander` is each
    channel's own.
    """

    names: tuple[tuple[str, str], ...]
    shift: Array
    blur: Array
    log_prior: Array
    nonzero: tuple[Array, Array]
    wander: Array


@cache
def signatures() -> Signatures:
    """Build all hypotheses and their signatures."""
    names = []
    shifts = []
    blurs = []
    checks = (*CHANNELS, HX_STEP)
    between = np.array([c.between for c in checks])
    for sensor, size in SIZES.items():
        own = np.array([size * c.effects.get(sensor, 0.0) / c.sd for c in checks])
        blur = np.hypot(EFFECT_ERROR * own, [size * c.effect_sds.get(sensor, 0.0) / c.sd for c in checks])
        for whose, mine, theirs in (("own", 1, 0), ("other", 0, 1), ("both", 1, 1)):
            if whose != "both" or sensor not in NO_SENSOR:
                names.append((sensor, whose))
                own_shift = np.where(between, mine - theirs, mine) * own
                shifts.append(np.concatenate([own_shift, theirs * ~between * own]))
                own_blur = np.where(between, abs(mine - theirs), mine) * blur
                blurs.append(np.concatenate([own_blur, theirs * ~between * blur]))
    names.append(("nothing", "own"))
    shifts.append(np.zeros_like(shifts[0]))
    blurs.append(np.zeros_like(shifts[0]))
    usual = np.log([_odds(sensor, whose) for sensor, whose in names])
    shift = np.array(shifts)
    blur = np.array(blurs)
    which, channel = np.nonzero((shift != 0.0) | (blur != 0.0))
    wander = np.tile([c.wander for c in checks], 2)
    return Signatures(tuple(names), shift, blur, usual, (which, channel), wander)


def _odds(sensor: str, whose: str) -> float:
    """Return the odds of a hypothesis against the fault of one sensor."""
    if sensor in NO_SENSOR:
        return PART_CHANGE_ODDS
    return BOTH_PACKS_ODDS if is_of_both_packs(sensor, whose) else 1.0


def is_of_both_packs(sensor: str, whose: str) -> bool:
    """Return whether a fault is one of two sensors at once: their scale, map or software changed."""
    return whose == "both" and sensor not in SHARED_SENSORS


def classify(z: Array, flights: Array | float) -> list[tuple[str, str, float]]:
    """Return the posterior over the hypotheses for observed shifts.

    Parameters
    ----------
    z : array
        (2 (C + 1),) mean shift of each channel, own pack then other, in its standard deviations; NaN: not observed.
    flights : array or float
        Flights that each mean is worth.

    Returns
    -------
    list of tuple
        (sensor, whose, probability), most probable first.

    Notes
    -----
    A fault of size s, standard normal in units of its prior, shifts channel c by :math:`s (a_c + b_c u_c)`, with
    :math:`u_c` the matrix's own error. For a given size the shifts are independent and normal, but for strays of the
    other pack; the sizes are summed.
    """
    matrix = signatures()
    is_observed = np.isfinite(z)
    worth = np.sqrt(np.broadcast_to(flights, z.shape))
    own = 1.0 + (matrix.wander * worth) ** 2
    theirs = np.arange(len(z)) >= len(z) // 2
    # of a channel that the fault does not shift, whatever its size
    baseline = _log_likelihood(np.where(is_observed, z, 0.0), own, theirs)
    which, channel = (k[is_observed[matrix.nonzero[1]]] for k in matrix.nonzero)
    a, b = (m[which, channel] * worth[channel] * STEPS[:, None] for m in (matrix.shift, matrix.blur))
    gain = _log_likelihood(z[channel] - a, own[channel] + b**2, theirs[channel]) - baseline[channel]
    log_likelihood = np.zeros((len(matrix.names), len(STEPS)))
    np.add.at(log_likelihood, which, gain.T)
    log_likelihood += baseline[is_observed].sum()
    # sizes are spaced evenly by logarithm: each weighs as its own width
    prior = np.log(np.abs(STEPS)) - 0.5 * STEPS**2
    evidence = np.logaddexp.reduce(prior + log_likelihood, axis=1) + matrix.log_prior
    p = np.exp(evidence - np.logaddexp.reduce(evidence))
    return sorted(((s, w, float(q)) for (s, w), q in zip(matrix.names, p, strict=True)), key=lambda t: -t[2])


def _log_likelihood(residual: Array, variance: Array, theirs: Array) -> Array:
    """Return the log likelihood of channels (last axis) up to a constant, with strays on the other pack's."""
    log_likelihood = -0.5 * (residual**2 / variance + np.log(variance))
    wide = variance[..., theirs] + STRAY_SD**2
    strays = np.log(STRAY) - 0.5 * (residual[..., theirs] ** 2 / wide + np.log(wide))
    log_likelihood[..., theirs] = np.logaddexp(log_likelihood[..., theirs], strays)
    return log_likelihood


OWN_PROBABILITY, OTHER_PROBABILITY = 0.95, 0.99
"""Probability at which a sensor of this pack is isolated, and at which the fault is left to the other pack. [-]"""
MAX_DELAY = 100
"""Flights within which a shift must be isolated: a slow drift is a small shift at first."""
LATE_MOST, LATE_LEAST, EARLIER_FLIGHTS, GAP_FLIGHTS = 12, 4, 20, 8
"""Flights that a shift is averaged over, at most and at least; earlier flights that the loss is compared with; and
flights between, in which the shift may have begun undetected."""
MEDIAN_WORTH = 2.0 / np.pi
"""Efficiency of the median of normal values against their mean. [-]"""
WEAR_SD = 1e-3
"""Loss that wear may add from one flight to the next. [-]"""
BLOCK_FLIGHTS = 16
"""Flights evaluated together: most shifts are isolated within them."""


@dataclass(frozen=True)
class Indications:
    """Input of the classifier: shifts of the checks, estimate of loss from each flight alone, row of the other pack."""

    grid: Grid
    shift: Shift
    loss: Array
    partner: Array

    @cached_property
    def departures(self) -> Array:
        """`Grid.departures`. (units, flights)"""
        return self.grid.departures()

    def isolate(self, channel: int, run: tuple[int, int, int | None]) -> tuple[int, dict[str, Any]] | None:
        """Return the first flight that isolates a sensor of this pack, and the facts; None where none does."""
        unit, first, end = run
        # a shift still there when the record ends is flagged beyond it too, where the grid is padding
        n_flights = self.grid.count(unit)
        last = min(end if end is not None else n_flights, n_flights, first + MAX_DELAY)
        for k, z, flights in self._flight_shifts(unit, first, last):
            posterior = classify(z, flights)
            other_probability = sum(p for s, w, p in posterior if w == "other" and s not in NO_SENSOR)
            mine = [(s, w, p) for s, w, p in posterior if w != "other" and s not in NO_SENSOR]
            own_probability = sum(p for *_, p in mine)
            if other_probability > OTHER_PROBABILITY and k - first >= 5:
                return None
            if own_probability > OWN_PROBABILITY:
                sensor, whose, _ = mine[0]
                shift = {"moved": float(self.shift.departure[unit, k, channel]), "sigma": float(z[channel])}
                facts = {"sensor": sensor, "whose": whose, "p": own_probability, "biased": True}
                return k, facts | {"channel": CHANNELS[channel].name, **shift}
        return None

    def same_time(self, unit: int, flights: Array, other: int) -> Array:
        """Return the other pack's last flight by this pack's departure on each flight; -1 before its first."""
        return np.asarray(np.searchsorted(self.departures[other], self.departures[unit, flights], side="right") - 1)

    def _flight_shifts(self, unit: int, first: int, last: int) -> Iterator[tuple[int, Array, Array]]:
        """Yield each flight with its row of `shifts_at`."""
        for start in range(first, last, BLOCK_FLIGHTS):
            flights = np.arange(start, min(start + BLOCK_FLIGHTS, last))
            yield from zip(flights.tolist(), *self.shifts_at(unit, flights, first), strict=True)

    def shifts_at(self, unit: int, flights: Array, first: int) -> tuple[Array, Array]:
        """Return the shifts up to each flight in standard deviations, and the flights they are worth: own channels and
        loss, then the other pack's. (flights, 2 (C + 1)) each"""
        mine = self._pack_shifts(unit, flights, first)
        other = int(self.partner[unit])
        if other < 0:
            theirs: tuple[Array, Array] = np.full_like(mine[0], np.nan), np.ones_like(mine[1])
        else:
            *other_flights, other_first = self.same_time(unit, np.append(flights, first), other)
            theirs = self._pack_shifts(other, np.array(other_flights), int(other_first))
        z, worth = (np.concatenate(both, axis=1) for both in zip(mine, theirs, strict=True))
        return z, worth

    def _pack_shifts(self, unit: int, flights: Array, first: int) -> tuple[Array, Array]:
        """Return the shifts of one pack's checks and loss, and the flights they are worth. (flights, C + 1) each"""
        n_late = np.clip(flights - first + LATE_LEAST, LATE_LEAST, LATE_MOST)
        late = flights[:, None] - np.arange(LATE_MOST)
        late = np.where((late >= 0) & (np.arange(LATE_MOST) < n_late[:, None]), late, -1)
        z = np.where((late >= 0)[:, :, None], self.shift.z[unit, late], np.nan)
        z, worth = _median_z(z)
        step, step_worth = self._loss_step(unit, late, first)
        return np.column_stack([z, step]), np.column_stack([worth, step_worth])

    def _loss_step(self, unit: int, late: Array, first: int) -> tuple[Array, Array]:
        """Return the step of loss across the shift in standard deviations, and the flights it is worth."""
        earlier = slice(max(first - GAP_FLIGHTS - EARLIER_FLIGHTS, 0), max(first - GAP_FLIGHTS, 0))
        now, n_now = _median(np.where(late >= 0, self.loss[unit, late], np.nan)[:, :, None])
        before_loss, n_before = _median(self.loss[None, unit, earlier, None])
        comparable = (n_now[:, 0] > 0) & (n_before[0, 0] > 0)
        earliest = np.where(late >= 0, late, late.max(axis=1, keepdims=True)).min(axis=1)
        distance = 0.5 * (earliest + late.max(axis=1) + 1 - earlier.start - earlier.stop)
        sampling = HX_STEP.sd**2 / MEDIAN_WORTH * (1.0 / np.maximum(n_now[:, 0], 1) + 1.0 / max(int(n_before[0, 0]), 1))
        sd = np.sqrt(sampling + (WEAR_SD * distance) ** 2)
        step = np.where(comparable, (now[:, 0] - before_loss[0, 0]) / sd, np.nan)
        return step, np.where(comparable, (HX_STEP.sd / sd) ** 2, 1.0)


def _median_z(z: Array) -> tuple[Array, Array]:
    """Return the median over flights (last axis but one) in its standard deviations, and the flights it is worth; NaN
    where never measured. (..., channels) each"""
    middle, n = _median(np.where(z != 0.0, z, np.nan))
    worth = np.maximum(np.where(n > 2, MEDIAN_WORTH * n, n), 1e-9)
    return middle * np.sqrt(worth), worth


def _median(values: Array) -> tuple[Array, Array]:
    """Return median and number of the finite values over the last axis but one; NaN where there are none."""
    # NaN sorts last, and a row of NaN covers the case of no flights
    none = np.full((*values.shape[:-2], 1, values.shape[-1]), np.nan)
    rising = np.sort(np.concatenate([np.where(np.isfinite(values), values, np.nan), none], axis=-2), axis=-2)
    n = np.isfinite(rising).sum(axis=-2)
    sides = (np.maximum(n - 1, 0) // 2, n // 2 * (n > 0))
    low, high = (np.take_along_axis(rising, k[..., None, :], axis=-2)[..., 0, :] for k in sides)
    return 0.5 * (low + high), n
