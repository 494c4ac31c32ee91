"""Level one of the nominal-leg filter: rules for every flight and pack, each rejection with its reason."""

import polars as pl

from hdt_core.components.pack import CC, HX
from hdt_core.flight.channels import (
    LOWER_RATE,
    NO_CHANNELS,
    ONE_CHANNEL,
    count_gaps,
    find_channels,
    lost_share,
    null_channels,
)
from hdt_core.flight.phases import CRUISE_FLOOR_M, add_phases, number_legs, seconds_between
from hdt_core.flight.quality import RUNNING_KG_S, SIGNALS, null_bad_values, reading_step
from hdt_core.flight.steady import average_log, steady_snapshots, thin_log
from hdt_core.records.keys import AIRCRAFT, FLIGHT, LEG, PACK, is_among

RECORD_KEY = (*LEG, "source")
# without these neither exchanger nor compressor can be modelled on a sample
MODEL_SIGNALS = (
    "altitude_m",
    "mach",
    "tat_k",
    "total_pressure_pa",
    "hx_in_k",
    "hx_out_k",
    "ram_door_open",
    "pack_flow_kg_s",
)
MIN_NOMINAL = 2  # samples of steady cruise that a leg must have
DROPOUT_SHARE, DROPOUT_ROWS = 0.12, 3  # of a signal's values missing in a leg that has the sensor
DOOR_STILL, DOOR_STILL_ROWS, DOOR_STILL_RISE_M = 0.035, 8, 4_000.0  # a door still through a climb is jammed
ICING_TAT_K = (268.15, 283.15)  # -5 to +10 degC: water may be supercooled and freeze on the core
ICING_BELOW_M = 6_700.0  # 22,000 ft: icing clouds

REASONS = {
    "NO_CRUISE": "no steady cruise: nothing to calibrate on",
    "PACK_OFF": "the pack was off",
    "OTHER_PACK_OFF": "the other pack was off, this one carried the load of both",
    "ONE_CHANNEL": "both packs' signals are one channel under two names",
    "SENSOR_MISSING": "a fitted sensor dropped out",
    "SENSOR_FROZEN": "a sensor repeated one reading where it must have moved",
    "DOOR_STILL": "the ram air door stood still through climb or descent",
    "ICING": "most of the cruise in icing conditions",
}


