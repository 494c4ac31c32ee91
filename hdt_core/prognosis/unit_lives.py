"""Cut lives of units from flights, messages and the maintenance log, as far as the flights bear the log out."""

from collections.abc import Sequence
from datetime import timedelta

import polars as pl

from hdt_core.components import Component
from hdt_core.components.declaration import NO_FAULT
from hdt_core.components.pack import CC, HX
from hdt_core.health.work import judge_component
from hdt_core.records.keys import AIRCRAFT, LEG, LEG_AT, PACK
from hdt_core.records.recoveries import LATE_DAYS, as_recovery, units_as_known
from hdt_core.records.unit_index import NEW_UNIT, RENEWALS

# a message is answered within nine flights, the log may be five flights late, and the day it names ends five later
ANSWER_FLIGHTS = 20
"""Flights before work whose message it answered where the flights do not show which loss it recovered."""
MESSAGE_WITHIN = timedelta(days=1)
"""Longest time from a departure to a message without a flight that it sent."""


def episodes(
    features: pl.DataFrame,
    messages: pl.DataFrame,
    maintenance: pl.DataFrame,
    components: Sequence[Component] = (HX, CC),
) -> pl.DataFrame:
    """Cut lives of the exchangers and compressors, or of other components, failed or censored.

    A message ends a life only if work answered it and no inspection cleared the unit in between: a jammed ram door
    raises the same message. A replacement without a message is preventive and censors the life; a wash ends a life only
    where it answered a message. Which work there was, when and where, is judged by `records.recoveries`.

    Parameters
    ----------
    features : DataFrame
        At least operator, tail, flight_id, pack, departed_at; one row a flight and pack. Without a component's loss and
        its standard deviation the log is taken at its word.
    messages, maintenance : DataFrame
        As stored by the raw stage (message_time, flight_id, pack, code; done_on, pack, component, action, finding).

    Returns
    -------
    DataFrame
        operator, tail, pack, component, life (0..), first_row and end_row (the pack's flights counted from 0; the end
        is the message's flight, or the last flight of the unit plus one), failed, removed (another unit came),
        age_known, mute (the operator has sent no message of any kind, so that its failures are not recorded).
    """
    parts = [_lives(loss_rows(features, c), messages, maintenance, c) for c in components]
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


