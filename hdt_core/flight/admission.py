"""Level two of the nominal-leg filter: log, cross checks, manifold and, where there is one, the twin.

It uses later flights too, and serves calibration only. A leg rejected here is still monitored.
"""

from dataclasses import replace

import polars as pl

from hdt_core.flight.bleed import BLEED, ODD_BLEED
from hdt_core.flight.control_schedule import learn_outlet_schedule
from hdt_core.flight.cross_checks import LEG_CHECKS, TWIN_CHECKS, check_sensors
from hdt_core.flight.manifold import learn_manifold
from hdt_core.flight.nominal import Scatter, judge_conductance, learn_level, learn_scatter
from hdt_core.flight.nominal_baseline import NominalBaseline, leg_indicators
from hdt_core.flight.windows import flag_windows, number_flights
from hdt_core.records.keys import LEG
from hdt_core.robust import Z_90

CONTAMINANT_LOSS = 0.15
LOSSES = {
    "hx_fouling": ("HX_WORN", CONTAMINANT_LOSS),
    "cc_efficiency_loss": ("CC_WORN", CONTAMINANT_LOSS),
    # the pressure rise goes with the square of the effective diameter, equation (5)
    "cc_diameter_loss": ("CC_WORN", 0.5 * CONTAMINANT_LOSS),
}
ENOUGH_SAMPLES = 8
SECOND_LEVEL = {
    BLEED: ODD_BLEED,
    "SENSOR_SHIFT": "a sensor left what it is tied to",
    "UNREST": "the exchanger changed within the cruise, as ice does",
    "STRAY": "the leg stands apart from those before and after it",
    "OUTLIER": "far from the nominal fleet in several residuals at once",
    "HX_WORN": "heat exchanger worn",
    "CC_WORN": "compressor worn",
}


def learn_baseline(
    legs: pl.DataFrame, samples: pl.DataFrame, maintenance: pl.DataFrame, messages: pl.DataFrame
) -> NominalBaseline:
    """Learn the nominal baseline of a fleet that may contain sick legs, from its whole history and logs."""
    flights = number_flights(legs.drop("flight_number", strict=False))
    baseline = NominalBaseline(learn_manifold(samples, flights), learn_outlet_schedule(samples))
    indicators = leg_indicators(samples, baseline)
    baseline = replace(
        baseline, level=learn_level(flights.join(indicators, on=LEG, how="left", validate="m:1"), maintenance)
    )
    residuals = _residuals(_apply_rules(flights, indicators, maintenance, messages, baseline, None))
    return replace(baseline, scatter=learn_scatter(residuals, [c for c in residuals.columns if c.endswith("_off")]))


def admit(
    baseline: NominalBaseline,
    legs: pl.DataFrame,
    indicators: pl.DataFrame,
    maintenance: pl.DataFrame,
    messages: pl.DataFrame,
    health_parameters: pl.DataFrame | None = None,
    twin_flights: pl.DataFrame | None = None,
) -> pl.DataFrame:
    """Reject further legs by log, fleet and twin; tails are independent of each other.

    Parameters
    ----------
    baseline : NominalBaseline
        Of `learn_baseline`.
    legs : DataFrame
        Of `judge_legs`.
    indicators : DataFrame
        Of `leg_indicators`, all flights of each tail.
    maintenance, messages : DataFrame
        The logs, as `judge_legs` takes them.
    health_parameters : DataFrame, optional
        The twin's losses with their standard deviations. Without it, before a first calibration, wear is detected
        from the recorded signals alone.
    twin_flights : DataFrame, optional
        Of the twin, with its `TWIN_CHECKS`.

    Returns
    -------
    DataFrame
        `legs` with `admitted`, `reason` and `n_nominal` (zero where not admitted) updated; no leg is dropped.
    """
    flights = number_flights(legs.drop("flight_number", strict=False))
    if twin_flights is not None:
        indicators = indicators.join(
            twin_flights.select(*LEG, *TWIN_CHECKS), on=LEG, how="left", maintain_order="left", validate="m:1"
        )
    rows = _apply_rules(flights, indicators, maintenance, messages, baseline, health_parameters)
    return _without_outliers(rows, baseline.scatter).select(legs.columns)


