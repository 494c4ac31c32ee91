"""The pack's centrifugal compressor."""

from hdt_core.components.declaration import REPLACED, Component, Limit
from hdt_core.physics.compressor import COMPRESSOR

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
