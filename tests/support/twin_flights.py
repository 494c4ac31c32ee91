"""What flights alone say of a pack with known wear, without going through a cruise: for the sequential pass."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl

NO_LOG = pl.DataFrame(
    schema={
        "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String,
        "action": pl.String, "done_on": pl.Date,
    }
)  # fmt: skip


def flights_with_loss(
    model, loss: np.ndarray, *, offset: float | np.ndarray = 0.0, seed: int = 0, tail: str = "S-0"
) -> pl.DataFrame:
    """One pack, a flight a day, with this loss; noise as the model expects it."""
    rng = np.random.default_rng(seed)
    n = len(loss)
    sampling = 0.005
    noise = np.hypot(model.flight_sd, sampling) * rng.standard_normal(n)
    start = datetime(2024, 1, 1, 6, tzinfo=UTC)
    return pl.DataFrame(
        {
            "flight_id": [f"{tail}_{k:04d}" for k in range(n)],
            "departed_at": [start + timedelta(days=k) for k in range(n)],
            "ln_ua_ratio": model.clean_level + offset + np.log(1.0 - np.asarray(loss)) + noise,
            "ln_ua_ratio_sd": np.full(n, sampling),
            "ln_ua_ratio_map_sd": np.zeros(n),
            "ua_expected_w_k": np.full(n, model.reference_ua_w_k),
        }
    ).with_columns(
        pl.lit("TST").alias("operator"),
        pl.lit(tail).alias("tail"),
        pl.lit(1, pl.Int32).alias("pack"),
        pl.lit("ok").alias("status"),
        pl.col("departed_at").cast(pl.Datetime("us", "UTC")),
    )


def entry(twin: pl.DataFrame, k: int, component: str, action: str) -> pl.DataFrame:
    """A log of one line: work on the day of flight k - 1, the first with it being flight k."""
    row = twin.row(k - 1, named=True)
    fields = {"component": component, "action": action, "done_on": row["departed_at"].date()}
    return pl.DataFrame([{c: row[c] for c in ("operator", "tail", "pack")} | fields], schema=NO_LOG.schema)
