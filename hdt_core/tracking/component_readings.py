"""What a component's record shows of a flight without a model: means of its declared readings."""

from typing import Any

import polars as pl

from hdt_core.components import Component, Reading
from hdt_core.flight.component_legs import LEG, MIN_SAMPLES, lacks_channel
from hdt_core.robust import MAD_TO_SD

HEALTH: dict[str, Any] = {
    "operator": pl.String, "tail": pl.String, "flight_id": pl.String, "pack": pl.Int32,
    "departed_at": pl.Datetime("us", "UTC"), "component": pl.String, "parameter": pl.String, "value": pl.Float64,
    "sd": pl.Float64, "unit": pl.String, "status": pl.String, "estimator": pl.String,
}  # fmt: skip
ONE_OR_MORE = "one_or_more"
BEYOND_SHARE = 0.1
"""Share of a flight's samples beyond what a reading can be from which its status says so."""

STRAY_SD = 5.0
"""Robust standard deviations from the median at which a sample is a spike."""


def component_readings(samples: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Readings of every flight and pack, in the columns of the health parameters.

    Parameters
    ----------
    samples : DataFrame
        Of `component_samples`.

    Returns
    -------
    DataFrame
        `value` the mean, `sd` the scatter of single samples about it, those far from the median left out. Status:
        `measured`; `one_or_more` where a tenth of the samples or more can't be what they are called; `off_nominal`
        where the flight has none of the samples that the reading is told of, `few_samples` fewer than five;
        `not_recorded`.
    """
    told = [_flights(samples, component, reading) for reading in component.readings]
    return pl.concat(told) if told else pl.DataFrame(schema=HEALTH)


def _flights(samples: pl.DataFrame, component: Component, reading: Reading) -> pl.DataFrame:
    wanted = pl.lit(True) if reading.where is None else reading.where.fill_null(False)
    here = pl.col("reading").filter(pl.col("wanted") & pl.col("reading").is_finite())
    apart = (here - here.median()).abs()
    sound = here.filter(apart <= STRAY_SD * MAD_TO_SD * apart.median() + 1e-9 * here.median().abs())
    marked = samples.with_columns(reading.value.cast(pl.Float64).alias("reading"), wanted.alias("wanted"))
    seen = marked.group_by(LEG, maintain_order=True).agg(
        pl.col("time_utc").min().alias("departed_at"),
        sound.mean().alias("value"),
        sound.std().alias("sd"),
        here.len().alias("n"),
        (here >= reading.below).mean().alias("beyond"),
        (lacks_channel(component) | pl.any_horizontal(_absent(component, reading))).alias("lacks"),
    )
    status = (
        pl.when((pl.col("n") == 0) & pl.col("lacks")).then(pl.lit("not_recorded"))
        .when(pl.col("n") == 0).then(pl.lit("off_nominal"))
        .when(pl.col("n") < MIN_SAMPLES).then(pl.lit("few_samples"))
        .when(pl.col("beyond") >= BEYOND_SHARE).then(pl.lit(ONE_OR_MORE))
        .otherwise(pl.lit("measured"))
    )  # fmt: skip
    enough = pl.col("n") >= MIN_SAMPLES
    return seen.with_columns(
        pl.when(enough).then("value"), pl.when(enough).then("sd"), status.alias("status"),
        pl.lit(component.code).alias("component"), pl.lit(reading.name).alias("parameter"),
        pl.lit(reading.unit).alias("unit"), pl.lit("reading").alias("estimator"),
    ).select(pl.col(c).cast(t) for c, t in HEALTH.items())  # fmt: skip


def _absent(component: Component, reading: Reading) -> list[pl.Expr]:
    """Whether a flight has no value at all of each channel that the reading is made from."""
    read = reading.value.meta.root_names()
    own = [c.signal for c in component.record.channels if c.signal in read] if component.record else []
    return [pl.lit(False), *(pl.col(c).is_null().all() for c in own)]
