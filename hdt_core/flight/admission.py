"""Level two of the nominal-leg filter: log, cross checks, conductance index and, where there is one, the twin.

It uses later flights too, and serves calibration only. A leg rejected here is still monitored.
"""

import json
from dataclasses import asdict, dataclass, field, replace
from itertools import compress

import numpy as np
import polars as pl
from scipy.special import gammaincinv

from hdt_core.flight.conductance_index import (
    IndexLevel,
    Manifold,
    exceeding,
    judge_conductance,
    learn_level,
    learn_manifold,
    leg_conductance,
)
from hdt_core.flight.control_schedules import ControlSchedule, learn_outlet_schedule
from hdt_core.flight.cross_checks import LEG_CHECKS, TWIN_CHECKS, check_sensors, leg_checks
from hdt_core.flight.legs import BLEED, ODD_BLEED, flag_windows, number_flights
from hdt_core.flight.quality import flow_steps
from hdt_core.loading import with_tuples
from hdt_core.records.keys import FLIGHT, LEG, of_each_aircraft
from hdt_core.robust import Z_90
from hdt_core.tables.base import finite

MCD_QUANTILE, MCD_MIN_LEGS = 0.9995, 200
MCD_SUPPORT = 0.75  # of legs that passed all rules, a quarter may still be sick
CONTAMINANT_LOSS = 0.15
LOSSES = {
    "hx_fouling": ("HX_WORN", CONTAMINANT_LOSS),
    "cc_efficiency_loss": ("CC_WORN", CONTAMINANT_LOSS),
    # the pressure rise goes with the square of the effective diameter, equation (5)
    "cc_diameter_loss": ("CC_WORN", 0.5 * CONTAMINANT_LOSS),
}
ENOUGH_SAMPLES = 8
FLOW_CHECKS = ("pack_over_compressor_flow_ln_off", "pack_flow_between_packs_ln_off")
"""Of two flows each: rounding moves them by up to a whole step."""
SECOND_LEVEL = {
    BLEED: ODD_BLEED,
    "MAINTENANCE": "too close to a maintenance action",
    "MESSAGE": "too close to a message of exchanger or compressor",
    "SENSOR_SHIFT": "a sensor left what it is tied to",
    "UNREST": "the exchanger changed within the cruise, as ice does",
    "STRAY": "the leg stands apart from those before and after it",
    "OUTLIER": "far from the nominal fleet in several residuals at once",
    "HX_WORN": "heat exchanger worn",
    "CC_WORN": "compressor worn",
}


@dataclass(frozen=True, slots=True)
class Scatter:
    """Joint scatter of the residuals of nominal legs: `columns`, mean and inverse covariance."""

    columns: tuple[str, ...]
    mean: tuple[float, ...]
    precision: tuple[tuple[float, ...], ...]

    def flag_outliers(self, residuals: pl.DataFrame) -> pl.Series:
        """Flag rows with a squared robust distance above the chi-square quantile. Nulls count as zero."""
        off = residuals.select(pl.col(self.columns).fill_null(0.0)).to_numpy() - np.array(self.mean)
        distance = ((off @ np.array(self.precision)) * off).sum(axis=1)
        quantile = 2.0 * gammaincinv(0.5 * len(self.columns), MCD_QUANTILE)  # chi2.ppf, without all of scipy.stats
        return pl.Series("outlier", distance > quantile)


@dataclass(frozen=True, slots=True)
class NominalBaseline:
    """Laws of a fleet's nominal legs, against which each leg is compared."""

    manifold: Manifold | None = None
    outlet: ControlSchedule | None = None
    level: IndexLevel = field(default_factory=IndexLevel)
    scatter: Scatter | None = None

    def to_json(self) -> str:
        """Return the baseline as JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "NominalBaseline":
        """Read a baseline from JSON."""
        plain = with_tuples(json.loads(text))
        kinds = {"manifold": Manifold, "outlet": ControlSchedule, "level": IndexLevel, "scatter": Scatter}
        return cls(**{name: kind(**plain[name]) for name, kind in kinds.items() if plain[name]})


def leg_indicators(samples: pl.DataFrame, baseline: NominalBaseline) -> pl.DataFrame:
    """Compute indicators leg by leg, each from its own samples: level, unrest, count of the index, means of checks."""

    def indicators(own: pl.DataFrame) -> pl.DataFrame:
        steps = flow_steps(own).select(*FLIGHT, pl.max_horizontal(pl.exclude(FLIGHT)).alias("flow_step_ln"))
        checks = leg_checks(own, baseline.outlet).join(steps, on=FLIGHT, how="left", validate="m:1")
        return checks.join(leg_conductance(own, baseline.manifold), on=LEG, how="full", coalesce=True, validate="m:1")

    return finite(of_each_aircraft(samples, indicators)).sort(LEG)


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
        The logs; entries after a flight count too.
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
        indicators.select(*LEG, "index_level", "index_n", "index_unrest", "index_step"),
        on=LEG,
        how="left",
        validate="m:1",
    )
    rows = flag_windows(flights, maintenance, messages)
    checks = (c for c in (*LEG_CHECKS, *TWIN_CHECKS) if c in indicators.columns)
    sensor_flags = check_sensors(indicators.select(*LEG, *checks), flights)
    index_flags = judge_conductance(levels, maintenance, baseline.level)
    flow_step = indicators.select(*LEG, "flow_step_ln")
    for part in (sensor_flags, index_flags, flow_step, _wear_reasons(health_parameters)):
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
    """Return the deviations of legs that passed all rules, weighted down where few samples make them uncertain.

    What the rounding of a coarse flow makes is none.
    """
    weight = (pl.col("index_n").fill_null(1) / ENOUGH_SAMPLES).clip(upper_bound=1.0).sqrt()
    passed = rows.filter(pl.col("reason") == "")
    beyond = passed.with_columns(exceeding(pl.col(check), "flow_step_ln") for check in FLOW_CHECKS)
    return beyond.with_columns(pl.col("^.*_off$") * weight)


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


def learn_scatter(residuals: pl.DataFrame, columns: list[str]) -> Scatter | None:
    """Estimate the scatter of a nominal fleet by FAST-MCD; None for fewer than 200 legs.

    Parameters
    ----------
    residuals : DataFrame
        One row a leg; `columns` hold residuals with the unit's own level removed. Nulls count as zero.

    References
    ----------
    .. [1] P. J. Rousseeuw, K. Van Driessen, A fast algorithm for the minimum covariance determinant estimator,
       Technometrics 41(3), 1999.
    """
    from sklearn.covariance import MinCovDet  # noqa: PLC0415 (loads for a second, and few nights learn)

    x = residuals.select(pl.col(columns).fill_null(0.0)).to_numpy()
    # a residual that is zero for most legs (not recorded, door at its stop) has no scatter
    moves = (x == 0.0).mean(axis=0) < 0.5 if len(x) else np.zeros(len(columns), dtype=bool)
    if len(x) < MCD_MIN_LEGS or not moves.any():
        return None
    covariance = MinCovDet(support_fraction=MCD_SUPPORT, random_state=0).fit(x[:, moves])
    precision = tuple(map(tuple, covariance.get_precision().tolist()))
    return Scatter(tuple(compress(columns, moves)), tuple(covariance.location_.tolist()), precision)