def judge_legs(snapshots: pl.DataFrame, channels: pl.DataFrame | None = None) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Apply the rules to every flight and pack by its own record, and prepare its samples.

    Parameters
    ----------
    snapshots : DataFrame
        Recorded rows of both kinds, see `hdt_core.tables`; `source` is `acms` (snapshots) or `cpl` (1/8 to 8 Hz).
    channels : DataFrame, optional
        `channels.find_channels(snapshots)`, where it is known.

    Returns
    -------
    legs : DataFrame
        One row for each flight and pack of `snapshots`: `admitted` and `reason` (a key of `REASONS`, empty when
        admitted).
    samples : DataFrame
        One row for each snapshot and each averaged minute of a 1 Hz log, bad values nulled, with `phase`, `monitored`
        (steady cruise, complete, sick or not), `nominal` (monitored, in an admitted leg, no icing) and `n_averaged`.
    """
    channels = find_channels(snapshots) if channels is None else channels
    samples = prepare_samples(snapshots, channels)
    legs = _give_reasons(number_flights(_summarise(samples, channels)))
    rows = samples.join(legs.select(*LEG, "admitted"), on=LEG, how="left", maintain_order="left", validate="m:1")
    nominal = pl.col("monitored") & pl.col("admitted") & ~pl.col("icing")
    return legs, rows.with_columns(nominal.alias("nominal")).drop("admitted")


def prepare_samples(snapshots: pl.DataFrame, channels: pl.DataFrame = NO_CHANNELS) -> pl.DataFrame:
    """Screen values, add phases, average logs; `monitored` where a sample is steady cruise and complete."""
    in_order = null_channels(snapshots, channels).sort(*RECORD_KEY, "time_utc", maintain_order=True)
    ordered = number_legs(thin_log(in_order, by=RECORD_KEY), RECORD_KEY)
    is_repeat = (pl.col("_leg") == pl.col("_leg").shift(1)) & (pl.col("time_utc") == pl.col("time_utc").shift(1))
    first = pl.col("time_utc").min().over(FLIGHT)
    records = ordered.filter(~is_repeat.fill_null(False)).drop("_leg").with_columns(first.alias("departed_at"))
    phases = add_phases(null_bad_values(records, by=RECORD_KEY), by=RECORD_KEY)
    reports = steady_snapshots(phases.filter(pl.col("source") == "acms"), by=RECORD_KEY).with_columns(
        pl.lit(1, pl.Int64).alias("n_averaged")
    )
    slower = channels.filter(source="cpl", reason=LOWER_RATE).pivot(
        "signal", index=RECORD_KEY, values="delivered_share"
    )
    log = average_log(phases.filter(pl.col("source") == "cpl"), by=RECORD_KEY, delivered_shares=slower)
    rows = pl.concat([reports.drop("phase_code"), log], how="diagonal").sort(*LEG, "time_utc", "source")
    complete = pl.all_horizontal(pl.col(s).is_not_null() for s in MODEL_SIGNALS)
    running = pl.col("pack_flow_kg_s") > RUNNING_KG_S
    icing = pl.col("tat_k").is_between(*ICING_TAT_K) & (pl.col("altitude_m") < ICING_BELOW_M)
    return rows.with_columns(
        ((pl.col("phase") == "cruise") & pl.col("steady") & complete & running).fill_null(False).alias("monitored"),
        icing.fill_null(False).alias("icing"),
    )


def _summarise(samples: pl.DataFrame, channels: pl.DataFrame) -> pl.DataFrame:
    """Summarise each flight and pack in the quantities of the rules."""
    cruise = pl.col("phase") == "cruise"
    cruise_s = seconds_between(pl.col("time_utc").filter(cruise).max(), pl.col("time_utc").filter(cruise).min())
    legs = samples.group_by(LEG).agg(
        pl.col("departed_at").first(),
        pl.col("time_utc").max().alias("landed_at"),
        pl.when(pl.col("source").n_unique() == 1).then(pl.col("source").first()).otherwise(pl.lit("both")),
        pl.len().alias("n_samples"),
        (pl.col("source") == "acms").sum().alias("n_snapshots"),
        pl.col("monitored").sum().alias("n_monitored"),
        (pl.col("monitored") & ~pl.col("icing")).sum().alias("n_nominal"),
        (cruise_s.fill_null(0.0) / 60.0).alias("cruise_minutes"),
        pl.col("n_frozen").sum(),
        pl.col("pack_flow_kg_s").median().alias("_flow"),
        (pl.col("ram_door_open").quantile(0.95) - pl.col("ram_door_open").quantile(0.05)).alias("_door_span"),
        reading_step("ram_door_open").alias("_door_step"),
        (pl.col("altitude_m").max() - pl.col("altitude_m").min()).alias("_rise_m"),
        *(pl.col(s).null_count().alias(f"_missing_{s}") for s in SIGNALS),
    )
    flights = legs.with_columns(pl.col("landed_at").max().over(FLIGHT), pl.col("_door_step").min().over(FLIGHT))
    shared = channels.filter(reason=ONE_CHANNEL).select(LEG).unique().with_columns(pl.lit(True).alias("_one_channel"))
    for part in (count_gaps(channels), shared):
        flights = flights.join(part, on=LEG, how="left", validate="1:1")
    return flights.with_columns(pl.col("^n_.*$").cast(pl.Int64)).sort(*LEG)


def _give_reasons(legs: pl.DataFrame) -> pl.DataFrame:
    """Add `reason`, the first rule broken, and `admitted`."""
    rules = {
        "PACK_OFF": _is_off(pl.col("_flow")),
        "OTHER_PACK_OFF": _is_off(pl.col("_flow")).any().over(FLIGHT),
        "ONE_CHANNEL": pl.col("_one_channel"),
        "SENSOR_FROZEN": pl.col("n_frozen") > 0,
        "DOOR_STILL": (pl.col("_door_span") < DOOR_STILL)
        & (pl.col("_door_step") < DOOR_STILL).fill_null(True)
        & (pl.col("n_samples") >= DOOR_STILL_ROWS)
        & (pl.col("_rise_m") > DOOR_STILL_RISE_M),
        "SENSOR_MISSING": pl.any_horizontal(_dropped_out(s) for s in SIGNALS),
        "ICING": (pl.col("n_monitored") >= MIN_NOMINAL) & (pl.col("n_nominal") < MIN_NOMINAL),
        "NO_CRUISE": pl.col("n_nominal") < MIN_NOMINAL,
    }
    first = pl.coalesce(*(pl.when(rule).then(pl.lit(code)) for code, rule in rules.items()), pl.lit(""))
    rows = legs.with_columns(first.alias("reason")).with_columns((pl.col("reason") == "").alias("admitted"))
    return rows.drop(pl.selectors.starts_with("_", "gaps_"))


def _is_off(flow: pl.Expr) -> pl.Expr:
    return (flow < RUNNING_KG_S).fill_null(False)


def _dropped_out(signal: str) -> pl.Expr:
    """Flag far more gaps than a fitted sensor has; a signal missing on both packs of the flight is not fitted."""
    missing = pl.col(f"_missing_{signal}")
    is_fitted = (missing < pl.col("n_samples")).any().over(FLIGHT)
    share = lost_share(signal, missing, pl.col("n_samples"))
    return is_fitted & (missing >= DROPOUT_ROWS) & (share > DROPOUT_SHARE)


# flights of the tail before an entry that may be sick, and after it that may still be: entries come up to five
# flights late
AROUND_MAINTENANCE = {**{c.code: c.around_work for c in (HX, CC)}, "RAM_DOOR": (15, 1), "SENSOR": (15, 1)}
# messages of the pack's own exchanger and compressor; others (trim air, cabin fans) do not concern it
AROUND_MESSAGE = {str(HX.message_code)[:5]: (10, 5), str(CC.message_code)[:5]: (10, 5)}
# an inspection changes nothing, and the flights around a wash show by themselves how foul the exchanger was
HARMLESS = ("INSPECTED", "CLEANED")
LONGEST_PAUSE = "21d"
MILESTONES = (10, 20, 40, 80, 160)
"""Flights of a tail after which its baseline is extended; the last ends the commissioning window. Later flights are
never calibrated on, or slow wear would be learned as normal."""


def baseline_flights(flights: pl.DataFrame) -> list[str]:
    """Return the flights to calibrate on: the first of each tail, up to the last milestone it has passed.

    Parameters
    ----------
    flights : DataFrame
        `operator, tail, flight_id, departed_at`; more columns and rows (packs) are allowed.

    Returns
    -------
    list of str
        Sorted flight ids. A tail short of the first milestone contributes all. The result does not depend on the order
        in which flights arrived.
    """
    each = flights.group_by(FLIGHT).agg(pl.col("departed_at").min())
    order = pl.struct("departed_at", "flight_id").rank("ordinal").over(AIRCRAFT)
    milestone = pl.max_horizontal(pl.when(pl.len().over(AIRCRAFT) >= m).then(m) for m in MILESTONES)
    return sorted(each.filter(order <= milestone.fill_null(MILESTONES[0]))["flight_id"].to_list())


def number_flights(legs: pl.DataFrame) -> pl.DataFrame:
    """Add `flight_number`: the tail's flights in order of departure, from 0, the same for both packs."""
    order = pl.col("departed_at").rank("dense").over(AIRCRAFT).cast(pl.Int64) - 1
    return legs.with_columns(order.alias("flight_number"))


