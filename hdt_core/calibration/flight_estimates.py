"""Estimate each pack from one flight alone: maximum likelihood for all flights at once, in closed form per sample.

A part that names another method than the default is estimated by that one: see `flights_by_method`.
"""

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import complete_air_data, correct_inputs, cruise_samples, flights_of
from hdt_core.calibration.component_fit import has_closed_form
from hdt_core.calibration.compressor import compressor_flights, compressor_samples
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flights_by_method import compressor_flights_by_method, exchanger_flights
from hdt_core.calibration.inlet_law import inlet_above_law
from hdt_core.calibration.sensor_biases import exit_differences
from hdt_core.components import Component
from hdt_core.components.pack import PARTS, Parts
from hdt_core.estimation.batch import Batch
from hdt_core.estimation.descent import gauss_newton
from hdt_core.estimation.problem import unknown
from hdt_core.flight.quality import RUNNING_KG_S, flow_steps
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance, with_static_pressure
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT, FLIGHT_PACK, IN_ORDER
from hdt_core.robust import MAD_TO_SD, huber_weights
from hdt_core.tables.base import finite

SAMPLE_SD = 0.025
"""Noise of one sample's ln conductance, for flights too short to show their own."""
ROBUST_STEPS = 6
ALOFT_M, FEWEST_MOVING = 2500.0, 4
"""Height from which climb and descent count (below are ice, slow flight and transients), and fewest samples."""
SLOPES = (
    ("ratio_per_exit_k", "hx_out_k", 0.01),
    ("ratio_per_ln_flow", "pack_flow_kg_s", 1e-4),
    ("ratio_per_tat_k", "tat_k", 0.01),
    ("ratio_per_inlet_k", "hx_in_k", 0.01),
    ("ratio_per_door", "ram_door_open", 1e-4),
)
MOST_LN = 5.0
"""Largest credible ln conductance ratio, 150 times the expected conductance."""
EXCHANGER = ("ln_ua_ratio", "ln_ua_ratio_sd", "ln_ua_ratio_map_sd", "ua_w_k")
MEDIANS = (*hx.SIGNALS, "ram_out_k")


def estimate_flights(samples: pl.DataFrame, dsm: Dsm, parts: Parts = PARTS) -> pl.DataFrame:
    """Estimate every flight and pack in `samples` from the model and that flight only.

    Parameters
    ----------
    samples : DataFrame
        Of the leg filter: signals in SI, `phase`, `monitored`.
    dsm : Dsm
        Model in service.
    parts : Parts
        The pack's parts, each with the method that estimates it.

    Returns
    -------
    DataFrame
        One row a flight and pack, by pack and departure: `ln_ua_ratio` (ln measured over expected conductance, ram flow
        that of the clean duct), its random `_sd` and the model's `_map_sd`; `ua_w_k`, `ram_flow_kg_s`,
        `effectiveness`; `ln_ram_ratio` (ram flow by heat balance over the clean map) where the ram outlet is measured;
        medians of the signals; effective diameter, group, efficiency of the compressor and what equation (6) expects.
        `status`: ok, few_samples, no_cruise, implausible, or how the exchanger's method ended without an estimate;
        `cc_status` that of the compressor's. Missing and non-finite values are null.

    Raises
    ------
    ValueError
        No installed package has a method that a part names.
    """
    flights = flights_of(samples)
    cruise = cruise_samples(samples)
    exchanger = _exchanger(correct_inputs(cruise, dsm.terms), dsm, parts.exchanger)
    exchanger = _with_rounding(exchanger, flow_steps(samples))
    checks = _cross_checks(samples, cruise, exchanger, dsm)
    cruise_all = cruise_samples(samples, monitored=False)
    machine = _machine(compressor_samples(cruise_all, dsm.pack_table()), dsm, parts.compressor)
    rows = flights
    for table in (exchanger, checks, machine):
        rows = rows.join(table, on=FLIGHT_PACK, how="left", validate="m:1")
    rows = finite(rows)
    odd = (pl.col("ln_ua_ratio").abs() > MOST_LN) | pl.col("ln_ua_ratio_sd").is_null()
    odd &= pl.col("ln_ua_ratio").is_not_null()
    expected_m = dsm.compressor.diameter_m(rows["vda_counts"].cast(pl.Float64).to_numpy())
    status = (
        pl.when(odd).then(pl.lit("implausible"))
        .when(pl.col("hx_status").is_not_null()).then("hx_status")
        .when(pl.col("ln_ua_ratio").is_null()).then(pl.lit("no_cruise"))
        .when(pl.col("n_samples") < 3).then(pl.lit("few_samples"))
        .otherwise(pl.lit("ok"))
    )  # fmt: skip
    return (
        rows.with_columns(
            pl.Series("expected_diameter_m", expected_m).fill_nan(None),
            pl.col("n_samples", "cc_n_samples").fill_null(0).cast(pl.Int32),
            status.alias("status"),
            *(pl.when(~odd).then(c).alias(c) for c in EXCHANGER),
        )
        .drop("order", "hx_status")
        .sort(IN_ORDER)
    )


