"""Level one of the nominal-leg filter: rules for every flight and pack, each rejection with its reason."""

import polars as pl

from hdt_core.flight.phases import add_phases, number_legs, seconds_between
from hdt_core.flight.quality import SIGNALS, null_bad_values
from hdt_core.flight.steady import average_log, steady_snapshots
from hdt_core.flight.windows import flag_windows, number_flights
from hdt_core.records.keys import FLIGHT, LEG

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
RUNNING_KG_S = 0.2  # flow below which a pack is off
DOOR_STILL, DOOR_STILL_ROWS, DOOR_STILL_RISE_M = 0.035, 8, 4_000.0  # a door still through a climb is jammed
ICING_TAT_K = (268.15, 283.15)  # -5 to +10 degC: water may be supercooled and freeze on the core
ICING_BELOW_M = 6_700.0  # 22,000 ft: icing clouds

REASONS = {
    "NO_CRUISE": "no steady cruise: nothing to calibrate on",
    "PACK_OFF": "the pack was off",
    "OTHER_PACK_OFF": "the other pack was off, this one carried the load of both",
    "SENSOR_MISSING": "a fitted sensor dropped out",
    "SENSOR_FROZEN": "a sensor repeated one reading where it must have moved",
    "DOOR_STILL": "the ram air door stood still through climb or descent",
    "ICING": "most of the cruise in icing conditions",
    "MAINTENANCE": "too close to a maintenance action",
    "MESSAGE": "too close to a message of exchanger or compressor",
}


