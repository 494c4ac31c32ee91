"""Channels of a flight as the recorder delivers them: not fitted, at a lower rate, or one for both packs.

Each is a property of the record and no fault of a sensor: what it withholds is not missing, and nothing is judged from
what it repeats. Everything here follows from one flight alone.
"""

from math import lgamma, log, pi, sqrt

import numpy as np
import polars as pl

from hdt_core.flight.phases import seconds_between
from hdt_core.flight.quality import LIMITS, READING_SD, RUNNING_KG_S, SIGNALS
from hdt_core.records.keys import FLIGHT, LEG
from hdt_core.records.units import ZERO_CELSIUS_K
from hdt_core.robust import Array

RECORDING = [*LEG, "source"]
NOT_FITTED, LOWER_RATE, ONE_CHANNEL = "not_fitted", "lower_rate", "one_channel"
SCHEMA = {
    **dict.fromkeys(FLIGHT, pl.String), "pack": pl.Int32, "source": pl.String, "signal": pl.String,
    "reason": pl.String, "n_readings": pl.Int64, "delivered_share": pl.Float64,
}  # fmt: skip
NO_CHANNELS = pl.DataFrame(schema=SCHEMA)
MIN_ZEROS = 8
"""Readings below which one value may be chance."""
FLOWS = ("pack_flow_kg_s", "cc_flow_kg_s")
SILENT_WHEN_OFF = (*FLOWS, "cc_speed_rad_s")
WORKING_RATIO = 1.25
"""Pressure ratio above which a compressor is surely at work. [-]"""
AIR_DATA = ("altitude_m", "mach")
"""Signals that are zero on the ground."""
SPAN = ("low", "high")
LEAST_GAPS, MOST_GAPS = 0.1, 0.97
"""Share of empty readings of a channel at a lower rate. [-]"""
LONGEST_PERIOD, MIN_PERIODS = 64, 3
"""Readings after which the pattern of a lower rate repeats (8 Hz against 1/8 Hz), and how often it must be seen."""
STRAY_SHARE = 0.05
"""Share of readings that may depart from the pattern; a sound sensor loses 1 %. [-]"""
PATTERN_CHANCE = 1e-3
"""Chance that as many readings lost at random repeat in a pattern, below which they are the recorder's. [-]"""
OWN_SIGNALS = [s for s in READING_SD if s not in ("tat_k", "total_pressure_pa")]
CHANCE, WEAK_CHANCE = 1e-6, 0.05
"""Chance of equal readings below which it is one channel, and the chance above which a signal is no evidence."""
VARIED = 4
"""Distinct readings that show that a channel is alive."""


def find_channels(records: pl.DataFrame) -> pl.DataFrame:
    """Find channels that are not fitted, that both packs share, and that have a lower rate than their record.

    Parameters
    ----------
    records : DataFrame
        Recorded rows in SI, see `hdt_core.tables.raw`.

    Returns
    -------
    DataFrame
        The columns of `SCHEMA`: `n_readings` are the zeros, equal readings or regular gaps; `delivered_share` is that
        of a lower rate.
    """
    totals = _sum_up(records)
    unfitted = _find_unfitted(records, totals)
    shared = _find_shared(records, totals)
    is_dead = pl.struct(*RECORDING, "signal").is_in(unfitted.select(*RECORDING, "signal").to_struct().implode())
    slower = _find_lower_rates(records, totals.filter(~is_dead) if unfitted.height else totals)
    return pl.concat([unfitted, shared, slower]).sort(*RECORDING, "signal", "reason")


def _sum_up(records: pl.DataFrame) -> pl.DataFrame:
    """Return extremes, sum and number of the readings of each channel: `RECORDING`, `signal`."""
    totals = {"low": pl.Expr.min, "high": pl.Expr.max, "sum": pl.Expr.sum, "n": pl.Expr.count}
    wide = records.group_by(RECORDING).agg(
        pl.len().alias("n_rows"), *(f(pl.col(s)).alias(f"{name}:{s}") for s in SIGNALS for name, f in totals.items())
    )
    parts = [
        wide.select(*RECORDING, "n_rows", pl.lit(s).alias("signal"), *(pl.col(f"{t}:{s}").alias(t) for t in totals))
        for s in SIGNALS
    ]
    return pl.concat(parts)


def null_channels(records: pl.DataFrame, channels: pl.DataFrame) -> pl.DataFrame:
    """Null the readings of channels that are not fitted or that both packs share."""
    bad = channels.filter(pl.col("reason").is_in((NOT_FITTED, ONE_CHANNEL)))
    if bad.is_empty():
        return records
    signals = bad["signal"].unique().to_list()
    flags = bad.group_by(RECORDING).agg((pl.col("signal") == s).any().alias(f"_bad_{s}") for s in signals)
    rows = records.join(flags, on=RECORDING, how="left", maintain_order="left", validate="m:1")
    nulled = (pl.when(~pl.col(f"_bad_{s}").fill_null(False)).then(s).alias(s) for s in signals)
    return rows.with_columns(nulled).select(records.columns)


