"""Features of a pack after a flight: health, residuals, cross checks, usage and weather, in Polars expressions.

Every column of a flight uses that flight and those before it. The unit ends the name.
"""

from collections.abc import Sequence

import polars as pl

from hdt_core.calibration.exchanger import BIAS_SD, NOISE_SD
from hdt_core.margin.first_passage import passages
from hdt_core.margin.margin import compressor_margin, exchanger_margin
from hdt_core.physics.heat_exchanger import mean_specific_heat_j_kg_k, warmed_k
from hdt_core.records.keys import AIRCRAFT, IN_ORDER, LEG, LEG_AT, PACK
from hdt_core.records.unit_index import number_units
from hdt_core.tables.base import DatedLegTable, finite
from hdt_core.tables.features import HEALTH, ExchangerMargin, Features, latest_step
from hdt_core.tracking.sensor_shifts import CORRECTED

SHORT_HORIZONS, WEAR_HORIZON = (10, 30), 100
"""Flights over which trends are taken; the rate of wear follows from the longest."""
DROP, DROP_FLIGHTS = 0.035, 3
"""Fall of a tracked loss over so many flights that no noise makes: a trend before it is that of another state. [-]"""
DOUBT_SDS = 2.0
"""Standard deviations of a loss within which a fall of it is in doubt."""
LOSSES = ("hx_fouling", "hx_life", "cc_diameter_loss", "cc_diameter_loss_sd", "cc_life")
FLIGHT_ESTIMATES = ("ln_ua_ratio", "diameter_m", "expected_diameter_m")
"""Inputs of the margins: tracked losses, and estimates from single flights."""
BALANCE_SIGNALS = ("pack_flow_kg_s", "hx_in_k", "hx_out_k", "ram_flow_kg_s", "tat_k")
RAM_MAP_SD = 0.05
"""Relative uncertainty of the clean duct's flow where no ram outlet probe anchors it: maps err by 4 to 10 %."""


def features(
    health_parameters: pl.DataFrame,
    residuals: pl.DataFrame,
    legs: pl.DataFrame,
    maintenance: pl.DataFrame,
    *,
    twin_flights: pl.DataFrame | None = None,
    cross_checks: pl.DataFrame | None = None,
    demand: pl.DataFrame | None = None,
    health: Sequence[str] = HEALTH,
) -> pl.DataFrame:
    """Compute the features: one row for each flight and pack, one column a feature.

    Parameters
    ----------
    health_parameters, residuals, legs : DataFrame
        As the catalog has them (long form; legs one row a flight and pack).
    maintenance : DataFrame
        operator, tail, pack, done_on, component, action.
    twin_flights : DataFrame, optional
        Estimates from single flights, for the virtual sensors.
    cross_checks : DataFrame, optional
        `sensor_checks.cross_checks(samples)`, whose columns are copied.
    demand : DataFrame, optional
        `exchanger_demand(samples, ...)`, for the margins.
    health : sequence of str, optional
        Health parameters to include; jumps are those of the first, a loss. The part before the first underscore is the
        component's code in the maintenance log, in small letters.

    Returns
    -------
    DataFrame
        The key and `departed_at`, `flight_index` (the tail's flights in order of departure, from 0),
        `flights_since_replacement` (of the first parameter's component; null before the first one logged), health with
        trends, residual means, virtual sensors, differences to the other pack, usage and weather; sorted by tail, pack
        and departure.
    """
    base = _flights(legs, health_parameters)
    wide = base.join(_health(health_parameters, health), on=LEG, how="left", validate="m:1").join(
        _residual_means(residuals), on=LEG, how="left", validate="m:1"
    )
    wide = _join_new(wide, None if twin_flights is None else virtual_sensors(twin_flights))
    wide = _join_new(wide, cross_checks)
    components = list(dict.fromkeys(_component(name) for name in health))
    wide = since_maintenance(wide, maintenance, components)
    if demand is not None and twin_flights is not None:
        wide = wide.join(_margins(wide, twin_flights, demand), on=LEG, how="left", validate="m:1")
    loss, *others = health
    life = [*PACK, f"{_component(loss)}_life"]
    wide = wide.with_columns(_last_drop(loss).over(life).alias("drop"))
    wide = wide.with_columns(pl.int_range(pl.len()).over([*life, "drop"]).alias("flights_since_drop"))
    trends = [*trend(loss, life, SHORT_HORIZONS), *trend(loss, [*life, "drop"], [WEAR_HORIZON])]
    horizons = (*SHORT_HORIZONS, WEAR_HORIZON)
    trends += [e for name in others for e in trend(name, [*PACK, f"{_component(name)}_life"], horizons)]
    wide = wide.with_columns(trends).drop("drop").with_columns(_jumps(wide.columns, health[0]))
    if demand is not None and "hx_ln_ua_ratio" in wide.columns:
        wide = wide.join(passages(wide, demand), on=LEG, how="left", validate="m:1")
    lives = [f"{component}_life" for component in components]
    in_order = wide.sort("tail", "pack", "departed_at", "flight_id")
    return finite(Features.derive(in_order).drop(lives))


