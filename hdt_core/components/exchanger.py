"""The pack's heat exchanger."""

from hdt_core.components.declaration import CLEANED, REPLACED, Component, Limit
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER

HX = Component(
    code="HX",
    name="heat exchanger",
    lost="UA lost",
    model=HEAT_EXCHANGER,
    loss="hx_fouling",
    # where packs ran out of ram door in the first fleets seen; used where the margin is unknown
    limit=Limit(0.38, 0.10, 0.08),
    life_flights=400.0,
    action="Plan a wash or replacement of the heat exchanger (ATA 21-52, remove/install); "
    "look at ram inlet and core face first",
    message_code="21-52-HXTEMP",
    ended_by=(REPLACED, CLEANED),
    around_work=(10, 1),
)
"""Its record is the default one, its road the pack's own: see `hdt_core.twin.exchanger` and `hdt_core.health`."""
