"""Judge the maintenance log of all components by their tracked losses, and give the log back as it should have been."""

from collections.abc import Iterable

import polars as pl

from hdt_core.components import Component
from hdt_core.records.keys import PACK
from hdt_core.records.recoveries import as_known, judge_work, settle
from hdt_core.records.unit_index import NEW_UNIT


def judge_component(
    flights: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Judge the work on a component that ends a life or answers a message.

    Parameters
    ----------
    flights : DataFrame
        `PACK`, `departed_at`, `loss`, `loss_sd`.
    messages, maintenance : DataFrame
        As stored by the raw stage.

    Returns
    -------
    DataFrame
        Of `records.recoveries.judge_work`.
    """
    own_messages = messages.filter(pl.col("code") == (component.message_code or "")).drop_nulls("pack")
    actions = tuple(dict.fromkeys((*NEW_UNIT, *component.ended_by)))
    return judge_work(flights, maintenance, own_messages, component.code, actions)


def judge_log(
    health: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, components: Iterable[Component]
) -> pl.DataFrame:
    """Judge the log of several components by `health` (table `twin_health`): rows of `judge_component`."""
    parts = []
    for component in components:
        own = health.filter(component=component.code, parameter=component.loss)
        flights = own.select(*PACK, "departed_at", loss="value", loss_sd="sd")
        parts.append(judge_component(flights, messages, maintenance, component))
    return pl.concat(parts)


def settled_log(maintenance: pl.DataFrame, judgements: pl.DataFrame) -> pl.DataFrame:
    """Return the log without work that the flights do not show, the rest where and when they show it."""
    return pl.concat([_unjudged(maintenance, judgements), settle(judgements)], how="diagonal_relaxed")


def known_log(maintenance: pl.DataFrame, judgements: pl.DataFrame) -> pl.DataFrame:
    """Return the log as the record of each time had it: work counts from `counts_from`, and until `until` if given."""
    return pl.concat([_unjudged(maintenance, judgements), as_known(judgements)], how="diagonal_relaxed")


def _unjudged(maintenance: pl.DataFrame, judgements: pl.DataFrame) -> pl.DataFrame:
    columns = [c for c in maintenance.columns if c in judgements.columns]
    return maintenance.join(judgements.select(columns), on=columns, how="anti", nulls_equal=True, maintain_order="left")
