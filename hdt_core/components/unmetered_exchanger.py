"""The pack's heat exchanger where neither pack flow nor ram door is recorded: its temperatures alone."""

from math import pi

import numpy as np
import polars as pl

from hdt_core.components.declaration import CLEANED, REPLACED, Channel, Component, Limit, Reading, Record
from hdt_core.physics.air import (
    GAMMA,
    R_J_KG_K,
    density_kg_m3,
    standard_pressure_pa,
    total_to_static_pressure,
    total_to_static_temperature,
)
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal
from hdt_core.physics.terms import TERMS
from hdt_core.records.units import FOOT_M, ZERO_CELSIUS_K

REFERENCE_FLUX_KG_S_M2 = 100.0
"""About that of 150 kt at 3,000 ft. [kg/s/m2]"""
SPEED_OF_SOUND_M_S_K = float(np.sqrt(GAMMA * R_J_KG_K))
SPRAY = Param("hxt_water_spray", "-", 0.3, (-0.2, 1.0), "design", sd=0.2)
NTU = Param("hxt_ntu", "-", 1.6, (0.3, 8.0), "design", sd=0.4)
EXPONENT = Param("hxt_exponent", "-", 0.27, (0.0, 1.0), "design", sd=0.05)
"""Film exponent of 0.6 times the cold side's share of the resistance."""
LOSS = Param("hxt_loss", "-", 0.0, (-1.0, 0.95), "health", drift=0.01)


def ram_flux_kg_s_m2(mach: Array, total_pressure_pa: Array, tat_k: Array) -> Array:
    """Mass flux of outside air past the aircraft. [kg/s/m2]

    Examples
    --------
    >>> round(float(ram_flux_kg_s_m2(np.float64(0.24), np.float64(94e3), np.float64(293.15))), 1)
    88.9
    """
    static_k = tat_k / total_to_static_temperature(mach)
    density = density_kg_m3(total_pressure_pa / total_to_static_pressure(mach), static_k)
    return np.asarray(density * mach * SPEED_OF_SOUND_M_S_K * np.sqrt(static_k))


def effectiveness(hot_in_k: Array, hot_out_k: Array, tat_k: Array) -> Array:
    """Share of the way to the outside's total temperature that the hot air is cooled. [-]

    Above one where the core meets colder air than the probe in the nose: by water sprayed into the ram duct, above all.
    """
    return np.asarray((hot_in_k - hot_out_k) / (hot_in_k - tat_k))


def hot_out_k(
    *,
    hot_in_k: Array,
    tat_k: Array,
    total_pressure_pa: Array,
    ram_flux_kg_s_m2: Array,
    hxt_ntu: Array,
    hxt_exponent: Array,
    hxt_loss: Array,
) -> Array:
    r"""Hot outlet with flows by the airspeed alone. [K]

    Notes
    -----
    .. math:: \varepsilon = 1 - \exp(-(1 - s)\, N (G / 100)^{n})

    with ram flux :math:`G`, transfer units :math:`N` at 100 kg/s/m2 and loss :math:`s`. Of a cross-flow exchanger this
    is the limit of much ram air; what less does is in :math:`n`.
    """
    return _outlet(hot_in_k, tat_k, ram_flux_kg_s_m2, (hxt_ntu, hxt_exponent, hxt_loss))


def sprayed_hot_out_k(
    *,
    hot_in_k: Array,
    tat_k: Array,
    total_pressure_pa: Array,
    ram_flux_kg_s_m2: Array,
    hxt_ntu: Array,
    hxt_exponent: Array,
    hxt_water_spray: Array,
    hxt_loss: Array,
) -> Array:
    """`hot_out_k` with the ram air cooled by the term `water_spray`. [K]"""
    room_k = TERMS["water_spray"].shape({"tat_k": tat_k, "total_pressure_pa": total_pressure_pa})
    return _outlet(hot_in_k, tat_k - hxt_water_spray * room_k, ram_flux_kg_s_m2, (hxt_ntu, hxt_exponent, hxt_loss))


def _outlet(hot_in_k: Array, sink_k: Array, flux: Array, core: tuple[Array, Array, Array]) -> Array:
    ntu, exponent, loss = core
    remainder = np.exp(-(1.0 - loss) * ntu * (flux / REFERENCE_FLUX_KG_S_M2) ** exponent)
    return np.asarray(sink_k + remainder * (hot_in_k - sink_k))


_INPUTS = (
    Signal("hot_in_k", "K"),
    Signal("tat_k", "K"),
    Signal("total_pressure_pa", "Pa"),
    Signal("ram_flux_kg_s_m2", "kg/s/m2"),
)
_OUTPUTS = (Signal("hot_out_k", "K", sigma=3.0),)
"""A sensor's 1 K; of samples a second apart each counts a tenth."""
UNMETERED = PhysicsModel("unmetered_exchanger", _INPUTS, _OUTPUTS, (NTU, EXPONENT, LOSS), hot_out_k)
SPRAYED = PhysicsModel(
    "unmetered_exchanger_sprayed", _INPUTS, _OUTPUTS, (NTU, EXPONENT, SPRAY, LOSS), sprayed_hot_out_k
)