def flag_windows(legs: pl.DataFrame, maintenance: pl.DataFrame, messages: pl.DataFrame) -> pl.DataFrame:
    """Add `near_maintenance` and `near_message` (bool) for flights within the windows above.

    Parameters
    ----------
    legs : DataFrame
        `operator`, `tail`, `pack`, `departed_at`, `flight_number`.
    maintenance : DataFrame
        `operator`, `tail`, `done_on` (Date), `done_at` where the log gives times of day, `pack`, `component`, `action`.
        Inspections alone change nothing and open no window.
    messages : DataFrame
        `operator`, `tail`, `message_time`, `pack`, `code`.
    """
    times = [c for c in ("done_at", "done_on") if c in maintenance.columns]
    work = maintenance.filter(~pl.col("action").is_in(HARMLESS)).select(
        *AIRCRAFT,
        pl.col("pack").cast(pl.Int32),
        pl.coalesce(pl.col(c).cast(pl.Datetime("us", "UTC")) for c in times).alias("at"),
        pl.col("component").alias("kind"),
    )
    warnings = messages.select(
        *AIRCRAFT,
        pl.col("pack").cast(pl.Int32),
        pl.col("message_time").cast(pl.Datetime("us", "UTC")).alias("at"),
        pl.col("code").str.slice(0, 5).alias("kind"),
    )
    rows = _flag(legs, work, AROUND_MAINTENANCE, "near_maintenance")
    return _flag(rows, warnings, AROUND_MESSAGE, "near_message")