def _component(parameter: str) -> str:
    """Return the code of a health parameter's component, in small letters."""
    return parameter.partition("_")[0]


def _flights(legs: pl.DataFrame, health_parameters: pl.DataFrame) -> pl.DataFrame:
    """Return every flight and pack of either table, numbered by departure within its tail."""
    frames = [f.select(LEG_AT) for f in (legs, health_parameters) if f.height]
    rows = pl.concat([DatedLegTable.create_empty(), *frames]).unique(LEG, keep="first")
    order = pl.struct("departed_at", "flight_id").rank("dense").over(AIRCRAFT)
    rows = rows.with_columns((order.cast(pl.Int64) - 1).alias("flight_index"))
    return rows.sort(*AIRCRAFT, "departed_at", "flight_id", "pack")


def _health(long: pl.DataFrame, health: Sequence[str]) -> pl.DataFrame:
    rows = long.filter(pl.col("parameter").is_in(health))
    columns = [
        pl.col(c).filter(pl.col("parameter") == p).last().alias(p + end)
        for p in health
        for c, end in (("value", ""), ("sd", "_sd"), ("status", "_status"))
    ]
    return rows.group_by(LEG).agg(columns)


def _residual_means(long: pl.DataFrame) -> pl.DataFrame:
    """Return the mean residual of every signal and kind: `<signal without its unit>_<kind>_<unit>`."""
    pairs = long.select("signal", "kind").unique().sort("signal", "kind").rows()
    columns = [
        pl.col("mean").filter((pl.col("signal") == s) & (pl.col("kind") == k)).last().alias(residual_column(s, k))
        for s, k in pairs
    ]
    return long.group_by(LEG).agg(columns)


def residual_column(signal: str, kind: str) -> str:
    """Return the feature name of a residual.

    Examples
    --------
    >>> residual_column("hx_out_k", "sensor_minus_dsm")
    'hx_out_sensor_minus_dsm_k'
    """
    for unit in ("kg_s", "rad_s", "w_k", "counts", "pa", "k", "m"):
        if signal.endswith(f"_{unit}"):
            return f"{signal.removesuffix(f'_{unit}')}_{kind}_{unit}"
    return f"{signal}_{kind}"


def _join_new(wide: pl.DataFrame, more: pl.DataFrame | None) -> pl.DataFrame:
    """Left join the columns that `wide` lacks."""
    if more is None:
        return wide
    return wide.join(
        more.select(*LEG, *(c for c in more.columns if c not in wide.columns)), on=LEG, how="left", validate="m:1"
    )


def _margins(wide: pl.DataFrame, twin_flights: pl.DataFrame, demand: pl.DataFrame) -> pl.DataFrame:
    """Return the margin columns of each flight; rows of `wide` are in order of departure."""
    inputs = wide.select(*LEG, *LOSSES).join(
        twin_flights.select(*LEG, *FLIGHT_ESTIMATES), on=LEG, how="left", maintain_order="left", validate="m:1"
    )
    names = pl.selectors.by_name(*LEG, *ExchangerMargin.columns(), require_all=False)
    margins = exchanger_margin(inputs, demand).select(names)
    return margins.join(compressor_margin(inputs, demand), on=LEG, how="left", validate="m:1")


def since_maintenance(
    flights: pl.DataFrame, maintenance: pl.DataFrame, components: Sequence[str] = ("hx", "cc")
) -> pl.DataFrame:
    """Add `<component>_life`, the replacements so far in the log, and the flights since the first component's last one.

    The age of a unit fitted before the record's first flight is unknown.
    """
    rows = flights
    for component in components:
        rows = number_units(rows, maintenance, component.upper(), f"{component}_life")
    rows = rows.sort(IN_ORDER)
    lead = f"{components[0]}_life"
    age = pl.int_range(pl.len()).over([*PACK, lead])
    return rows.with_columns(
        pl.when(pl.col(lead) > pl.col(lead).first().over(PACK)).then(age).alias("flights_since_replacement"),
        age.alias("flights_seen_of_unit"),
    )


def _last_drop(loss: str) -> pl.Expr:
    """Return the flight index of the last drop of a loss, null before the first: a wash, or work that is on no log.

    A fall that the loss's own standard deviation does not exclude is none: one faulty reading makes such a fall.
    """
    fall = pl.col(loss).shift(DROP_FLIGHTS) - pl.col(loss)
    doubt = DOUBT_SDS * pl.col(f"{loss}_sd").fill_null(0.0)
    is_drop = (fall > DROP) & (fall > doubt)
    return pl.when(is_drop).then("flight_index").forward_fill()


