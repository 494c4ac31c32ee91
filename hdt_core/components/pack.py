"""The pack's heat exchanger and its centrifugal compressor."""

from typing import NamedTuple

from hdt_core.components.declaration import CLEANED, REPLACED, Component, Limit
from hdt_core.physics.compressor import COMPRESSOR
from hdt_core.physics.installed_exchanger import INSTALLED

_UA = ("altitude_ft", "mach", "tat_degc", "hx_in_degc", "hx_out_degc", "ram_door_pct", "pack_flow_lbpm")

HX = Component(
    code="HX",
    name="heat exchanger",
    lost="Heat transfer lost",
    model=INSTALLED,
    loss="hx_fouling",
    # where packs ran out of ram door in the first fleets seen; used where the margin is unknown
    limit=Limit(0.38, 0.10, 0.08),
    life_flights=400.0,
    action="Wash or replace the heat exchanger (ATA 21-52, remove/install); look at ram inlet and core face first",
    message_code="21-52-HXTEMP",
    warn_loss=0.15,
    ended_by=(REPLACED, CLEANED),
    around_work=(10, 1),
    needs={"hx_fouling": _UA, "hx_h_hot_w_k": (*_UA, "ram_out_degc"), "hx_h_cold_w_k": (*_UA, "ram_out_degc")},
)
"""Its record is the default one; see `calibration.exchanger` and `health`."""


_HEAD = ("cc_speed_rpm", "cc_in_degc", "cc_in_psia", "cc_out_psia")

CC = Component(
    code="CC",
    name="compressor",
    lost="Efficiency lost",
    model=COMPRESSOR,
    loss="cc_efficiency_loss",
    # flow can no longer be held; more varied, since a speed margin hides it
    limit=Limit(0.25, 0.06, 0.05),
    life_flights=2000.0,
    action="Borescope the cabin air compressor and check its diffuser actuator (ATA 21-51); plan replacement",
    message_code="21-51-CCFLOW",
    warn_loss=0.05,
    ended_by=(REPLACED,),
    around_work=(5, 1),
    needs={
        "cc_effective_diameter_m": _HEAD,
        "cc_diameter_loss": (*_HEAD, "vda_pos"),
        "cc_efficiency_loss": ("cc_in_degc", "cc_in_psia", "cc_out_degc", "cc_out_psia"),
    },
)
"""Its record is the default one; see `calibration.compressor` and `health`."""


class Parts(NamedTuple):
    """The pack's parts, each with the estimator that is to be run."""

    exchanger: Component = HX
    compressor: Component = CC


PARTS = Parts()
"""As they are declared."""
