"""One pack that flies four times a day: its features made by hand, its log of work, its alerts."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl

from hdt_core.alerts.alerts import raise_alerts
from hdt_core.alerts.cases import Case, Grid
from hdt_core.tables.alerts import FeaturesAlerts

FLIGHTS = 100
A_DAY = 4
START = datetime(2024, 3, 1, 1, tzinfo=UTC)
OWN = {"operator": "TST", "tail": "T-AAA", "pack": 1}


def departure(k: int) -> datetime:
    """Four flights a day, five hours apart."""
    return START + timedelta(days=k // A_DAY, hours=5 * (k % A_DAY))


def features(loss: np.ndarray, **columns: float | np.ndarray) -> pl.DataFrame:
    """Features of one pack that has lost so much after each flight."""
    n = len(loss)
    at = [departure(k) for k in range(n)]
    frame = pl.DataFrame({"departed_at": at, "hx_fouling": loss, "hx_fouling_flight": loss} | columns).with_columns(
        *(pl.lit(v).alias(k) for k, v in OWN.items()),
        pl.Series("flight_id", [f"T-AAA_{a:%Y%m%d}_{k % A_DAY + 1:02d}" for k, a in enumerate(at)]),
        pl.lit(0.01).alias("hx_fouling_sd"),
        pl.lit(True).alias("running"),
        pl.col("departed_at").cast(pl.Datetime("us", "UTC")),
    )
    slope = pl.Series(np.gradient(loss))
    return frame.with_columns(
        pl.col("pack").cast(pl.Int32),
        *(slope.alias(f"hx_fouling_slope_{h}_per_flight") for h in (30, 100)),
        hx_fouling_step_3=pl.col("hx_fouling") - pl.col("hx_fouling").shift(3),
    )


def work(at: datetime, component: str = "HX", action: str = "REPLACED", *, timed: bool = False) -> pl.DataFrame:
    row = OWN | {"component": component, "action": action, "finding": None, "done_on": at.date()}
    schema = {"pack": pl.Int32, "finding": pl.String, "done_at": pl.Datetime("us", "UTC")}
    return pl.DataFrame([row | {"done_at": at if timed else None}], schema_overrides=schema)


def grid(**columns: object) -> Grid:
    """One pack's flights with these columns and no others."""
    frame = pl.DataFrame(
        {"departed_at": [departure(k) for k in range(FLIGHTS)], "flight_id": [f"F{k:03d}" for k in range(FLIGHTS)]}
    )
    own = [pl.lit(v).alias(k) for k, v in OWN.items()]
    extra = [
        pl.Series(k, np.broadcast_to(v, FLIGHTS)) if not isinstance(v, pl.Expr) else v.alias(k)
        for k, v in columns.items()
    ]
    typed = {"pack": pl.Int32, "departed_at": pl.Datetime("us", "UTC")}
    return Grid.from_frame(frame.with_columns(*own, *extra).cast(typed))


def spans(cases: list[Case]) -> list[tuple[str, int, int | None]]:
    return [(case.diagnosis, case.raised_flight, case.closed_flight) for case in cases]


def work_before(first: int, log_of: str = "HX", action: str = "REPLACED") -> pl.DataFrame:
    """Work just before a flight."""
    return work(departure(first) - timedelta(minutes=5), log_of, action, timed=True)


def alerts(rows: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    out = raise_alerts(rows, maintenance)
    assert FeaturesAlerts.faults(out) == []
    return out