LEAST_DIFFERENCE_K = 15.0
"""Hot inlet over outside air below which noise dominates the effectiveness."""
MOVING_MACH = 0.15
"""Below it the fan and not the aircraft drives the ram air, and air data computers hold Mach at its least."""
SLOW, FAST = 95.0, 125.0
"""Ram flux of some 160 and 230 kt in a low climb. [kg/s/m2]"""
_SHARE, _FLUX = pl.col("effectiveness"), pl.col("ram_flux_kg_s_m2")


def _ram_air(samples: pl.DataFrame) -> pl.DataFrame:
    """Add total pressure from altitude and Mach, the ram flux, and the effectiveness."""
    number = {
        c: samples[c].cast(pl.Float64).to_numpy() for c in ("altitude_m", "mach", "tat_k", "hot_in_k", "hot_out_k")
    }
    total_pa = standard_pressure_pa(number["altitude_m"]) * total_to_static_pressure(number["mach"])
    flux = ram_flux_kg_s_m2(number["mach"], total_pa, number["tat_k"])
    cooling_share = effectiveness(number["hot_in_k"], number["hot_out_k"], number["tat_k"])
    warm = pl.col("hot_in_k") - pl.col("tat_k") > LEAST_DIFFERENCE_K
    return samples.with_columns(
        pl.Series("total_pressure_pa", total_pa).fill_nan(None),
        pl.Series("ram_flux_kg_s_m2", flux).fill_nan(None),
        pl.when(warm).then(pl.Series(cooling_share)).fill_nan(None).alias("effectiveness"),
    )


HXT = Component(
    code="HXT",
    name="exchanger by temperatures",
    lost="NTU lost",
    model=UNMETERED,
    terms={"water_spray": SPRAYED},
    loss="hxt_loss",
    limit=Limit(0.38, 0.10, 0.08),
    life_flights=400.0,
    action="Wash or replace the heat exchanger (ATA 21-52); look at ram inlet and core face first",
    ended_by=(REPLACED, CLEANED),
    otherwise="a ram door that opens less, more pack flow, or drier air where water is sprayed: none is recorded",
    record=Record(
        channels=(
            Channel("hot_in_degc", "hot_in_k", "K", "hot-side inlet", offset=ZERO_CELSIUS_K, low=165.0, high=625.0),
            Channel("hot_out_degc", "hot_out_k", "K", "hot-side exit", offset=ZERO_CELSIUS_K, low=165.0, high=555.0),
            Channel("tat_degc", "tat_k", "K", "total air temperature", offset=ZERO_CELSIUS_K, low=165.0, high=355.0),
            Channel("altitude_ft", "altitude_m", "m", "pressure altitude", scale=FOOT_M, low=-610.0, high=18300.0),
            Channel("mach", "mach", "-", "Mach number", low=-0.1, high=1.2),
            Channel("fan_rpm", "fan_rad_s", "rad/s", "ram air fan", scale=pi / 30.0, low=-50.0, high=7000.0,
                    needed=False),
            Channel("acm_rpm", "acm_rad_s", "rad/s", "air cycle machine", scale=pi / 30.0, low=-50.0, high=12500.0,
                    needed=False),
            Channel("ram_exit_pct", "ram_exit_open", "-", "ram air exit door", scale=0.01, low=-0.1, high=1.1,
                    needed=False),
        ),
        derive=_ram_air,
        nominal=(pl.col("mach") > MOVING_MACH) & pl.col("effectiveness").is_not_null(),
    ),
    bleed_air=True,
    readings=(
        Reading("hxt_effectiveness", "-", "share of the way to TAT that the hot air is cooled", _SHARE, below=1.0),
        Reading("hxt_effectiveness_slow", "-", "of that, at 160 kt or less", _SHARE, _FLUX < SLOW, below=1.0),
        Reading("hxt_effectiveness_fast", "-", "of that, at 230 kt or more", _SHARE, _FLUX > FAST, below=1.0),
        Reading("hxt_fan_rpm", "rpm", "ram air fan", pl.col("fan_rad_s") * 30.0 / pi),
        Reading("hxt_acm_rpm", "rpm", "air cycle machine", pl.col("acm_rad_s") * 30.0 / pi),
        Reading("hxt_ram_exit_open", "-", "ram air exit door, share open", pl.col("ram_exit_open")),
    ),
)  # fmt: skip
"""Its signals come by a type description: `docs/howto-recorder.md`."""
