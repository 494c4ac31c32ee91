"""An electric cabin air compressor, of which a pack may have two: speed, pressures, temperatures, and no flow."""

from math import pi

import polars as pl

from hdt_core.components.declaration import REPLACED, Channel, Component, Limit, Reading, Record
from hdt_core.physics.compressor import exit_temperature_k, isentropic_efficiency
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal
from hdt_core.records.units import PSI_PA, ZERO_CELSIUS_K

RUNNING_RAD_S = 500.0
LEAST_INLET_PA = 65e3
"""Below it, inlet pressure recorded in whole psi is too coarse: a digit is a tenth."""
LEAST_RATIO, MOST_RETURNED = 1.2, 0.1
"""With little work, or recirculated air, the compressor's inlet temperature is unknown."""


def outlet_k(*, inlet_k: Array, pressure_ratio: Array, cac_efficiency: Array, cac_efficiency_loss: Array) -> Array:
    """Compute total temperature at the exit. [K]"""
    return exit_temperature_k(inlet_k, pressure_ratio, cac_efficiency * (1.0 - cac_efficiency_loss))


def _work(samples: pl.DataFrame) -> pl.DataFrame:
    """Add pressure ratio and isentropic efficiency of a compressor that runs and compresses."""
    runs = (pl.col("speed_rad_s") > RUNNING_RAD_S) & (pl.col("inlet_pa") > 0.0)
    ratio = pl.when(runs).then(pl.col("outlet_pa") / pl.col("inlet_pa"))
    wide = samples.with_columns(ratio.alias("pressure_ratio"))
    is_compressing = (pl.col("pressure_ratio") > 1.0) & (pl.col("outlet_k") > pl.col("inlet_k"))
    stations = wide.with_columns(pl.when(is_compressing).then(pl.col(c).cast(pl.Float64)) for c in _STATIONS)
    efficiency = isentropic_efficiency(*(stations[c].to_numpy() for c in _STATIONS))
    return wide.with_columns(pl.Series("efficiency", efficiency).fill_nan(None))


_STATIONS = ("inlet_pa", "outlet_pa", "inlet_k", "outlet_k")
CAC = Component(
    code="CAC",
    name="cabin air compressor",
    lost="Efficiency lost",
    model=PhysicsModel(
        name="cabin_air_compressor",
        inputs=(Signal("inlet_k", "K"), Signal("pressure_ratio", "-")),
        outputs=(Signal("outlet_k", "K", sigma=3.0),),  # 1 K of a sensor; of samples a second apart each counts a tenth
        params=(
            Param("cac_efficiency", "-", 0.80, (0.4, 0.95), "design", sd=0.03),
            Param("cac_efficiency_loss", "-", 0.0, (-0.2, 0.7), "health", drift=0.002),
        ),
        equations=outlet_k,
    ),
    loss="cac_efficiency_loss",
    limit=Limit(0.25, 0.06, 0.05),
    life_flights=2000.0,
    warn_loss=0.08,
    action="Borescope the cabin air compressor and check its diffuser actuator (ATA 21-51); plan replacement",
    ended_by=(REPLACED,),
    around_work=(5, 1),
    record=Record(
        channels=(
            Channel("speed_rpm", "speed_rad_s", "rad/s", "shaft speed", scale=pi / 30.0, low=-50.0, high=12500.0),
            Channel("inlet_degc", "inlet_k", "K", "inlet temperature", offset=ZERO_CELSIUS_K, low=165.0, high=675.0),
            Channel("inlet_psia", "inlet_pa", "Pa", "inlet pressure", scale=PSI_PA, low=0.0, high=276e3),
            Channel("outlet_degc", "outlet_k", "K", "exit temperature", offset=ZERO_CELSIUS_K, low=165.0, high=675.0),
            Channel("outlet_psia", "outlet_pa", "Pa", "exit pressure", scale=PSI_PA, low=0.0, high=690e3),
            Channel("diffuser_pct", "diffuser_open", "-", "diffuser position", scale=0.01, low=-0.1, high=1.1,
                    needed=False),
            Channel("return_pct", "return_open", "-", "valve that leads air back to the inlet", scale=0.01, low=-0.1,
                    high=1.1, needed=False),
        ),
        derive=_work,
        nominal=(pl.col("pressure_ratio") > LEAST_RATIO)
        & (pl.col("inlet_pa") > LEAST_INLET_PA)
        & (pl.col("efficiency").is_not_null())
        & (pl.col("return_open").fill_null(0.0) < MOST_RETURNED),
    ),
    readings=(
        Reading("cac_speed_rpm", "rpm", "shaft speed", pl.col("speed_rad_s") * 30.0 / pi),
        Reading("cac_pressure_ratio", "-", "exit over inlet pressure", pl.col("pressure_ratio")),
        Reading("cac_diffuser_open", "-", "diffuser position, share open", pl.col("diffuser_open")),
        Reading("cac_efficiency_seen", "-", "isentropic efficiency", pl.col("efficiency"), pl.col("nominal"),
                below=1.0),
    ),
)  # fmt: skip
"""Its signals come by a type description; units of two packs are numbered 1 to 4."""