def judge_legs(
    snapshots: pl.DataFrame, maintenance: pl.DataFrame, messages: pl.DataFrame
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Apply the rules to every flight and pack, and prepare its samples.

    Parameters
    ----------
    snapshots : DataFrame
        Recorded rows of both kinds, see `hdt_core.tables`; `source` is `acms` (snapshots) or `cpl` (1 Hz).
    maintenance, messages : DataFrame
        Entries after a flight count too; `samples.monitored` depends on neither.

    Returns
    -------
    legs : DataFrame
        One row for each flight and pack of `snapshots`: `admitted` and `reason` (a key of `REASONS`, empty when
        admitted).
    samples : DataFrame
        One row for each snapshot and each averaged minute of a 1 Hz log, bad values nulled, with `phase`, `monitored`
        (steady cruise, complete, sick or not), `nominal` (monitored, in an admitted leg, no icing) and `n_averaged`.
    """
    samples = prepare_samples(snapshots)
    legs = _give_reasons(flag_windows(number_flights(_summarise(samples)), maintenance, messages))
    rows = samples.join(legs.select(*LEG, "admitted"), on=LEG, how="left", maintain_order="left", validate="m:1")
    nominal = pl.col("monitored") & pl.col("admitted") & ~pl.col("icing")
    return legs, rows.with_columns(nominal.alias("nominal")).drop("admitted")


def prepare_samples(snapshots: pl.DataFrame) -> pl.DataFrame:
    """Screen values, add phases, average logs; `monitored` where a sample is steady cruise and complete."""
    ordered = number_legs(snapshots.sort(*RECORD_KEY, "time_utc", maintain_order=True), RECORD_KEY)
    is_repeat = (pl.col("_leg") == pl.col("_leg").shift(1)) & (pl.col("time_utc") == pl.col("time_utc").shift(1))
    first = pl.col("time_utc").min().over(FLIGHT)
    records = ordered.filter(~is_repeat.fill_null(False)).drop("_leg").with_columns(first.alias("departed_at"))
    phases = add_phases(null_bad_values(records, by=RECORD_KEY), by=RECORD_KEY)
    reports = steady_snapshots(phases.filter(pl.col("source") == "acms"), by=RECORD_KEY).with_columns(
        pl.lit(1, pl.Int64).alias("n_averaged")
    )
    log = average_log(phases.filter(pl.col("source") == "cpl"), by=RECORD_KEY)
    rows = pl.concat([reports.drop("phase_code"), log], how="diagonal").sort(*LEG, "time_utc", "source")
    complete = pl.all_horizontal(pl.col(s).is_not_null() for s in MODEL_SIGNALS)
    running = pl.col("pack_flow_kg_s") > RUNNING_KG_S
    icing = pl.col("tat_k").is_between(*ICING_TAT_K) & (pl.col("altitude_m") < ICING_BELOW_M)
    return rows.with_columns(
        ((pl.col("phase") == "cruise") & pl.col("steady") & complete & running).fill_null(False).alias("monitored"),
        icing.fill_null(False).alias("icing"),
    )


def _summarise(samples: pl.DataFrame) -> pl.DataFrame:
    """Summarise each flight and pack in the quantities of the rules."""
    cruise = pl.col("phase") == "cruise"
    cruise_s = seconds_between(pl.col("time_utc").filter(cruise).max(), pl.col("time_utc").filter(cruise).min())
    legs = samples.group_by(LEG).agg(
        pl.col("departed_at").first(),
        pl.col("time_utc").max().alias("landed_at"),
        pl.when(pl.col("source").n_unique() > 1)
        .then(pl.lit("both"))
        .otherwise(pl.col("source").first())
        .alias("source"),
        pl.len().alias("n_samples"),
        (pl.col("source") == "acms").sum().alias("n_snapshots"),
        pl.col("monitored").sum().alias("n_monitored"),
        (pl.col("monitored") & ~pl.col("icing")).sum().alias("n_nominal"),
        (cruise_s.fill_null(0.0) / 60.0).alias("cruise_minutes"),
        pl.col("n_frozen").sum(),
        pl.col("pack_flow_kg_s").median().alias("_flow"),
        (pl.col("ram_door_open").quantile(0.95) - pl.col("ram_door_open").quantile(0.05)).alias("_door_span"),
        (pl.col("altitude_m").max() - pl.col("altitude_m").min()).alias("_rise_m"),
        *(pl.col(s).null_count().alias(f"_missing_{s}") for s in SIGNALS),
    )
    flights = legs.with_columns(pl.col("landed_at").max().over(FLIGHT))
    return flights.with_columns(pl.col("^n_.*$").cast(pl.Int64)).sort(*LEG)


def _give_reasons(legs: pl.DataFrame) -> pl.DataFrame:
    """Add `reason`, the first rule broken, and `admitted`."""
    rules = {
        "PACK_OFF": _is_off(pl.col("_flow")),
        "OTHER_PACK_OFF": _is_off(pl.col("_flow")).any().over(FLIGHT),
        "SENSOR_FROZEN": pl.col("n_frozen") > 0,
        "DOOR_STILL": (pl.col("_door_span") < DOOR_STILL)
        & (pl.col("n_samples") >= DOOR_STILL_ROWS)
        & (pl.col("_rise_m") > DOOR_STILL_RISE_M),
        "SENSOR_MISSING": pl.any_horizontal(_dropped_out(s) for s in SIGNALS),
        "ICING": (pl.col("n_monitored") >= MIN_NOMINAL) & (pl.col("n_nominal") < MIN_NOMINAL),
        "NO_CRUISE": pl.col("n_nominal") < MIN_NOMINAL,
        "MAINTENANCE": pl.col("near_maintenance"),
        "MESSAGE": pl.col("near_message"),
    }
    first = pl.coalesce(*(pl.when(rule).then(pl.lit(code)) for code, rule in rules.items()), pl.lit(""))
    rows = legs.with_columns(first.alias("reason")).with_columns((pl.col("reason") == "").alias("admitted"))
    return rows.drop(
        "_flow", "_door_span", "_rise_m", *(f"_missing_{s}" for s in SIGNALS), "near_maintenance", "near_message"
    )


def _is_off(flow: pl.Expr) -> pl.Expr:
    return (flow < RUNNING_KG_S).fill_null(False)


def _dropped_out(signal: str) -> pl.Expr:
    """Flag far more gaps than a fitted sensor has; a signal missing on both packs of the flight is not fitted."""
    missing = pl.col(f"_missing_{signal}")
    share = missing / pl.col("n_samples")
    is_fitted = (share < 1.0).any().over(FLIGHT)
    return is_fitted & (missing >= DROPOUT_ROWS) & (share > DROPOUT_SHARE)