def _apply_rules(
    flights: pl.DataFrame,
    indicators: pl.DataFrame,
    maintenance: pl.DataFrame,
    messages: pl.DataFrame,
    baseline: NominalBaseline,
    health_parameters: pl.DataFrame | None,
) -> pl.DataFrame:
    """Apply every rule but that of outliers."""
    levels = flights.join(
        indicators.select(*LEG, "index_level", "index_n", "index_unrest"), on=LEG, how="left", validate="m:1"
    )
    rows = flag_windows(flights, maintenance, messages)
    checks = (c for c in (*LEG_CHECKS, *TWIN_CHECKS) if c in indicators.columns)
    sensor_flags = check_sensors(indicators.select(*LEG, *checks), flights)
    index_flags = judge_conductance(levels, maintenance, baseline.level)
    for part in (sensor_flags, index_flags, _wear_reasons(health_parameters)):
        rows = rows.join(
            part, on=[c for c in LEG if c in part.columns], how="left", maintain_order="left", validate="m:1"
        )
    return _give_reasons(rows)


def _wear_reasons(health_parameters: pl.DataFrame | None) -> pl.DataFrame:
    """Return `wear`, a reason code or null, by the twin, and whether it `has_estimate` of the exchanger."""
    schema = {**dict.fromkeys(LEG, pl.String), "pack": pl.Int32, "wear": pl.String, "has_estimate": pl.Boolean}
    if health_parameters is None or health_parameters.is_empty():
        return pl.DataFrame(schema=schema)
    limits = pl.DataFrame(
        {"parameter": list(LOSSES), "code": [c for c, _ in LOSSES.values()], "limit": [v for _, v in LOSSES.values()]}
    )
    losses = health_parameters.filter(pl.col("value").is_not_null()).join(limits, on="parameter", validate="m:1")
    # the probability that a leg's loss exceeds the limit must be below 5 %: at 1 % a young pack, whose loss is still
    # uncertain, would hardly ever be nominal
    over = pl.col("value") + Z_90 * pl.col("sd").fill_null(0.0) > pl.col("limit")
    worst = pl.col("code").filter(over).max()  # the exchanger's code takes precedence
    return losses.group_by(LEG).agg(worst.alias("wear"), (pl.col("code") == "HX_WORN").any().alias("has_estimate"))


def _give_reasons(rows: pl.DataFrame) -> pl.DataFrame:
    """Replace an empty `reason` by the first rule of level two that is broken."""
    level_one = pl.when(pl.col("reason") != "").then(pl.col("reason"))
    rules = {
        "MAINTENANCE": pl.col("near_maintenance"),
        "MESSAGE": pl.col("near_message"),
        "SENSOR_SHIFT": pl.col("sensor_shift"),
        "UNREST": pl.col("unrest"),
        "STRAY": pl.col("stray"),
        # the index takes a unit's best flights for its clean state and new units from the log alone
        "HX_WORN": pl.col("worn") & ~pl.col("has_estimate").fill_null(False),
    }
    reasons = [pl.when(rule.fill_null(False)).then(pl.lit(code)) for code, rule in rules.items()]
    return rows.with_columns(pl.coalesce(level_one, *reasons, "wear", pl.lit("")).alias("reason"))


def _residuals(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the deviations of legs that passed all rules, weighted down where few samples make them uncertain."""
    weight = (pl.col("index_n").fill_null(1) / ENOUGH_SAMPLES).clip(upper_bound=1.0).sqrt()
    return rows.filter(pl.col("reason") == "").with_columns(pl.col("^.*_off$") * weight)


def _without_outliers(rows: pl.DataFrame, scatter: Scatter | None) -> pl.DataFrame:
    """Reject outliers in the joint deviations among legs that passed all other rules."""
    residuals = _residuals(rows)
    outliers = residuals.select(LEG).with_columns(
        scatter.flag_outliers(residuals) if scatter else pl.lit(False).alias("outlier")
    )
    flags = rows.join(outliers, on=LEG, how="left", maintain_order="left", validate="m:1")
    reason = pl.when(pl.col("outlier").fill_null(False)).then(pl.lit("OUTLIER")).otherwise("reason")
    verdicts = flags.with_columns(reason.alias("reason")).with_columns((pl.col("reason") == "").alias("admitted"))
    return verdicts.with_columns(pl.when("admitted").then("n_nominal").otherwise(0).alias("n_nominal"))
