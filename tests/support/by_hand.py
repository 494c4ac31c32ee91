"""A digital system model of round numbers, and flights of it row by row: for values worked out by hand."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.compressor import CompressorFit
from hdt_core.calibration.dsm import Dsm, SensorBiases

COMPRESSOR = CompressorFit(
    intercept_m=0.18, intercept_sd_m=0.002, slope_m_per_count=-2e-5, slope_sd_m_per_count=1e-6, scatter_m=0.004,
    mae_m=0.003, r_squared=0.5, group_m3=8e-4, group_sd_m3=2e-5, efficiency=0.8, efficiency_sd=0.008, vda_counts=400.0,
    n_flights=100, group_slope_m3_per_count=1e-7, group_slope_sd_m3_per_count=2e-8, vda_widest_counts=600.0,
)  # fmt: skip
N_DESIGN = len(hx.NAMES)
DSM = Dsm(
    dsm_version="by-hand", exchanger=tuple(map(float, hx.MEAN)),
    exchanger_cov=tuple(tuple(0.01 * float(i == j) for j in range(N_DESIGN)) for i in range(N_DESIGN)),
    gradient=(0.0,) * N_DESIGN, clean_level=0.02, clean_level_sd=0.01, offset_sd=0.05, flight_sd=0.015,
    reference_ua_w_k=2000.0, ram_balance_seen=True, compressor=COMPRESSOR, packs=(), n_flights=100,
)  # fmt: skip
START = datetime(2024, 1, 1, 6, tzinfo=UTC)


def with_bias(*packs: tuple[str, int], **bias: float) -> Dsm:
    """The model where the sensors of these packs read too high by so much."""
    unknown = set(bias) - set(hx.BIASES)
    assert not unknown, unknown
    row = tuple(bias.get(name, 0.0) for name in hx.BIASES)
    return replace(DSM, packs=tuple(SensorBiases("TST", tail, pack, 10, row, 0.0, 0.0, 0.0) for tail, pack in packs))


def flights(n: int, *, tail: str = "T-1", pack: int = 1, **columns: Any) -> pl.DataFrame:
    """A flight a day of one pack."""
    departed = [START + timedelta(k) for k in range(n)]
    named = {"flight_id": [f"{tail}_{k:03d}" for k in range(n)], "departed_at": departed}
    values = {name: pl.Series(v) if isinstance(v, list) else pl.lit(v) for name, v in columns.items()}
    return pl.DataFrame(named).with_columns(
        operator=pl.lit("TST"), tail=pl.lit(tail), pack=pl.lit(pack, pl.Int32), status=pl.lit("ok")
    ).with_columns(**values)  # fmt: skip


def samples_of(rows: pl.DataFrame, n: int) -> pl.DataFrame:
    """So many samples of each flight, a minute apart."""
    first = rows.rename({"departed_at": "time_utc"}).drop("status")
    parts = [first.with_columns(pl.col("time_utc") + pl.duration(minutes=k)) for k in range(n)]
    return pl.concat(parts).sort("time_utc")


def log(*entries: tuple[str, int, str, str, int]) -> pl.DataFrame:
    """Entries of a log: tail, pack, component, action, days after the start."""
    schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String}
    rows = [("TST", *entry[:-1], (START + timedelta(entry[-1])).date()) for entry in entries]
    return pl.DataFrame(rows, schema=schema | {"action": pl.String, "done_on": pl.Date}, orient="row")