def _machine(samples: pl.DataFrame, dsm: Dsm, part: Component) -> pl.DataFrame:
    """Estimate the compressor of each flight: medians of the closed form, or the part's own method in their place."""
    flights = compressor_flights(samples)
    if has_closed_form(part):
        return flights.with_columns(cc_status=pl.lit(None, dtype=pl.String))
    estimates = compressor_flights_by_method(samples, dsm.compressor, part)
    others = [c for c in flights.columns if c in FLIGHT_PACK or c not in estimates.columns]
    return flights.select(others).join(estimates, on=FLIGHT_PACK, how="left", validate="1:1")


def _exchanger(cruise: pl.DataFrame, dsm: Dsm, part: Component) -> pl.DataFrame:
    times = ("time_utc", *(c for c in ("departed_at",) if c in cruise.columns))
    rows = cruise.select(*FLIGHT_PACK, *times, *MEDIANS).drop_nulls(list(hx.SIGNALS))
    signals = with_static_pressure({name: rows[name].to_numpy().astype(float) for name in MEDIANS})
    bias = dsm.bias_of(rows)
    ratio = hx.ln_conductance_ratio(signals, dsm.design, bias)
    clean = hx.without_bias(signals, bias)
    ram = clean_ram_flow_kg_s(clean, dsm.design)
    balance = hx.ln_ram_flow_ratio(signals, dsm.design, bias)
    values = rows.with_columns(
        pl.Series("ratio", ratio),
        pl.Series("balance", balance),
        pl.Series("ram_flow_kg_s", ram),
        pl.Series("ln_expected", ln_clean_conductance(clean, ram, dsm.design)),
        pl.Series("effectiveness", (clean["hx_in_k"] - clean["hx_out_k"]) / (clean["hx_in_k"] - clean["tat_k"])),
    ).filter(pl.col("ratio").is_finite())
    ram_ratios = _locate(values.filter(pl.col("balance").is_finite()), "balance", "ln_ram_ratio").drop("n")
    medians = values.group_by(FLIGHT_PACK).agg(
        pl.col(*MEDIANS, "ram_flow_kg_s", "effectiveness", "ln_expected").median()
    )
    rows = _locate(values, "ratio", "ln_ua_ratio").rename({"n": "n_samples"})
    if has_closed_form(part):
        rows = rows.with_columns(hx_status=pl.lit(None, dtype=pl.String))
    else:
        is_solved = np.isfinite(ratio)
        solved = {name: signal[is_solved] for name, signal in clean.items()}
        estimates = exchanger_flights(values, solved, dsm.design, part)
        rows = rows.select(*FLIGHT_PACK, "n_samples").join(estimates, on=FLIGHT_PACK, how="left", validate="1:1")
    rows = rows.join(ram_ratios, on=FLIGHT_PACK, how="left", validate="m:1")
    clean_ua = pl.col("ln_expected").exp()
    return (
        rows.join(_sensitivities(medians, dsm), on=FLIGHT_PACK, validate="m:1")
        .with_columns(clean_ua.alias("ua_expected_w_k"), (clean_ua * pl.col("ln_ua_ratio").exp()).alias("ua_w_k"))
        .drop("ln_expected")
    )


def _with_rounding(exchanger: pl.DataFrame, steps: pl.DataFrame) -> pl.DataFrame:
    """Add the variance of a coarse flow's rounding, a twelfth of the step's square: a steady flow keeps its error."""
    rows = exchanger.join(steps, on=FLIGHT, how="left", maintain_order="left", validate="m:1")
    rounding = pl.col("ratio_per_ln_flow") * pl.col("pack_flow_step_ln") / np.sqrt(12.0)
    sd = pl.col("ln_ua_ratio_sd")
    wider = pl.when(rounding != 0.0).then((sd**2 + rounding**2).sqrt()).otherwise(sd)
    return rows.with_columns(wider.alias("ln_ua_ratio_sd")).drop("pack_flow_step_ln", "cc_flow_step_ln")


