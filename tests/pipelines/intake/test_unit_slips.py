"""A column written in the wrong unit is found by physics, in every flight; a sound fleet is never accused."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipelines.intake.columns import SIGNAL_NAMES
from pipelines.intake.unit_slips import find_unit_slips

SAMPLES = Path(__file__).parents[3] / "data_samples"
KELVIN = (1.0, 273.15)
KPA = (6.894757, 0.0)
KG_S = (0.45359237 / 60.0, 0.0)
SLIPS = [
    *((c, KELVIN, "unit_kelvin") for c in ("tat_degc", "hx_in_degc", "hx_out_degc", "cc_in_degc", "cc_out_degc")),
    *((c, KPA, "unit_kpa") for c in ("pt_psia", "cc_in_psia", "cc_out_psia")),
    *((c, KG_S, "unit_kg_s") for c in ("pack_flow_lbpm", "cc_flow_lbpm")),
]
CELSIUS = ("tat_degc", "hx_in_degc", "hx_out_degc", "ram_out_degc", "cc_in_degc", "cc_out_degc")
PSI = ("pt_psia", "cc_in_psia", "cc_out_psia")
FLOWS = ("pack_flow_lbpm", "cc_flow_lbpm")
OTHER_UNITS = [  # columns, the agreed unit as scale and offset of the one written, its name
    *(((c,), 1.8, 32.0, "°F") for c in CELSIUS),
    (CELSIUS, 1.8, 32.0, "°F"),
    *(((c,), 68.94757, 0.0, "hPa") for c in PSI),
    *(((c,), 0.06894757, 0.0, "bar") for c in PSI),
    *(((c,), 2.036021, 0.0, "inHg") for c in PSI),
    (PSI, 2.036021, 0.0, "inHg"),
    *(((c,), 0.45359237, 0.0, "kg/min") for c in FLOWS),
    (FLOWS, 0.45359237, 0.0, "kg/min"),
    (("cc_speed_rpm",), 0.10471976, 0.0, "rad/s"),
    (("cc_speed_rpm",), 1 / 60, 0.0, "Hz"),
    (("cc_speed_rpm",), 1 / 240, 0.0, "per cent"),
    (("cc_speed_rpm",), 1 / 400, 0.0, "per cent"),
    (("cc_speed_rpm",), 1e-3, 0.0, "thousands of rpm"),
    (("altitude_ft",), 0.3048, 0.0, "m"),
    (("altitude_ft",), 0.01, 0.0, "flight levels"),
    (("ram_door_pct",), 0.01, 0.0, "a fraction of 1"),
]
SWAPPED = [
    ("hx_in_degc", "hx_out_degc"),
    ("cc_in_degc", "cc_out_degc"),
    ("cc_in_psia", "cc_out_psia"),
    ("hx_in_degc", "ram_out_degc"),
    ("tat_degc", "hx_out_degc"),
    ("tat_degc", "cc_out_degc"),
    ("pt_psia", "cc_out_psia"),
]
LEAST = 0.85
"""Share of rows that must be found. Missed are flights with a dead sensor, and those near -40 degrees, where Fahrenheit
and Celsius say the same."""


@pytest.fixture(scope="module")
def fleet():
    """A month of four aircraft of two operators, faults, dead sensors and switched-off packs included."""
    tails = ("LX-AAA", "LX-AAB", "A9-BAB", "A9-BAD")
    paths = [p for tail in tails for p in SAMPLES.glob(f"*/{tail}/acms/*-04.parquet")]
    frame = pl.concat([pl.read_parquet(p) for p in paths], how="diagonal_relaxed")
    return frame.with_columns(pl.lit(0, pl.Int32).alias("file_index"))


def test_sound_fleet_has_no_slip(fleet):
    assert find_unit_slips(fleet).is_empty()


@pytest.mark.parametrize(("column", "unit", "reason"), SLIPS, ids=[c for c, _, _ in SLIPS])
def test_column_in_other_unit_is_found(column, unit, reason, fleet):
    scale, offset = unit
    slips = find_unit_slips(fleet.with_columns(pl.col(column) * scale + offset))
    assert set(slips["reason"]) == {reason}
    assert all(column in c for c in slips["column_name"])
    assert slips.height > 0.985 * fleet[column].count()  # what is missed are flights with a dead sensor or a pack off


def count_slips(slips: pl.DataFrame, columns: tuple[str, ...], words: str) -> int:
    """Rows of which just these columns are named, in these words."""
    return slips.filter(pl.col("sentence").str.contains(words, literal=True), column_name=", ".join(columns)).height


@pytest.mark.parametrize(
    ("columns", "scale", "offset", "unit"), OTHER_UNITS, ids=lambda v: v if isinstance(v, str) else ""
)
def test_slip_names_its_unit(columns, scale, offset, unit, eighth):
    recorded = eighth.filter(pl.any_horizontal(pl.col(columns).is_not_null()))
    slips = find_unit_slips(recorded.with_columns((pl.col(c) * scale + offset).round(3) for c in columns))
    right = count_slips(slips, columns, f"It fits {unit}.")
    assert right > LEAST * recorded.height
    assert slips.height - right < 0.12 * recorded.height  # found, but as another unit


@pytest.mark.parametrize(("is_empty", "are_left"), [((10, 0), False), ((3, 1), True)], ids=["few", "two of three"])
def test_rows_without_the_column_go_with_the_others(is_empty, are_left, eighth):
    """A flight of two reports is none; of a column at a lower rate the other rows are good."""
    nth, kept = is_empty
    place = pl.int_range(pl.len()).over("flight_id", "pack") % nth
    is_null = place != 0 if kept else place == 0
    in_kelvin = pl.when(~is_null).then(pl.col("hx_in_degc") + 273.15).alias("hx_in_degc")
    recorded = eighth.filter(pl.col("hx_in_degc").is_not_null()).with_columns(in_kelvin).with_row_index("index")

    slips = find_unit_slips(recorded.drop("index"))

    of_slip = recorded.join(recorded.join(slips, on="index", how="semi"), on=["flight_id", "pack"], how="semi")
    assert (of_slip.join(slips, on="index", how="anti").height > 0) is are_left


def _true_kt(mach: pl.Expr) -> pl.Expr:
    """True airspeed in knots, by the total temperature (ISA sound speed 661.5 kt at 288.15 K)."""
    static_k = (pl.col("tat_degc") + 273.15) / (1.0 + 0.2 * mach**2)
    return mach * 661.4786 * (static_k / 288.15).sqrt()


def _calibrated_kt(mach: pl.Expr) -> pl.Expr:
    """Calibrated airspeed in knots below the tropopause (ISA pressure ratio of ICAO Doc 7488)."""
    ratio = (1.0 - 6.8756e-6 * pl.col("altitude_ft").clip(upper_bound=36_089)) ** 5.25588
    above = ((36_089 - pl.col("altitude_ft").clip(lower_bound=36_089)) / 20_806).exp()
    impact = ratio * above * ((1.0 + 0.2 * mach**2) ** 3.5 - 1.0)
    return 661.4786 * (5.0 * ((impact + 1.0) ** (1 / 3.5) - 1.0)).sqrt()


@pytest.mark.parametrize(
    "knots", [_true_kt, _calibrated_kt, lambda mach: mach * 661.4786], ids=["true", "calibrated", "by sea level"]
)
def test_mach_in_knots_is_named(knots, eighth):
    """Out of range as it is, so the rows stay; but the likely unit is named."""
    wrong = eighth.with_columns(knots(pl.col("mach")).round(1).alias("mach"))
    slips = find_unit_slips(wrong)
    assert set(slips["reason"]) == {"out_of_range"}
    assert count_slips(slips, ("mach",), "It fits knots.") > 0.97 * eighth["mach"].count()


def test_absurd_mach_has_no_unit(eighth):
    far = pl.when(pl.int_range(pl.len()) % 2 == 0).then(1e300).otherwise(pl.int_range(pl.len()) * 1e90)
    assert find_unit_slips(eighth.with_columns(far.alias("mach"))).is_empty()


def test_mach_in_knots_needs_no_pressure(eighth):
    alone = eighth.with_columns(pl.lit(None, pl.Float64).alias(c) for c in (*PSI, "altitude_ft"))
    slips = find_unit_slips(alone.with_columns(_true_kt(pl.col("mach")).alias("mach")))
    assert count_slips(slips, ("mach",), "It fits knots.") > 0.97 * eighth["mach"].count()


@pytest.mark.parametrize(("one", "other"), SWAPPED)
def test_swapped_columns_are_named(one, other, eighth):
    recorded = eighth.drop_nulls([one, other])
    slips = find_unit_slips(recorded.with_columns(pl.col(one).alias(other), pl.col(other).alias(one)))
    assert count_slips(slips, (one, other), "change places") > LEAST * recorded.height


def test_swap_on_one_pack_is_found(eighth):
    swapped = pl.col("pack") == 1
    one = pl.col("hx_in_degc")
    other = pl.col("hx_out_degc")
    wired = eighth.with_columns(
        pl.when(swapped).then(other).otherwise(one).alias("hx_in_degc"),
        pl.when(swapped).then(one).otherwise(other).alias("hx_out_degc"),
    )
    slips = find_unit_slips(wired)
    assert set(slips["column_name"]) == {"hx_in_degc, hx_out_degc"}
    assert set(wired[slips["index"].to_list()]["pack"]) == {1}
    assert slips.height > LEAST * eighth.filter(pack=1).height


@pytest.mark.parametrize(
    ("column", "off"),
    [("hx_out_degc", 25), ("hx_out_degc", 40), ("hx_in_degc", -40), ("hx_in_degc", 60), ("cc_in_degc", -15),
     ("cc_out_degc", 60), ("ram_out_degc", 50), ("pack_flow_lbpm", -30), ("cc_out_psia", 3), ("tat_degc", 15)],
)  # fmt: skip
def test_biased_sensor_is_no_slip(column, off, eighth):
    """On one pack, as sensors fail, or the one probe of the aircraft: stored, and judged flight by flight."""
    sick = pl.col("pack") == 1 if column != "tat_degc" else pl.lit(True)
    shifted = pl.when(sick).then(pl.col(column) + off).otherwise(column)
    slips = find_unit_slips(eighth.with_columns(shifted.alias(column)))
    assert slips.height < 0.01 * eighth.height, slips.group_by("column_name", "sentence").len()


@pytest.mark.parametrize(
    ("column", "value"), [("tat_degc", 32.5), ("pack_flow_lbpm", 0.0), ("ram_door_pct", 0.5), ("hx_in_degc", 300.0)]
)
def test_stuck_sensor_is_no_slip(column, value, eighth):
    slips = find_unit_slips(eighth.with_columns(pl.when(pl.col(column).is_not_null()).then(value).alias(column)))
    assert slips.is_empty(), slips.group_by("column_name", "sentence").len()


@pytest.fixture(scope="module")
def eighth(fleet):
    """Every eighth flight, with the ram outlet's sensor where it was not fitted."""
    flights = fleet.filter(pl.col("flight_id").rank("dense") % 8 == 0)
    fitted = pl.col("hx_out_degc") * 0.3 + pl.col("hx_in_degc") * 0.4
    return flights.with_columns(pl.coalesce("ram_out_degc", fitted))