def count_gaps(channels: pl.DataFrame) -> pl.DataFrame:
    """Count the snapshots of each leg in which a channel at a lower rate has none: `LEG`, `gaps_<signal>`.

    A minute of a continuous log is one sample, whatever the channel's rate.
    """
    slower = channels.filter(source="acms", reason=LOWER_RATE)
    gaps = (pl.col("n_readings").filter(pl.col("signal") == s).sum().alias(f"gaps_{s}") for s in SIGNALS)
    return slower.group_by(LEG).agg(*gaps)


def lost_share(signal: str, n_lost: pl.Expr, n_samples: pl.Expr) -> pl.Expr:
    """Return the share of readings lost, of those that the recorder delivers; see `count_gaps`. [-]"""
    gaps = pl.col(f"gaps_{signal}").fill_null(0)
    return (n_lost - gaps).clip(lower_bound=0) / (n_samples - gaps)


def _as_findings(rows: pl.DataFrame, reason: str) -> pl.DataFrame:
    share = pl.col("delivered_share") if "delivered_share" in rows.columns else pl.lit(None)
    columns = rows.with_columns(pl.lit(reason).alias("reason"), share.alias("delivered_share"))
    return columns.select(pl.col(name).cast(kind) for name, kind in SCHEMA.items())


def _find_unfitted(records: pl.DataFrame, totals: pl.DataFrame) -> pl.DataFrame:
    """Find channels that read zero throughout in the recorder's unit, on every pack of the flight.

    Flow and speed are zero where a pack is off too: they count only while it works.
    """
    zero = pl.when(pl.col("signal").str.ends_with("_k")).then(ZERO_CELSIUS_K).otherwise(0.0)
    is_zero = ((pl.col("low") - zero).abs() + (pl.col("high") - zero).abs() < 1e-6) & (pl.col("n") >= MIN_ZEROS)
    key = [*FLIGHT, "source", "signal"]
    zeros = totals.filter(~pl.col("signal").is_in(AIR_DATA), is_zero)
    if zeros.is_empty():
        return _as_findings(zeros.with_columns(n_readings="n"), NOT_FITTED)
    channels = totals.join(zeros, on=key, how="semi")
    candidates = channels.filter(is_zero.fill_null(False).all().over(key))
    compresses = pl.col("cc_out_pa").median() > WORKING_RATIO * pl.col("cc_in_pa").median()
    flows = pl.max_horizontal(pl.col(s).median() for s in FLOWS) > RUNNING_KG_S
    works = (compresses.fill_null(False) | flows.fill_null(False)).alias("works")
    own_records = records.join(candidates.select(RECORDING).unique(), on=RECORDING, how="semi")
    recordings = own_records.group_by(RECORDING).agg(works)
    rows = candidates.join(recordings, on=RECORDING, how="left", validate="m:1")
    is_off = pl.col("signal").is_in(SILENT_WHEN_OFF) & ~pl.col("works")
    return _as_findings(rows.filter(~is_off).with_columns(n_readings="n"), NOT_FITTED)


def _find_shared(records: pl.DataFrame, totals: pl.DataFrame) -> pl.DataFrame:
    """Find a pack's own signals that equal the other pack's on more readings than their steps explain."""
    flight = [*FLIGHT, "source"]
    own = totals.filter(pl.col("signal").is_in(OWN_SIGNALS), pl.col("n") >= VARIED, pl.col("low") < pl.col("high"))
    pairs = own.filter(pack=1).join(own.filter(pack=2), on=[*flight, "signal"], suffix="_other", validate="1:1")
    same = [(pl.col(c) - pl.col(f"{c}_other")).abs() <= 1e-12 * pl.col(c).abs() for c in ("low", "high", "sum", "n")]
    suspects = pairs.filter(pl.all_horizontal(same)).select(*flight, "signal")
    if suspects.is_empty():
        return _as_findings(suspects.with_columns(pack=1, n_readings=0), ONE_CHANNEL)
    rows = records.join(suspects.select(flight).unique(), on=flight, how="semi")
    readings = rows.unpivot(OWN_SIGNALS, index=[*flight, "pack", "time_utc"], variable_name="signal").drop_nulls()
    readings = readings.join(suspects, on=[*flight, "signal"], how="semi")
    key = [*flight, "signal", "time_utc"]
    both = readings.filter(pack=1).join(readings.filter(pack=2), on=key, suffix="_other", validate="m:m")
    value = pl.col("value")
    alike = both.group_by(*flight, "signal").agg(
        (value == pl.col("value_other")).all().alias("equal"),
        pl.len().alias("n_readings"),
        value.n_unique().alias("n_levels"),
        value.unique().sort().diff().min().alias("step"),
    )
    # two sensors' noise brings both into one step at most so often
    sd = pl.col("signal").replace_strict(READING_SD, return_dtype=pl.Float64)
    ln_chance = pl.col("n_readings") * (pl.col("step") / (2.0 * sqrt(pi) * sd)).clip(upper_bound=1.0).log()
    live = alike.filter("equal", pl.col("n_levels") >= VARIED).with_columns(ln_chance.alias("ln_chance"))
    telling = live.filter(pl.col("ln_chance") < log(WEAK_CHANCE))
    shared = telling.filter(pl.col("ln_chance").sum().over(flight) < log(CHANCE))
    return _as_findings(shared.join(pl.DataFrame({"pack": [1, 2]}), how="cross"), ONE_CHANNEL)


