"""Cut lives of units from flights, messages and the maintenance log."""

from collections.abc import Sequence

import polars as pl

from hdt_core.components import Component
from hdt_core.components.pack import CC, HX
from hdt_core.records.keys import LEG, PACK
from hdt_core.records.unit_index import first_flights

# a message is answered within nine flights, the log may be five flights late, and the day it names ends five later
ANSWER_FLIGHTS = 20


def episodes(
    features: pl.DataFrame,
    messages: pl.DataFrame,
    maintenance: pl.DataFrame,
    components: Sequence[Component] = (HX, CC),
) -> pl.DataFrame:
    """Cut lives of the exchangers and compressors, or of other components, failed or censored.

    A message ends a life only if the unit is replaced soon after it and no inspection cleared the unit in between: a
    jammed ram door raises the same message. A replacement without a message is preventive and censors the life.

    Parameters
    ----------
    features : DataFrame
        At least operator, tail, flight_id, pack, departed_at; one row a flight and pack.
    messages, maintenance : DataFrame
        As stored by the raw stage (message_time, flight_id, pack, code; done_on, pack, component, action, finding).

    Returns
    -------
    DataFrame
        operator, tail, pack, component, life (0..), first_row and end_row (the pack's flights counted from 0; the end
        is the message's flight, or the last flight of the unit plus one), failed, removed (another unit came),
        age_known, mute (the operator has sent no message of any kind, so that its failures are not recorded).
    """
    flights = flight_rows(features)
    parts = [_lives(flights, messages, maintenance, component) for component in components]
    is_mute = ~pl.col("operator").is_in(messages["operator"].unique().implode())
    return pl.concat(parts).sort("component", *PACK, "life").with_columns(mute=is_mute)


def life_table(features: pl.DataFrame, lives: pl.DataFrame) -> pl.DataFrame:
    """Build the table of lives: what ended each, and its first and last flight.

    Parameters
    ----------
    features : DataFrame
        As for `episodes`.
    lives : DataFrame
        From `episodes`.

    Returns
    -------
    DataFrame
        operator, tail, pack, component, life, ended_by (message, replaced, unheard, or null while it flies), censored,
        n_flights, first_row and end_row as in `episodes`, first_flight_id and first_departed_at, end_flight_id and
        end_departed_at (the message's flight, else the unit's last).
    """
    flights = flight_rows(features).select(*PACK, "row", "flight_id", "departed_at")
    last = pl.when("failed").then("end_row").otherwise(pl.col("end_row") - 1)
    removal = pl.when("mute").then(pl.lit("unheard")).otherwise(pl.lit("replaced"))
    ended_by = pl.when("failed").then(pl.lit("message")).when("removed").then(removal)
    ends = lives.with_columns(last_row=last, ended_by=ended_by, censored=~pl.col("failed"))
    first, end = (
        flights.rename({"row": f"{at}_row", "flight_id": f"{name}_flight_id", "departed_at": f"{name}_departed_at"})
        for at, name in (("first", "first"), ("last", "end"))
    )
    table = ends.join(first, on=[*PACK, "first_row"], how="left", validate="m:1").join(
        end, on=[*PACK, "last_row"], how="left", validate="m:1"
    )
    return table.with_columns(n_flights=pl.col("end_row") - pl.col("first_row"))


def flight_rows(features: pl.DataFrame, *columns: str) -> pl.DataFrame:
    """Number flights of each pack in order of departure, from 0 in `row`, with further `columns`."""
    keys = features.select(*PACK, "flight_id", "departed_at", *columns).unique([*PACK, "flight_id"], keep="first")
    return keys.sort(*PACK, "departed_at", "flight_id").with_columns(
        pl.int_range(pl.len()).over(PACK).cast(pl.Int64).alias("row"), pl.col("departed_at").dt.date().alias("day")
    )


def with_lives(flights: pl.DataFrame, lives: pl.DataFrame, component: str) -> pl.DataFrame:
    """Join flights of `flight_rows` with the unit's life: `life_id` over the fleet, `remaining` flights to its end."""
    units = lives.filter(pl.col("component") == component).drop("component").sort("first_row")
    rows = flights.join_asof(  # both sides are in order within each pack, which Polars can't see
        units, left_on="row", right_on="first_row", by=PACK, coalesce=False, check_sortedness=False
    ).drop_nulls("life")
    return rows.with_columns(
        life_id=pl.struct(*PACK, "life").rank("dense").cast(pl.Int64) - 1,
        remaining=(pl.col("end_row") - pl.col("row")).cast(pl.Float64),
    )


def _lives(
    flights: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    changes = first_flights(flights, maintenance, (component.code,))
    replaced_units = changes.select(*PACK, first_row="row")
    initial = flights.select(PACK).unique().with_columns(first_row=pl.lit(0, pl.Int64))
    last = flights.group_by(PACK).agg(n_rows=pl.len().cast(pl.Int64))
    lives = pl.concat([initial, replaced_units]).unique().sort(*PACK, "first_row")
    lives = lives.join(last, on=PACK, validate="m:1").with_columns(next_row=pl.col("first_row").shift(-1).over(PACK))
    ends = _credible_messages(flights, messages, maintenance, component)
    ends = lives.join(ends, on=PACK, how="left", validate="m:m").filter(
        (pl.col("message_row") >= pl.col("first_row"))
        & (pl.col("message_row") <= pl.col("next_row"))
        & (pl.col("message_row") >= pl.col("next_row") - ANSWER_FLIGHTS)
    )
    ends = ends.group_by(*PACK, "first_row").agg(message_row=pl.col("message_row").min())
    lives = lives.join(ends, on=[*PACK, "first_row"], how="left", validate="m:1")
    return lives.select(
        *PACK,
        pl.lit(component.code).alias("component"),
        pl.int_range(pl.len()).over(PACK).alias("life"),
        "first_row",
        pl.coalesce("message_row", "next_row", "n_rows").alias("end_row"),
        pl.col("message_row").is_not_null().alias("failed"),
        pl.col("next_row").is_not_null().alias("removed"),
        (pl.col("first_row") > 0).alias("age_known"),
    )


def _credible_messages(
    flights: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Select rows with the component's message, without those followed by an inspection that found no fault."""
    sent = messages.filter(pl.col("code") == (component.message_code or "")).select(LEG).unique()
    rows = flights.join(sent, on=LEG, validate="m:1")
    inspections = maintenance.filter(
        (pl.col("component") == component.code) & (pl.col("finding") == "NO_FAULT_FOUND")
    ).select(*PACK, "done_on")
    # inspected on one of the three days after: the message had another cause (the same day's entry may precede it)
    false_rows = rows.join(inspections, on=PACK, validate="m:m").filter(
        (pl.col("done_on") - pl.col("day")).is_between(pl.duration(days=1), pl.duration(days=3))
    )
    return rows.join(false_rows, on=[*PACK, "row"], how="anti").select(*PACK, pl.col("row").alias("message_row"))
