"""Readings of declared components: quantities that a record shows without a model, as a mean of every flight."""

import polars as pl

from hdt_core.components import Component, Reading
from hdt_core.flight.component_legs import MIN_SAMPLES, lacks_channel
from hdt_core.records.keys import LEG
from hdt_core.robust import MAD_TO_SD
from hdt_core.tables.twin import TwinHealth
from hdt_core.tracking.loss_filter import health_rows

STRAY_SD = 5.0
"""Robust standard deviations from the median at which a commissioning flight is no flight of the part as built, and a
sample of a reading is a spike."""
ONE_OR_MORE = "one_or_more"
BEYOND_SHARE = 0.1
"""Share of a flight's samples beyond a reading's possible range that sets its status."""


def component_readings(samples: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Compute readings of every flight and pack, in the columns of the health parameters.

    Parameters
    ----------
    samples : DataFrame
        Of `component_samples`.

    Returns
    -------
    DataFrame
        `value` the mean, `sd` the scatter of single samples about it, without those far from the median. Status:
        `measured`; `one_or_more` where a tenth of the samples or more is beyond the possible range; `off_nominal`
        where the flight has no samples of the reading, `few_samples` fewer than five;
        `not_recorded`.
    """
    frames = [_flights(samples, component, reading) for reading in component.readings]
    return pl.concat([TwinHealth.create_empty(), *frames])


def _flights(samples: pl.DataFrame, component: Component, reading: Reading) -> pl.DataFrame:
    is_used = pl.lit(True) if reading.where is None else reading.where.fill_null(False)
    values = pl.col("reading").filter(pl.col("is_used") & pl.col("reading").is_finite())
    deviation = (values - values.median()).abs()
    regular = values.filter(deviation <= STRAY_SD * MAD_TO_SD * deviation.median() + 1e-9 * values.median().abs())
    rows = samples.with_columns(reading.value.cast(pl.Float64).alias("reading"), is_used.alias("is_used"))
    means = rows.group_by(LEG, maintain_order=True).agg(
        pl.col("time_utc").min().alias("departed_at"),
        regular.mean().alias("value"),
        regular.std().alias("sd"),
        values.len().alias("n"),
        (values >= reading.below).mean().alias("beyond"),
        (lacks_channel(component) | pl.any_horizontal(_absent(component, reading))).alias("lacks"),
    )
    status = (
        pl.when((pl.col("n") == 0) & pl.col("lacks")).then(pl.lit("not_recorded"))
        .when(pl.col("n") == 0).then(pl.lit("off_nominal"))
        .when(pl.col("n") < MIN_SAMPLES).then(pl.lit("few_samples"))
        .when(pl.col("beyond") >= BEYOND_SHARE).then(pl.lit(ONE_OR_MORE))
        .otherwise(pl.lit("measured"))
    )  # fmt: skip
    is_enough = pl.col("n") >= MIN_SAMPLES
    value, sd = (means.select(pl.when(is_enough).then(c))[:, 0] for c in ("value", "sd"))
    return health_rows(means, (component.code, reading.name, reading.unit, "reading"), value, sd, status)


def _absent(component: Component, reading: Reading) -> list[pl.Expr]:
    """Flag channels of a reading without any value in a flight."""
    names = reading.value.meta.root_names()
    channels = [c.signal for c in component.record.channels if c.signal in names] if component.record else []
    return [pl.lit(False), *(pl.col(c).is_null().all() for c in channels)]
