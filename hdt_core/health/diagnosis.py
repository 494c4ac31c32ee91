"""Which sensor is off? A signature matrix of the cross checks, and Bayes' rule over it.

Each fault moves a set of cross checks in fixed proportions. The size of the fault is unknown, so it is integrated out
against a wide normal prior: the class whose direction explains the observed shifts best, and no more freely than it
must, wins (modified Bayes classification as in Ma, Lu and Liu 2015, with the amplitude marginalised).
"""

from dataclasses import dataclass

import numpy as np

from hdt_core.health.detection import Array


@dataclass(frozen=True, slots=True)
class Channel:
    """A cross check: name, flight-to-flight standard deviation of a sound unit, and what one unit of fault does to it.

    The scatter follows from the sensors' noise, quantisation and a flight's own trim; units of their own learn theirs.
    `between` marks a left-minus-right difference: the same fault of the other pack moves it the other way.
    """

    name: str
    sd: float
    moves: dict[str, float]
    between: bool = False


SCHEDULE_SLOPE = 0.6
"""Outlet target against total temperature in the warm part of a pack's schedule. [K/K]"""

DELIVERY_GAIN = 0.26
"""Relative change of delivery pressure with flow: pack and ducts lose about 12 of 93 kPa, as the square of it. [-]"""

CHANNELS = (
    Channel("inlet_minus_tat_k", 0.35, {"cc_in_k": 1.0, "tat_k": -1.0}),
    Channel("inlet_over_total_pressure_ln", 0.003, {"cc_in_pa": 1.0, "total_pressure_pa": -1.0}),
    Channel("total_over_pitot_pressure_ln", 0.0008, {"total_pressure_pa": 1.0, "mach": -1.5, "altitude_m": 1.0}),
    Channel("pack_over_compressor_flow_ln", 0.011, {"pack_flow_kg_s": 1.0, "cc_flow_kg_s": -1.0}),
    Channel("tat_between_packs_k", 0.15, {"tat_k": 1.0}, between=True),
    Channel("total_pressure_between_packs_ln", 0.0008, {"total_pressure_pa": 1.0}, between=True),
    Channel("pack_flow_between_packs_ln", 0.02, {"pack_flow_kg_s": 1.0}, between=True),
    Channel("compressor_flow_between_packs_ln", 0.022, {"cc_flow_kg_s": 1.0}, between=True),
    Channel("cc_out_pressure_between_packs_ln", 0.005, {"cc_out_pa": 1.0}, between=True),
    Channel("cc_out_pressure_over_schedule_ln", 0.003, {"cc_out_pa": 1.0, "pack_flow_kg_s": -DELIVERY_GAIN}),
    Channel("hx_out_minus_target_k", 1.8, {"hx_out_k": 1.0, "tat_k": -SCHEDULE_SLOPE}),
    Channel("hx_out_between_packs_k", 0.8, {"hx_out_k": 1.0}, between=True),
)
"""Cross checks that a wearing exchanger or compressor leaves alone: these raise the question."""

HX_STEP = Channel(
    "hx_fouling_step_3",
    0.02,
    {"hx_out_k": 0.028, "tat_k": -0.02, "pack_flow_kg_s": -1.55, "hx": 1.0},
)
"""Apparent loss, three flights against those before: it can't raise the question, but helps to answer it.
What a reading one unit too high adds to it is that of a cross-flow exchanger in cruise (NTU about 1.7)."""
HX_STEP_SD = 0.016 * (1.0 / 3.0 + 1.0 / 10.0) ** 0.5

SUSPECTS = (
    "tat_k",
    "cc_in_k",
    "total_pressure_pa",
    "cc_in_pa",
    "mach",
    "pack_flow_kg_s",
    "cc_flow_kg_s",
    "cc_out_pa",
    "hx_out_k",
    "hx",
)
SHARED = ("tat_k", "total_pressure_pa", "mach")
"""Sensors of which both packs may record one and the same."""
PRIOR_SHIFT_SD = 6.0
"""Prior standard deviation of a fault's size, in standard deviations of the mean it is seen with."""


def signatures() -> tuple[list[tuple[str, str]], Array]:
    """Hypotheses (sensor, whose: `own`, `other`, `both`) and their directions over own and other pack's channels.

    The suspect `hx` is the exchanger itself: a real step of its conductance.

    Returns
    -------
    list of tuple
        n hypotheses.
    array
        (n, 2 (C + 1)), unit length, in standard deviations; `CHANNELS` and `HX_STEP`, own pack then other.
        Left-minus-right checks count once, in the own half.
    """
    names, rows = [], []
    for sensor in SUSPECTS:
        own = np.array([c.moves.get(sensor, 0.0) / c.sd for c in (*CHANNELS, HX_STEP)])
        within = np.where([c.between for c in (*CHANNELS, HX_STEP)], 0.0, own)
        across = own - within
        for whose, mine, theirs in (("own", own, 0.0 * own), ("other", -across, within), ("both", within, within)):
            if whose != "both" or sensor in SHARED:
                names.append((sensor, whose))
                rows.append(np.concatenate([mine, theirs]))
    matrix = np.array(rows)
    return names, matrix / np.linalg.norm(matrix, axis=1, keepdims=True)


def classify(z: Array) -> list[tuple[str, str, float]]:
    """Posterior over the hypotheses for observed shifts.

    Parameters
    ----------
    z : array
        (2 (C + 1),) mean shift of each channel, own pack then other, in its standard deviations; NaN where unseen.

    Returns
    -------
    list of tuple
        (sensor, whose, probability), most probable first.

    Notes
    -----
    With direction :math:`a` over the channels seen and amplitude :math:`N(0, s^2)`, the log evidence is
    :math:`s^2 (a \\cdot z)^2 / (2 (1 + s^2 |a|^2)) - \\ln(1 + s^2 |a|^2) / 2`.
    """
    names, matrix = signatures()
    seen = np.isfinite(z)
    a = matrix[:, seen]
    gain = PRIOR_SHIFT_SD**2 * (a**2).sum(axis=1)
    evidence = PRIOR_SHIFT_SD**2 * (a @ z[seen]) ** 2 / (2.0 * (1.0 + gain)) - 0.5 * np.log1p(gain)
    p = np.exp(evidence - evidence.max())
    p /= p.sum()
    return sorted(((s, w, float(q)) for (s, w), q in zip(names, p, strict=True)), key=lambda t: -t[2])
