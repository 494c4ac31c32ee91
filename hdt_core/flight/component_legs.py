"""Legs of a declared component: samples of its model, and the flights steady and long enough to estimate from."""

import polars as pl

from hdt_core.components import Component
from hdt_core.flight.legs import BLEED, ODD_BLEED
from hdt_core.flight.steady import drift_free
from hdt_core.records.keys import LEG

MIN_SAMPLES = 5
"""Samples below which a flight yields no estimate of a component."""
NO_EVIDENCE = ("NOT_RECORDED", "FEW_SAMPLES", "UNSTEADY")
"""Reasons for which a flight yields no estimate of the component."""
REASONS = {
    "NOT_RECORDED": "a signal that the component's model needs is not recorded",
    "FEW_SAMPLES": "fewer than five samples to which the component's model applies",
    "UNSTEADY": "a signal drifted during the flight",
    BLEED: ODD_BLEED,
    "STRAY": "the flight stands apart from those that the component was calibrated on",
    "NOT_COMMISSIONED": "too few steady flights of the component as built",
}


def component_samples(signals: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Return the samples of a component's model: one row a time, one column a signal.

    Parameters
    ----------
    signals : DataFrame
        Long form: `LEG`, component, time_utc, signal, value.

    Returns
    -------
    DataFrame
        `LEG`, `time_utc`, every channel of the record (null where not recorded), what its `derive` adds, and `nominal`:
        whether the model applies to the sample.
    """
    if component.record is None:
        raise ValueError(f"component {component.code} has no record of its own")
    own = signals.filter(pl.col("component") == component.code)
    names = [c.signal for c in component.record.channels]
    values = [pl.col("value").filter(pl.col("signal") == name).first().alias(name) for name in names]
    wide = own.group_by(*LEG, "time_utc").agg(values).sort(*LEG, "time_utc")
    wide = component.record.derive(wide) if component.record.derive else wide
    applies = pl.lit(True) if component.record.nominal is None else component.record.nominal
    inputs = [s.name for s in component.model.inputs]
    complete = pl.all_horizontal(pl.col(c).is_finite() for c in inputs)
    return wide.with_columns((applies & complete).fill_null(False).alias("nominal"))


def lacks_channel(component: Component) -> pl.Expr:
    """Whether a group of samples has no value at all in a channel that the component needs."""
    signals = [c.signal for c in component.record.channels if c.needed] if component.record else []
    return pl.any_horizontal([pl.lit(False), *(pl.col(c).is_null().all() for c in signals)])


def component_legs(samples: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Classify flights by whether they are long and steady enough to estimate the component from, sick or not.

    Returns
    -------
    DataFrame
        One row a flight and pack: `LEG`, `component`, `departed_at`, `n_samples`, `n_nominal`, `reason` (a key of
        `REASONS`; empty where steady).
    """
    channels = component.record.channels if component.record else ()
    second = pl.col("time_utc").dt.epoch("ms") / 1e3
    steady = [drift_free(second, c.signal, c.harmful_per_s) for c in channels if c.harmful_per_s is not None]
    few = pl.col("n_nominal") < MIN_SAMPLES
    model = [pl.col(s.name).is_finite().any() for s in (*component.model.inputs, *component.model.outputs)]
    legs = samples.group_by(LEG).agg(
        pl.col("time_utc").min().alias("departed_at"),
        pl.len().cast(pl.Int64).alias("n_samples"),
        pl.col("nominal").sum().cast(pl.Int64).alias("n_nominal"),
        (pl.all_horizontal(steady) if steady else pl.lit(True)).alias("steady"),
        (pl.all_horizontal(model) | ~lacks_channel(component)).alias("recorded"),
    )
    reason = (
        pl.when(~pl.col("recorded")).then(pl.lit("NOT_RECORDED"))
        .when(few).then(pl.lit("FEW_SAMPLES"))
        .when(~pl.col("steady")).then(pl.lit("UNSTEADY"))
        .otherwise(pl.lit(""))
    )  # fmt: skip
    rows = legs.with_columns(reason.alias("reason"), pl.lit(component.code).alias("component")).drop(
        "steady", "recorded"
    )
    return rows.sort("operator", "tail", "departed_at", "flight_id", "pack")
