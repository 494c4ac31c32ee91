"""Facts of a flight that its judgement needs, each from its recorded rows alone."""

from collections.abc import Sequence

import polars as pl

from hdt_core.flight.phases import CRUISE_FLOOR_M
from hdt_core.record.exchange import BETWEEN_PACKS, PACKS, between_packs
from hdt_core.record.two_sources import contradicted_logs, without_logs
from hdt_core.records.keys import FLIGHT
from hdt_core.tables.raw import SIGNALS

AIRBORNE_MACH = 0.2
"""Mach number above which an aircraft flies. [-]"""
SILENCE_S = 10_800
"""Reports come every 2 to 10 minutes; the longest gap of an intact flight in the sample fleet is 26 minutes. [s]"""
GROUND_STOP_S = 1_200
"""Longest time between airborne reports below cruise within a flight: a hold has reports, a turnaround none. [s]"""
AIRPORTS = ("origin", "destination")


def flight_facts(rows: pl.DataFrame) -> pl.DataFrame:
    """Summarise each flight in a row: the columns of `raw_flights`.

    Parameters
    ----------
    rows : DataFrame
        Of `raw_snapshots` and `raw_logs`, with `row_in_file`, the row's place in its file. A log that contradicts the
        snapshots of its flight is left out.
    """
    log_faults = contradicted_logs(rows)
    rows = without_logs(rows, log_faults)
    acms = pl.col("source") == "acms"
    cpl = pl.col("source") == "cpl"
    one_source = pl.when(cpl.any()).then(pl.lit("cpl")).otherwise(pl.lit("acms"))
    source = pl.when(acms.any() & cpl.any()).then(pl.lit("both")).otherwise(one_source)
    times = pl.col("time_utc")
    altitudes_m = pl.col("altitude_m").drop_nulls()
    machs = pl.col("mach").drop_nulls()
    ordered = rows.sort(*FLIGHT, "time_utc", "pack", "source")
    flights = ordered.group_by(FLIGHT, maintain_order=True).agg(
        times.min().alias("departed_at"),
        times.max().alias("landed_at"),
        source.alias("source"),
        times.filter(acms).n_unique().cast(pl.Int64).alias("n_snapshots"),
        times.filter(cpl).n_unique().cast(pl.Int64).alias("n_seconds"),
        *(pl.col(c).drop_nulls().first() for c in AIRPORTS),
        altitudes_m.first().alias("first_altitude_m"),
        altitudes_m.last().alias("last_altitude_m"),
        altitudes_m.max().alias("highest_altitude_m"),
        altitudes_m.mean().alias("mean_altitude_m"),
        machs.first().alias("first_mach"),
        machs.last().alias("last_mach"),
        machs.max().alias("highest_mach"),
        pl.col("tat_k").mean().alias("mean_tat_k"),
        pl.col("hx_in_k").mean().alias("mean_hx_in_k"),
        _highest_flow().alias("highest_flow_kg_s"),
        *(between_packs(signal).alias(name) for name, signal in BETWEEN_PACKS.items()),
        pl.sum_horizontal(pl.col(SIGNALS).count()).cast(pl.Int64).alias("n_values"),
    )
    for further in (_backward_steps(rows), log_faults):
        flights = flights.join(further, on=FLIGHT, how="left", maintain_order="left", validate="1:1")
    return flights.with_columns(pl.col("clock_back_s", "n_steps_back").fill_null(0))


def ground_stops(rows: pl.DataFrame, key: Sequence[str]) -> pl.DataFrame:
    """Find the flights that were on the ground between two of their airborne reports.

    Parameters
    ----------
    rows : DataFrame
        `key`, `time_utc`, `altitude_m`, `mach`; null where not recorded.
    key : sequence of str
        Columns that identify a flight.

    Returns
    -------
    DataFrame
        `key`, `ground_stop_s`: the longest time between two airborne reports in a row that are both low [s].
    """
    airborne = rows.filter(pl.col("mach") > AIRBORNE_MACH, pl.col("altitude_m").is_not_null()).sort(*key, "time_utc")
    is_low = pl.col("altitude_m") < CRUISE_FLOOR_M
    gap_s = pl.when(is_low & is_low.shift()).then(pl.col("time_utc").diff().dt.total_seconds())
    flights = airborne.select(*key, gap_s.over(key).alias("gap_s")).group_by(key, maintain_order=True)
    longest = flights.agg(pl.col("gap_s").max().alias("ground_stop_s"))
    return longest.filter(pl.col("ground_stop_s") > GROUND_STOP_S)


def _highest_flow() -> pl.Expr:
    """Return the usual flow of the pack that flows most: the other may be off."""
    flow = pl.col("pack_flow_kg_s")
    return pl.max_horizontal(flow.filter(pl.col("pack") == pack).median() for pack in PACKS)


def _backward_steps(rows: pl.DataFrame) -> pl.DataFrame:
    """Find the largest step back of the clock, pack by pack in the order of each file, and count such steps.

    Parts of a file in exchanged order, without a silence between them, are no step back.
    """
    in_file = ("file", "source", "pack")
    ordered = rows.filter(pl.col("row_in_file") > 0).sort(*FLIGHT, *in_file, "row_in_file")
    times = pl.col("time_utc")
    step_s = times.diff().dt.total_seconds()
    silence_s = times.sort().diff().max().dt.total_seconds()
    exchanged = (times.last() < times.first()) & (silence_s < SILENCE_S)
    packs = ordered.group_by(*FLIGHT, *in_file).agg(
        pl.when(~exchanged).then(-step_s.min()).clip(0).alias("back_s"),
        pl.when(~exchanged).then((step_s < 0).sum()).cast(pl.Int64).alias("n"),
    )
    return packs.group_by(FLIGHT).agg(clock_back_s=pl.col("back_s").max(), n_steps_back=pl.col("n").max())