OFF = {"tat_degc": -20.0, "hx_in_degc": -19.0, "hx_out_degc": -19.5, "altitude_ft": 35e3}
"""A pack that is off shows outside air at every station."""
HOT_EXIT = {"tat_degc": -20.0, "hx_in_degc": 30.0, "hx_out_degc": 15.0, "ram_out_degc": 110.0, "altitude_ft": 35e3}


N = 60


def one_flight(readings: dict) -> pl.DataFrame:
    """N rows of one pack."""
    return pl.DataFrame({"file_index": [0] * N, "flight_id": ["T_20240101_01"] * N, "pack": [1] * N, **readings})


@pytest.mark.parametrize(("near", "reasons"), [(OFF, []), (HOT_EXIT, ["swapped_columns"])])
def test_unrecorded_column_is_never_swapped(near, reasons):
    """A pack that is off says nothing of a sensor that nobody fitted."""
    rng = np.random.default_rng(0)
    read = {c: near[c] + rng.normal(0.0, 0.4, N) if c in near else pl.Series([None] * N, dtype=pl.Float64)
            for c in SIGNAL_NAMES}  # fmt: skip
    assert find_unit_slips(one_flight(read))["reason"].unique().to_list() == reasons


@pytest.mark.parametrize("far", [1.7e308, -1.7e308, 1e200, -1e155, np.inf])
def test_absurd_number_overflows_nothing(far):
    """Warnings are errors here: NumPy would say so in the middle of a night."""
    rng = np.random.default_rng(0)
    read = {c: rng.normal(HOT_EXIT.get(c, 50.0), 0.4, N) for c in SIGNAL_NAMES}
    for name in SIGNAL_NAMES:
        read[name][7] = far
    assert find_unit_slips(one_flight(read)).height <= N
