"""The final verdict on every leg: rules, log, cross checks, manifold and, where there is one, the twin.

With hindsight, for calibration only. A leg turned away here is still monitored.
"""

from dataclasses import replace

import polars as pl

from hdt_core.flight.bleed import BLEED, ODD_BLEED
from hdt_core.flight.cross_checks import LEG_CHECKS, TWIN_CHECKS, check_sensors, learn_outlet_law
from hdt_core.flight.manifold import learn_manifold
from hdt_core.flight.nominal import Scatter, judge_conductance, learn_level, learn_scatter
from hdt_core.flight.nominal_baseline import NominalBaseline, leg_indicators
from hdt_core.flight.phases import LEG_KEY
from hdt_core.flight.windows import flag_windows, number_flights
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
    """Learn from a fleet, sick legs among it; parameters as for `admit`."""
    numbered = number_flights(legs.drop("flight_number", strict=False))
    laws = NominalBaseline(learn_manifold(samples, numbered), learn_outlet_law(samples))
    signs = leg_indicators(samples, laws)
    laws = replace(laws, level=learn_level(numbered.join(signs, on=LEG_KEY, how="left", validate="m:1"), maintenance))
    passed = _residuals(_judged(numbered, signs, maintenance, messages, laws, None))
    return replace(laws, scatter=learn_scatter(passed, [c for c in passed.columns if c.endswith("_off")]))


def admit(
    legs: pl.DataFrame,
    samples: pl.DataFrame,
    maintenance: pl.DataFrame,
    messages: pl.DataFrame,
    health_parameters: pl.DataFrame | None = None,
) -> pl.DataFrame:
    """Add to level one's verdicts what the log, the fleet and the twin know; the fleet's norm is learned here.

    Parameters
    ----------
    legs, samples : DataFrame
        Of `judge_legs`, whole histories of a fleet.
    maintenance, messages : DataFrame
        The logs, as `judge_legs` takes them.
    health_parameters : DataFrame, optional
        The twin's losses with their standard deviations. Without it, before a first calibration, wear is judged from
        the recorded signals alone.

    Returns
    -------
    DataFrame
        `legs` with `admitted`, `reason` and `n_nominal` (zero where not admitted) renewed; no leg is dropped.
    """
    baseline = learn_baseline(legs, samples, maintenance, messages)
    return admit_by(baseline, legs, leg_indicators(samples, baseline), maintenance, messages, health_parameters)


def admit_by(
    baseline: NominalBaseline,
    legs: pl.DataFrame,
    signs: pl.DataFrame,
    maintenance: pl.DataFrame,
    messages: pl.DataFrame,
    health_parameters: pl.DataFrame | None = None,
    twin_flights: pl.DataFrame | None = None,
) -> pl.DataFrame:
    """`admit` by a baseline learned before; no tail sways another.

    `signs` are of `leg_indicators`, all flights of each tail; `twin_flights` of the twin with its `TWIN_CHECKS`.
    """
    numbered = number_flights(legs.drop("flight_number", strict=False))
    if twin_flights is not None:
        signs = signs.join(
            twin_flights.select(*LEG_KEY, *TWIN_CHECKS), on=LEG_KEY, how="left", maintain_order="left", validate="m:1"
        )
    known = _judged(numbered, signs, maintenance, messages, baseline, health_parameters)
    return _without_outliers(known, baseline.scatter).select(legs.columns)


def _judged(
    numbered: pl.DataFrame,
    signs: pl.DataFrame,
    maintenance: pl.DataFrame,
    messages: pl.DataFrame,
    baseline: NominalBaseline,
    health_parameters: pl.DataFrame | None,
) -> pl.DataFrame:
    """Every rule but the last."""
    levels = numbered.join(
        signs.select(*LEG_KEY, "index_level", "index_n", "index_unrest"), on=LEG_KEY, how="left", validate="m:1"
    )
    known = flag_windows(numbered, maintenance, messages)
    checks = (c for c in (*LEG_CHECKS, *TWIN_CHECKS) if c in signs.columns)
    checked = check_sensors(signs.select(*LEG_KEY, *checks), numbered)
    for part in (checked, judge_conductance(levels, maintenance, baseline.level), _wear(health_parameters)):
        known = known.join(
            part, on=[c for c in LEG_KEY if c in part.columns], how="left", maintain_order="left", validate="m:1"
        )
    return _give_reasons(known)