def _flag(legs: pl.DataFrame, entries: pl.DataFrame, reach: dict[str, tuple[int, int]], name: str) -> pl.DataFrame:
    """Flag the pack's flights within `reach` (flights before, flights after) of an entry of that kind."""
    spans = pl.DataFrame([(k, *n) for k, n in reach.items()], schema=["kind", "_before", "_after"], orient="row")
    flights = legs.select(*AIRCRAFT, "departed_at", "flight_number").unique().sort("departed_at")
    entry_spans = entries.join(spans, on="kind", validate="m:1").sort("at")
    # the last flight before the entry; an entry during a long pause concerns no flight
    last_flights = entry_spans.join_asof(
        flights, left_on="at", right_on="departed_at", by=AIRCRAFT, tolerance=LONGEST_PAUSE, check_sortedness=False
    ).drop_nulls("flight_number")
    last = pl.col("flight_number")
    span = pl.int_ranges(last - pl.col("_before"), last + pl.col("_after") + 1).alias("flight_number")
    flight_rows = last_flights.select(*AIRCRAFT, "pack", span).explode("flight_number").unique()
    hits = flight_rows.with_columns(pl.lit(True).alias(name))
    rows = legs.join(hits, on=[*PACK, "flight_number"], how="left", maintain_order="left", validate="m:1")
    return rows.with_columns(pl.col(name).fill_null(False))


BLEED = "BLEED"
"""Reason code of such a leg."""
ODD_BLEED = "a printed report of the cruise says that a bleed or a pack was off, or the cross-feed open"
"""Meaning of `BLEED`."""
LONGEST_FLIGHT = "20h"


def odd_bleed(reports: pl.DataFrame) -> pl.Expr:
    """Whether a report from above 15,000 ft shows a bleed or a pack off, or the cross-feed open.

    Below, packs are off for take-off and the APU feeds them on the ground. Missing values count as normal.
    """
    bleed_off = [~pl.col(c) for c in reports.columns if c.startswith("bleed_")]
    pack_off = [pl.col(c) < RUNNING_KG_S for c in reports.columns if c.endswith("_flow_kg_s")]
    odd = pl.any_horizontal(*(e.fill_null(False) for e in (*bleed_off, *pack_off, pl.col("crossfeed_open"))))
    return odd & (pl.col("altitude_m") > CRUISE_FLOOR_M).fill_null(False)


def reject_odd_bleed(legs: pl.DataFrame, reports: pl.DataFrame) -> pl.DataFrame:
    """Reject legs with reason `BLEED` where a report of their flight shows abnormal bleed.

    Parameters
    ----------
    legs : DataFrame
        `LEG`, `departed_at`, `reason`; `admitted` and `n_nominal` follow where present. Both packs of a flight
        are rejected: where one lacks air the other carries its load.
    reports : DataFrame
        Of table `raw_reports`: `operator`, `tail`, `reported_at`, `altitude_m`, bleed and cross-feed valves, pack
        flows.
    """
    odd = reports.filter(odd_bleed(reports)).select(*AIRCRAFT, "reported_at").sort("reported_at")
    if odd.is_empty():
        return legs
    flights = legs.select(*FLIGHT, "departed_at").unique().sort("departed_at")
    odd_flights = odd.join_asof(
        flights, left_on="reported_at", right_on="departed_at", by=AIRCRAFT, tolerance=LONGEST_FLIGHT,
        check_sortedness=False,
    ).drop_nulls("flight_id").select(FLIGHT).unique()  # fmt: skip
    values = {"reason": pl.lit(BLEED), "admitted": pl.lit(False), "n_nominal": pl.lit(0, pl.Int64)}
    return legs.with_columns(
        pl.when(is_among(odd_flights) & (pl.col("reason") == "")).then(value).otherwise(pl.col(c)).alias(c)
        for c, value in values.items()
        if c in legs.columns
    )
