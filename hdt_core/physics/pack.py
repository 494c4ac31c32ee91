"""The pack as its components joined: compressor and ram duct feed the heat exchanger."""

from hdt_core.physics.compressor import COMPRESSOR
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from hdt_core.physics.ports import compose
from hdt_core.physics.ram_duct import RAM_DUCT

PACK = compose(
    "pack",
    (COMPRESSOR, RAM_DUCT, HEAT_EXCHANGER),
    {
        "heat_exchanger.hot_in_k": "compressor.cc_out_k",
        "heat_exchanger.hot_flow_kg_s": "compressor.cc_flow_kg_s",
        "heat_exchanger.ram_flow_kg_s": "ram_duct.ram_flow_kg_s",
        "heat_exchanger.cold_in_k": "tat_k",
    },
)
"""Equations (2)-(5), the ram duct and the exchanger in one declaration."""