def _wear(health_parameters: pl.DataFrame | None) -> pl.DataFrame:
    """The twin's word on each leg: `wear`, a reason code or null, and whether it has `seen` the exchanger."""
    schema = {**dict.fromkeys(LEG_KEY, pl.String), "pack": pl.Int32, "wear": pl.String, "seen": pl.Boolean}
    if health_parameters is None or health_parameters.is_empty():
        return pl.DataFrame(schema=schema)
    limits = pl.DataFrame(
        {"parameter": list(LOSSES), "code": [c for c, _ in LOSSES.values()], "limit": [v for _, v in LOSSES.values()]}
    )
    judged = health_parameters.filter(pl.col("value").is_not_null()).join(limits, on="parameter", validate="m:1")
    # the chance that a leg's loss is above the limit must be below 5 %: at 1 % a young pack, whose loss is not yet
    # known well, would hardly ever be nominal
    over = pl.col("value") + Z_90 * pl.col("sd").fill_null(0.0) > pl.col("limit")
    worst = pl.col("code").filter(over).max()  # the exchanger speaks first
    return judged.group_by(LEG_KEY).agg(worst.alias("wear"), (pl.col("code") == "HX_WORN").any().alias("seen"))


def _give_reasons(known: pl.DataFrame) -> pl.DataFrame:
    """Replace an empty `reason` by the first of the second level's rules that is broken."""
    own = pl.when(pl.col("reason") != "").then(pl.col("reason"))
    rules = {
        "MAINTENANCE": pl.col("near_maintenance"),
        "MESSAGE": pl.col("near_message"),
        "SENSOR_SHIFT": pl.col("sensor_shift"),
        "UNREST": pl.col("unrest"),
        "STRAY": pl.col("stray"),
        # the index takes a unit's best flights for its clean state and knows new units by the log alone
        "HX_WORN": pl.col("worn") & ~pl.col("seen").fill_null(False),
    }
    broken = [pl.when(rule.fill_null(False)).then(pl.lit(code)) for code, rule in rules.items()]
    return known.with_columns(pl.coalesce(own, *broken, "wear", pl.lit("")).alias("reason"))


def _residuals(known: pl.DataFrame) -> pl.DataFrame:
    """Deviations of legs that passed all rules; a leg of few samples deviates by chance, and is weighted as its mean
    deserves."""
    weight = (pl.col("index_n").fill_null(1) / ENOUGH_SAMPLES).clip(upper_bound=1.0).sqrt()
    return known.filter(pl.col("reason") == "").with_columns(pl.col("^.*_off$") * weight)


def _without_outliers(known: pl.DataFrame, scatter: Scatter | None) -> pl.DataFrame:
    """The last screen, among legs that passed all others: a leg's deviations together, against the fleet's."""
    passed = _residuals(known)
    found = passed.select(LEG_KEY).with_columns(scatter.outlying(passed) if scatter else pl.lit(False).alias("outlier"))
    joined = known.join(found, on=LEG_KEY, how="left", maintain_order="left", validate="m:1")
    reason = pl.when(pl.col("outlier").fill_null(False)).then(pl.lit("OUTLIER")).otherwise("reason")
    final = joined.with_columns(reason.alias("reason")).with_columns((pl.col("reason") == "").alias("admitted"))
    return final.with_columns(pl.when("admitted").then("n_nominal").otherwise(0).alias("n_nominal"))


def yields(legs: pl.DataFrame) -> pl.DataFrame:
    """Share of legs admitted by operator, tail and month of departure, so that a filter that hides a season is seen."""
    grouped = legs.group_by("operator", "tail", pl.col("departed_at").dt.truncate("1mo").dt.date().alias("month"))
    counted = grouped.agg(pl.len().alias("n_legs"), pl.col("admitted").sum().alias("n_admitted"))
    return counted.with_columns((pl.col("n_admitted") / pl.col("n_legs")).alias("yield")).sort(
        "operator", "tail", "month"
    )