def trend(name: str, by: Sequence[str], horizons: Sequence[int]) -> list[pl.Expr]:
    """Return least-squares slopes per flight over the last flights of a group, by horizon; null below four values."""
    index = pl.when(pl.col(name).is_not_null()).then(pl.col("flight_index").cast(pl.Float64))
    x = index - index.mean().over(by)  # keeps the sums of squares well conditioned
    y = pl.col(name)

    def mean(e: pl.Expr, n: int) -> pl.Expr:
        return e.rolling_mean(n, min_samples=4)

    slopes = [(mean(x * y, n) - mean(x, n) * mean(y, n)) / (mean(x * x, n) - mean(x, n) ** 2) for n in horizons]
    return [
        s.fill_nan(None).over(by).alias(f"{name}_slope_{n}_per_flight") for s, n in zip(slopes, horizons, strict=True)
    ]


def _jumps(columns: Sequence[str], loss: str) -> list[pl.Expr]:
    """Return recent changes of the loss: the track over ten flights; three flights less the twelve before and trend."""
    life = [*PACK, f"{_component(loss)}_life"]
    track = pl.col(loss)
    now = track
    if f"{loss}_flight" in columns:
        is_corrected = (pl.col(f"{loss}_status") == CORRECTED).fill_null(False)
        now = pl.when(~is_corrected).then(f"{loss}_flight")
    # the middles of the two windows lie eight flights apart; the trend is that of the flights before the late ones
    wear = 8.0 * pl.col(f"{loss}_slope_30_per_flight").shift(3).clip(0.0, 0.004).fill_null(0.0)
    jumps = {f"{loss}_jump_10": track - track.shift(10), f"{loss}_step_3": latest_step(now) - wear}
    return [jump.over(life).alias(name) for name, jump in jumps.items()]


def virtual_sensors(twin_flights: pl.DataFrame) -> pl.DataFrame:
    """Compute the quantities of each flight and pack from the twin's estimates of that flight.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights`: ln conductance ratio, flows and medians of the cruise.

    Returns
    -------
    DataFrame
        The key and, each with an `_sd` column of the same unit: `ram_flow_kg_s` (of the clean duct), `ram_outlet_k`,
        `effectiveness`, `ua_w_k`, `ram_flow_loss` (loss of the clean duct's flow by the heat balance; null
        without a ram outlet probe); and `hx_fouling_flight` (1 less measured over expected conductance, undamped, with
        its unit's offset), `cc_diameter_deficit` (deficit to the diameter of equation (6)). Cross
        checks that need the model: `w_hx_in_over_discharge_k`, or `w_hx_in_over_pressure_k` where the discharge
        temperature is not recorded, and `w_conductance_off_cruise_ln`.
    """
    flow, hot_in_k, hot_out_k, ram_flow, tat_k = (twin_flights[c].cast(pl.Float64).to_numpy() for c in BALANCE_SIGNALS)
    heat_j_kg = flow * mean_specific_heat_j_kg_k(hot_in_k, hot_out_k) * (hot_in_k - hot_out_k) / ram_flow
    rise_k = pl.Series(warmed_k(tat_k, heat_j_kg) - tat_k)
    drop_k = pl.col("hx_in_k") - pl.col("tat_k")
    ratio = pl.col("ln_ua_ratio").exp()
    has_efficiency = pl.col("efficiency").is_not_null()
    ua_sd = (pl.col("ln_ua_ratio_sd") ** 2 + pl.col("ln_ua_ratio_map_sd") ** 2).sqrt()
    reading_sd = (NOISE_SD["hx_out_k"] ** 2 / pl.col("n_samples").clip(1) + BIAS_SD["hx_out_k"] ** 2).sqrt()
    return twin_flights.select(
        *LEG,
        "ram_flow_kg_s",
        (RAM_MAP_SD * pl.col("ram_flow_kg_s")).alias("ram_flow_kg_s_sd"),
        (pl.col("tat_k") + rise_k).alias("ram_outlet_k"),
        pl.Series("ram_outlet_k_sd", (RAM_MAP_SD * rise_k).abs()),
        "effectiveness",
        (reading_sd / drop_k).alias("effectiveness_sd"),
        "ua_w_k",
        (ua_sd * pl.col("ua_w_k")).alias("ua_w_k_sd"),
        (1.0 - pl.col("ln_ram_ratio").exp()).alias("ram_flow_loss"),
        (pl.col("ln_ram_ratio_sd") * pl.col("ln_ram_ratio").exp()).alias("ram_flow_loss_sd"),
        (1.0 - ratio).alias("hx_fouling_flight"),
        (pl.col("ln_ua_ratio_sd") * ratio).alias("hx_fouling_flight_sd"),
        (1.0 - pl.col("diameter_m") / pl.col("expected_diameter_m")).alias("cc_diameter_deficit"),
        (pl.col("diameter_m_se") / pl.col("expected_diameter_m")).alias("cc_diameter_deficit_sd"),
        pl.when(has_efficiency).then("inlet_apart_k").alias("w_hx_in_over_discharge_k"),
        pl.when(~has_efficiency).then("inlet_apart_k").alias("w_hx_in_over_pressure_k"),
        pl.col("door_apart_ln").alias("w_conductance_off_cruise_ln"),
    ).with_columns(pl.selectors.float().fill_nan(None))