def loss_rows(features: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Number flights as `flight_rows` does, with the component's `loss` and `loss_sd`, null where absent."""
    name = component.loss if component.loss in features.columns else "loss"
    columns = {"loss": name, "loss_sd": f"{name}_sd"}
    losses = [
        (pl.col(name) if name in features.columns else pl.lit(None)).cast(pl.Float64).alias(alias)
        for alias, name in columns.items()
    ]
    return flight_rows(features.with_columns(losses), "loss", "loss_sd")


def units_on_record(features: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    """Return which unit flew by the record of the time, `units_as_known` of the exchanger and the compressor.

    Parameters
    ----------
    features, messages, maintenance : DataFrame
        As for `episodes`.
    """
    parts = []
    for component in (HX, CC):
        flights = loss_rows(features, component)
        units = units_as_known(flights, judge_component(flights, messages, maintenance, component))
        parts.append(units.with_columns(component=pl.lit(component.code)))
    return pl.concat(parts)


def answers(
    flights: pl.DataFrame,
    judgements: pl.DataFrame,
    messages: pl.DataFrame,
    maintenance: pl.DataFrame,
    component: Component,
) -> pl.DataFrame:
    """Match messages with the work that answered them.

    Parameters
    ----------
    flights : DataFrame
        Of `loss_rows`.
    judgements : DataFrame
        Of `judge_component`.

    Returns
    -------
    DataFrame
        `PACK`, `message_row`, `next_row` (first flight after the work), `is_near` (within `ANSWER_FLIGHTS`), and of the
        work `action`, `done_on`, `reference`, `verdict`.
    """
    work = _work_rows(flights, judgements).filter(pl.col("action").is_in(RENEWALS))
    work = work.with_columns(last_row=pl.col("next_row").shift(1).over(PACK).fill_null(0))
    after = flights.select(*PACK, "loss", "loss_sd", next_row="row", next_day="day")
    own_messages = _credible_messages(flights, messages, maintenance, component)
    with_levels = work.join(after, on=[*PACK, "next_row"], validate="m:1")
    pairs = with_levels.join(own_messages, on=PACK, suffix="_then", validate="m:m")
    pairs = pairs.filter(pl.col("message_row").is_between("last_row", "next_row"))
    is_recent = pl.col("next_day") - pl.col("day") <= pl.duration(days=LATE_DAYS)
    has_recovered = as_recovery("loss_then", "loss_sd_then", "loss", "loss_sd")
    is_shown = pl.col("is_shown") & is_recent & has_recovered
    is_logged = pl.col("is_near") & (pl.col("action").is_in(NEW_UNIT) | has_recovered)
    pairs = pairs.with_columns(is_near=pl.col("message_row") >= pl.col("next_row") - ANSWER_FLIGHTS)
    cleared = pairs.join(_cleared(maintenance, component), on=PACK, suffix="_cleared", validate="m:m").filter(
        pl.col("done_on_cleared").is_between("day", "next_day", closed="right"), ~pl.col("is_near")
    )
    matches = pairs.filter(is_logged | is_shown)
    matches = matches.join(cleared, on=[*PACK, "message_row", "next_row"], how="anti")
    return matches.select(
        *PACK, "message_row", "next_row", "is_near", "action", "done_on", "reference", "verdict"
    ).sort(*PACK, "message_row")


def _work_rows(flights: pl.DataFrame, judgements: pl.DataFrame) -> pl.DataFrame:
    """Join work that counts with `next_row`, the first flight after it; of several on one flight a replacement."""
    work = (
        judgements.filter("in_force")
        .with_columns(pack="position")
        .sort("flown_from", "action", descending=[False, True])
    )
    if "reference" not in work.columns:
        work = work.with_columns(reference=pl.lit(None, pl.String))
    departures = flights.select(*PACK, "departed_at", next_row="row").sort("departed_at")
    work = work.select(*AIRCRAFT, "pack", "action", "done_on", "reference", "verdict", "is_shown", "flown_from")
    rows = work.join_asof(
        departures,
        left_on="flown_from",
        right_on="departed_at",
        by=PACK,
        strategy="forward",
        check_sortedness=False,
    ).drop_nulls("next_row")
    return rows.unique([*PACK, "next_row"], keep="first", maintain_order=True).sort(*PACK, "next_row")


def _lives(
    flights: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    judgements = judge_component(flights, messages, maintenance, component)
    answered = answers(flights, judgements, messages, maintenance, component)
    ends = answered.group_by(*PACK, "next_row").agg(pl.col("message_row").min())
    replaced = _work_rows(flights, judgements.filter(pl.col("action").is_in(NEW_UNIT)))
    washed = answered.filter(~pl.col("action").is_in(NEW_UNIT))
    starts = [
        flights.select(PACK).unique().with_columns(first_row=pl.lit(0, pl.Int64), age_known=False),
        replaced.select(*PACK, first_row="next_row", age_known=pl.col("next_row") > 0),
        washed.select(*PACK, first_row="next_row", age_known=pl.lit(False)).unique(),
    ]
    lives = pl.concat(starts, how="vertical_relaxed").unique([*PACK, "first_row"], keep="first", maintain_order=True)
    last = flights.group_by(PACK).agg(n_rows=pl.len().cast(pl.Int64))
    lives = lives.sort(*PACK, "first_row").join(last, on=PACK, maintain_order="left", validate="m:1")
    lives = lives.with_columns(next_row=pl.col("first_row").shift(-1).over(PACK))
    lives = lives.join(ends, on=[*PACK, "next_row"], how="left", maintain_order="left", validate="m:1")
    return lives.select(
        *PACK,
        pl.lit(component.code).alias("component"),
        pl.int_range(pl.len()).over(PACK).alias("life"),
        "first_row",
        pl.coalesce("message_row", "next_row", "n_rows").alias("end_row"),
        pl.col("message_row").is_not_null().alias("failed"),
        pl.col("next_row").is_not_null().alias("removed"),
        "age_known",
    )


def _credible_messages(
    flights: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Select rows with the component's message, without those followed by an inspection that found no fault."""
    own_messages = messages.filter(pl.col("code") == (component.message_code or ""))
    rows = flights.join(_flights_of(own_messages, flights), on=LEG, validate="m:1")
    inspections = _cleared(maintenance, component)
    # inspected on one of the three days after: the message had another cause (the same day's entry may precede it)
    false_rows = rows.join(inspections, on=PACK, validate="m:m").filter(
        (pl.col("done_on") - pl.col("day")).is_between(pl.duration(days=1), pl.duration(days=3))
    )
    credible = rows.join(false_rows, on=[*PACK, "row"], how="anti")
    return credible.select(*PACK, "day", "loss", "loss_sd", message_row="row")


def _flights_of(messages: pl.DataFrame, flights: pl.DataFrame) -> pl.DataFrame:
    """Return the flights of messages, `LEG`: by id, or where that gives none the last that departed within a day."""
    of_flight = messages.join(flights, on=LEG, how="semi").select(LEG)
    others = messages.join(flights, on=LEG, how="anti").drop_nulls(["pack", "message_time"]).drop("flight_id")
    by_time = others.sort("message_time").join_asof(
        flights.select(LEG_AT).sort("departed_at"),
        left_on="message_time",
        right_on="departed_at",
        by=PACK,
        tolerance=MESSAGE_WITHIN,
        check_sortedness=False,  # both are sorted
    )
    return pl.concat([of_flight, by_time.drop_nulls("flight_id").select(LEG)]).unique()


def _cleared(maintenance: pl.DataFrame, component: Component) -> pl.DataFrame:
    """Return days on which an inspection found no fault in the component: `PACK`, `done_on`."""
    is_clear = (pl.col("component") == component.code) & (pl.col("finding") == NO_FAULT)
    return maintenance.filter(is_clear).select(*PACK, "done_on")
