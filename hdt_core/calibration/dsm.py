"""The Digital System Model: how the fleet was built, frozen and versioned."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.compressor import PROBE_BIASES
from hdt_core.calibration.compressor_fit import CompressorFit
from hdt_core.calibration.forms import FormFit
from hdt_core.calibration.pooling import PooledLevel
from hdt_core.loading import with_tuples
from hdt_core.physics.heat_exchanger import REFERENCE_HOT_FLOW_KG_S, REFERENCE_RAM_FLOW_KG_S
from hdt_core.physics.model import Array
from hdt_core.records.keys import PACK

ROWS_AT_ONCE = 20_000
"""Rows formatted as text at once while hashing."""


@dataclass(frozen=True, slots=True)
class SensorBiases:
    """Biases of one pack's sensors (`hx.BIASES`, then the compressor's probes), from its baseline flights."""

    operator: str
    tail: str
    pack: int
    n_flights: int
    bias: tuple[float, ...]
    inlet_bias_k: float
    inlet_bias_ln: float
    exit_bias_ln: float


@dataclass(frozen=True, slots=True)
class Dsm:
    """Digital System Model.

    Attributes
    ----------
    exchanger, exchanger_cov
        Design vector in the order of `hx.NAMES` and its covariance.
    exchanger_status : str
        How that estimate ended, a status of `Estimate`.
    gradient : tuple
        Mean derivative of the ln conductance ratio by design over the baseline: where the model is anchored.
    clean_level, offset_sd : float
        ln conductance ratio of a clean unit: fleet mean, and spread by unit and its sensors.
    flight_sd : float
        Scatter of a flight's ln conductance ratio about the pack's health.
    reference_ua_w_k : float
        Clean conductance at the condition that losses are stated for: a middling cruise of a clean pack.
    cruise_flows_kg_s : tuple
        Hot and ram flow in the middle of the baseline, where the law is known best.
    levels : tuple of PooledLevel
        Conductance of each operator and pack, pooled with the fleet.
    hot_inlet : tuple
        Slopes of the hot inlet's law, in the order of `calibration.inlet_law.TERMS`; empty where it is not known.
    terms : dict
        Coefficient of each physical term that an engineer has accepted (`physics.terms`), by name.
    """

    dsm_version: str
    exchanger: tuple[float, ...]
    exchanger_cov: tuple[tuple[float, ...], ...]
    gradient: tuple[float, ...]
    clean_level: float
    clean_level_sd: float
    offset_sd: float
    flight_sd: float
    reference_ua_w_k: float
    ram_balance_seen: bool
    compressor: CompressorFit
    packs: tuple[SensorBiases, ...]
    n_flights: int
    cruise_flows_kg_s: tuple[float, float] = (REFERENCE_HOT_FLOW_KG_S, REFERENCE_RAM_FLOW_KG_S)
    levels: tuple[PooledLevel, ...] = ()
    hot_inlet: tuple[float, ...] = ()
    terms: dict[str, float] = field(default_factory=dict)
    exchanger_status: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain numbers, lists and strings, ready for JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "Dsm":
        """Build a model from the result of `to_dict`."""
        values = with_tuples(dict(plain))
        compressor = values["compressor"]
        compressor["forms"] = tuple(FormFit(**f) for f in compressor["forms"])
        compressor["levels"] = tuple(PooledLevel(**v) for v in compressor["levels"])
        values["compressor"] = CompressorFit(**compressor)
        values["packs"] = tuple(SensorBiases(**p) for p in values["packs"])
        values["levels"] = tuple(PooledLevel(**v) for v in values["levels"])
        return cls(**values)

    @property
    def design(self) -> Array:
        """Return the design vector in the order of `hx.NAMES`."""
        return np.array(self.exchanger)

    def pack_table(self) -> pl.DataFrame:
        """Tabulate packs: `PACK`, compressor probe corrections and sensor biases as `bias_<signal>`."""
        columns = (*PACK, *PROBE_BIASES)
        rows = [(*(getattr(p, name) for name in columns), *p.bias) for p in self.packs]
        schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32}
        schema |= dict.fromkeys((*PROBE_BIASES, *(f"bias_{name}" for name in hx.BIASES)), pl.Float64)
        return pl.DataFrame(rows, schema=schema, orient="row")

    def bias_of(self, frame: pl.DataFrame) -> Array:
        """Look up sensor biases of each row's pack, 0 for an unknown pack. (6, n)"""
        columns = [f"bias_{name}" for name in hx.BIASES]
        rows = frame.select(PACK).join(self.pack_table(), on=PACK, how="left", maintain_order="left", validate="m:1")
        return rows.select(pl.col(columns).fill_null(0.0)).to_numpy().T


def version_of(*frames: pl.DataFrame) -> str:
    """Hash the values of frames in the order of their rows: twelve hexadecimal digits."""
    digest = hashlib.sha256()
    for frame in frames:
        digest.update("|".join(frame.columns).encode())
        digest.update(frame.clear().write_csv().encode())
        for rows in frame.iter_slices(ROWS_AT_ONCE):
            digest.update(rows.write_csv(float_precision=9, include_header=False).encode())
    return digest.hexdigest()[:12]