def _cross_checks(samples: pl.DataFrame, cruise: pl.DataFrame, exchanger: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Compute cross checks of each flight's sensors: see `hdt_core.tracking.sensor_shifts`."""
    checks = cruise.group_by(FLIGHT_PACK).agg(
        (pl.col("pack_flow_kg_s") / pl.col("cc_flow_kg_s")).log().median().alias("flows_apart_ln"),
        (pl.col("tat_k") - pl.col("cc_in_k")).median().alias("tat_apart_k"),
    )
    tables = (
        exit_differences(cruise).rename({"apart_k": "exit_apart_k"}),
        inlet_above_law(cruise, dsm.hot_inlet, dsm.design, dsm.bias_of(cruise)),
        _door_difference(samples, exchanger, dsm),
    )
    for table in tables:
        checks = checks.join(table, on=FLIGHT_PACK, how="left", validate="m:1")
    return checks


def _door_difference(samples: pl.DataFrame, exchanger: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Compute the ln conductance ratio of climb and descent less that of the cruise: `FLIGHT_PACK`, `door_apart_ln`.

    The exchanger's wear cancels; an error of the door's position does not, for the door moves between the two.
    """
    transients = samples.filter(
        pl.col("phase").is_in(["climb", "descent"])
        & (pl.col("altitude_m") > ALOFT_M)
        & (pl.col("pack_flow_kg_s") > RUNNING_KG_S)
    )
    rows = complete_air_data(transients).drop_nulls(list(hx.SIGNALS))
    signals = {name: rows[name].to_numpy().astype(float) for name in hx.SIGNALS}
    with np.errstate(all="ignore"):  # no ram pressure, no flow and no ratio
        ratio = pl.Series("ratio", hx.ln_conductance_ratio(signals, dsm.design, dsm.bias_of(rows)))
    ratios = rows.select(FLIGHT_PACK).with_columns(ratio).filter(pl.col("ratio").is_finite())
    medians = ratios.group_by(FLIGHT_PACK).agg(pl.col("ratio").median(), pl.len().alias("n"))
    pairs = medians.filter(pl.col("n") >= FEWEST_MOVING).join(exchanger, on=FLIGHT_PACK, validate="m:1")
    return pairs.select(*FLIGHT_PACK, (pl.col("ratio") - pl.col("ln_ua_ratio")).alias("door_apart_ln"))


def _sensitivities(medians: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Compute sensitivities of the ln conductance ratio to sensors and design, at each flight's medians."""
    signals = with_static_pressure({name: medians[name].to_numpy().astype(float) for name in MEDIANS})
    bias = dsm.bias_of(medians)
    base_ratio = hx.ln_conductance_ratio(signals, dsm.design, bias)
    columns = [pl.Series("ln_ua_ratio_map_sd", _map_sd(signals, dsm, bias, base_ratio)).fill_nan(None)]
    for name, signal, step in SLOPES:
        shifted_bias = bias.copy()
        shifted_bias[hx.BIASES.index(signal)] -= step
        slope = (hx.ln_conductance_ratio(signals, dsm.design, shifted_bias) - base_ratio) / step
        columns.append(pl.Series(name, slope).fill_nan(None))
    return medians.with_columns(columns)


def _map_sd(signals: dict[str, Array], dsm: Dsm, bias: Array, ratio: Array) -> Array:
    """Compute the ratio's standard deviation by the model's own uncertainty, relative to the model's anchor."""
    covariance = np.array(dsm.exchanger_cov)
    gradient = hx.design_gradient(signals, dsm.design, bias, ratio) - np.array(dsm.gradient)
    variance = np.einsum("ij,jk,ik->i", gradient, covariance, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _locate(rows: pl.DataFrame, column: str, name: str) -> pl.DataFrame:
    """Estimate Huber's location of a column by flight and pack, with standard error and count."""
    if not rows.height:
        schema = {c: rows.schema[c] for c in FLIGHT_PACK}
        return pl.DataFrame(schema=schema | {name: pl.Float64, f"{name}_sd": pl.Float64, "n": pl.UInt32})
    values = rows.select(*FLIGHT_PACK, column).sort(FLIGHT_PACK, maintain_order=True)  # sums keep their last digits
    keys = values.group_by(FLIGHT_PACK, maintain_order=True).agg(
        pl.col(column).median().alias("start"), pl.len().alias("n")
    )
    count = keys["n"].to_numpy().astype(float)
    group = np.repeat(np.arange(keys.height), keys["n"].to_numpy())
    value = values[column].to_numpy()
    centre = keys["start"].to_numpy().astype(float)
    deviations = (
        pl.DataFrame({"g": group, "a": np.abs(value - centre[group])})
        .group_by("g", maintain_order=True)
        .agg(pl.col("a").median())
    )
    # a short flight's own variance is uncertain: shrink it to the usual one with the weight of five samples
    variance = ((MAD_TO_SD * deviations["a"].to_numpy()) ** 2 * count + SAMPLE_SD**2 * 5.0) / (count + 5.0)
    scale = np.sqrt(variance)
    sample_scale = scale[group]
    problem = Batch(
        names=(name,), bounds=np.array([[-np.inf, np.inf]]), prior=unknown(np.zeros(1)), group=group,
        measured=(value / sample_scale)[:, None], sigma=np.ones(1),
        observe=lambda _x, theta, i: theta / sample_scale[i],
    )  # fmt: skip
    location, cov = gauss_newton(problem, centre[:, None], ROBUST_STEPS, lambda r: huber_weights(np.abs(r), 1.0))
    centre = location[:, 0]
    error = np.sqrt(cov[:, 0, 0])
    return keys.select(*FLIGHT_PACK, pl.Series(name, centre), pl.Series(f"{name}_sd", error), "n")