def _find_lower_rates(records: pl.DataFrame, totals: pl.DataFrame) -> pl.DataFrame:
    """Find channels whose empty readings repeat in a pattern, as those of a lower rate do.

    A reading outside the sensor's range is empty too: recorders write -999 or 32,767 for no value.
    """
    span = {name: pl.col("signal").replace_strict({s: v[k] for s, v in LIMITS.items()}) for k, name in enumerate(SPAN)}
    is_outside = (pl.col("low") < span["low"]) | (pl.col("high") > span["high"])
    has_gaps = (1.0 - pl.col("n") / pl.col("n_rows")).is_between(LEAST_GAPS, MOST_GAPS)
    suspects = totals.filter(has_gaps | is_outside).select(*RECORDING, "signal")
    if suspects.is_empty():
        return _as_findings(suspects.with_columns(n_readings=0), LOWER_RATE)
    empty = {s: ~pl.col(s).is_between(*LIMITS[s][:2]).fill_null(False) for s in SIGNALS}
    rows = records.join(suspects.select(RECORDING).unique(), on=RECORDING, how="semi").sort(*RECORDING, "time_utc")
    recordings = rows.with_columns(e.alias(s) for s, e in empty.items()).partition_by(RECORDING, as_dict=True)
    candidates = []
    for *recording, signal in suspects.iter_rows():
        own = recordings[tuple(recording)]
        gaps = regular_gaps(own[signal].to_numpy(), _positions(own))
        if gaps:
            candidates.append((*recording, signal, gaps, 1.0 - gaps / own.height))
    columns = [*RECORDING, "signal", "n_readings", "delivered_share"]
    schema = {name: SCHEMA[name] for name in columns}
    return _as_findings(pl.DataFrame(candidates, schema=schema, orient="row"), LOWER_RATE)


def _positions(recording: pl.DataFrame) -> Array:
    """Number the readings: in order, or of a continuous log by its clock, so that lost rows do not shift a pattern."""
    if recording["source"][0] == "acms":
        return np.arange(recording.height)
    after_s = recording.select(seconds_between(pl.col("time_utc"), pl.col("time_utc").first()))[:, 0].to_numpy()
    interval_s = np.median(np.diff(after_s))
    return np.asarray(np.round(after_s / interval_s), dtype=np.int64)


def regular_gaps(is_empty: Array, position: Array) -> int:
    """Count the empty readings that repeat in a pattern; 0 where there is none.

    Parameters
    ----------
    is_empty : array
        (n,), bool.
    position : array
        (n,). Number of each reading.

    Examples
    --------
    >>> regular_gaps(np.arange(24) % 3 == 2, np.arange(24))
    8
    """
    n = is_empty.size
    for period in range(2, min(LONGEST_PERIOD, n // MIN_PERIODS) + 1):
        place = position % period
        n_place = np.bincount(place, minlength=period)
        n_empty = np.bincount(place, is_empty, minlength=period)
        is_gap = n_empty > 0.5 * n_place
        n_stray = np.where(is_gap, n_place - n_empty, n_empty).sum()
        is_seen = n_empty[is_gap].min(initial=n) >= MIN_PERIODS
        if not (is_gap.any() and is_seen and not is_gap.all() and n_stray <= max(1.0, STRAY_SHARE * n)):
            continue
        # of all ways to leave so many readings empty, those that this period or a shorter one explains
        explained = log(period) + _ln_choices(period, is_gap.sum()) + _ln_choices(n, n_stray)
        if explained - _ln_choices(n, n_empty.sum()) < log(PATTERN_CHANCE):
            return int(n_empty[is_gap].sum())
    return 0


def _ln_choices(n: float, k: float) -> float:
    """Return the logarithm of the number of ways to choose k of n."""
    return lgamma(n + 1.0) - lgamma(k + 1.0) - lgamma(n - k + 1.0)
