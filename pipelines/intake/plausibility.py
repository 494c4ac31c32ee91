"""Which rows were delivered in another unit than agreed: found by physics, never used silently.

A slip of units strikes whole columns of a flight; a spike strikes one value. So a row is refused when two of its
columns slipped together, or when the same column slipped in most of the flight; a single odd value is left to the range
check.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from pipelines.intake.wiring import miswritten_rows

FLIGHT = ("file_index", "flight_id")
MOST = 0.7
"""Share of a column's values in a flight from which on the column is held to have slipped."""
KPA_PER_PSI = 6.894757
KILOGRAMS = (0.2, 3.5)
"""lb/min: what 26 to 460 lb/min are in kg/s."""


@dataclass(frozen=True, slots=True)
class Slip:
    """Columns whose value, read as agreed, lies in `low`..`high` only when it was written in the wrong unit."""

    reason: str
    bands: dict[str, tuple[float, float]]
    """Recorded column: band in the recorded unit."""


KELVIN = Slip(
    "unit_kelvin",
    {
        "tat_degc": (150.0, 350.0),
        "cc_in_degc": (150.0, 350.0),
        "hx_out_degc": (220.0, 480.0),
        "ram_out_degc": (220.0, 480.0),
        "hx_in_degc": (290.0, 650.0),
        "cc_out_degc": (260.0, 650.0),
    },
)
"""Air is -120 to +80 °C outside and below 200 °C behind the exchanger: in kelvin it reads above all of that."""
KILOPASCAL = Slip("unit_kpa", {"pt_psia": (23.5, 160.0), "cc_in_psia": (23.5, 160.0), "cc_out_psia": (75.0, 700.0)})
"""Total air pressure stays below 23.5 psia anywhere an airliner flies, and above 23.5 kPa up to 45,000 ft."""


def slipped_rows(raw: pl.DataFrame) -> pl.DataFrame:
    """Rows delivered in a wrong unit or wiring: `index` (in `raw`), `reason`, `column_name`, `told` (null: the reason).

    Parameters
    ----------
    raw : DataFrame
        `file_index, flight_id, pack` and the signals in recorded units, null where missing or no number.
    """
    found = [_by_band(raw, KELVIN), _by_band(raw, KILOPASCAL), _kilograms(raw), _by_atmosphere(raw)]
    alone = pl.concat(found).unique("index", keep="first", maintain_order=True)
    together = miswritten_rows(raw).join(alone, on="index", how="anti")
    return pl.concat([alone.with_columns(told=pl.lit(None, pl.String)), together])


def _none() -> pl.DataFrame:
    return pl.DataFrame(schema={"index": pl.UInt32, "reason": pl.String, "column_name": pl.String})


def _by_band(raw: pl.DataFrame, slip: Slip) -> pl.DataFrame:
    like = {c: pl.col(c).is_between(*band).fill_null(False) for c, band in slip.bands.items()}
    flights = raw.filter(pl.any_horizontal(like.values())).select(FLIGHT).unique()
    if flights.is_empty():
        return _none()
    some = raw.with_row_index().join(flights, on=FLIGHT, how="semi", maintain_order="left", nulls_equal=True)
    lasting = (_most(pl.col(c), e).alias(f"most {c}") for c, e in like.items())
    marks = some.select("index", *(e.alias(c) for c, e in like.items()), *lasting)
    slipped = (pl.sum_horizontal(*like) >= 2) | pl.any_horizontal(pl.col(c) & pl.col(f"most {c}") for c in like)
    return _rows(marks.with_columns(slipped.alias("slipped")), list(like), slip.reason)


def _most(value: pl.Expr, like: pl.Expr) -> pl.Expr:
    """Whether most of a flight's values are `like`; a handful says nothing, nor does a sensor stuck at its end."""
    n = value.count().over(FLIGHT)
    return (n >= 3) & (like.sum().over(FLIGHT) >= MOST * n) & (value.n_unique().over(FLIGHT) > 2)


def _rows(marks: pl.DataFrame, columns: list[str], reason: str) -> pl.DataFrame:
    named = pl.concat_list(pl.when(c).then(pl.lit(c)) for c in columns).list.drop_nulls().list.join(", ")
    return marks.filter("slipped").select("index", pl.lit(reason).alias("reason"), named.alias("column_name"))


def _kilograms(raw: pl.DataFrame) -> pl.DataFrame:
    """Rows whose flow is that of a pack switched off while its compressor turns all flight: kg/s for lb/min.

    A dead flow sensor scatters about its zero by more than itself; 0.85 kg/s read as lb/min holds within a third, and
    is not frozen to the digit.
    """
    like = {c: pl.col(c).is_between(*KILOGRAMS).fill_null(False) for c in ("pack_flow_lbpm", "cc_flow_lbpm")}
    if not any(raw.select(e.any().alias(c) for c, e in like.items()).row(0)):
        return _none()
    unit = (*FLIGHT, "pack")
    cooled_k = (pl.col("hx_in_degc") - pl.col("hx_out_degc")).median()
    turning = (pl.col("cc_speed_rpm").median() > 5000.0).fill_null(cooled_k > 25.0)
    flights = raw.group_by(unit).agg((turning & _steady(pl.col(c), e)).alias(f"all {c}") for c, e in like.items())
    marks = raw.with_row_index().select("index", *unit, *(e.alias(c) for c, e in like.items()))
    marks = marks.join(flights, on=unit, how="left", maintain_order="left", nulls_equal=True, validate="m:1")
    slipped = pl.any_horizontal(pl.col(c) & pl.col(f"all {c}").fill_null(False) for c in like)
    return _rows(marks.with_columns(slipped.alias("slipped")), list(like), "unit_kg_s")


def _steady(flow: pl.Expr, like: pl.Expr) -> pl.Expr:
    """Whether nearly all of a flow's values are `like`, close together, and not all the same."""
    n = flow.count()
    return (n >= 3) & (like.sum() >= 0.9 * n) & (flow.std() < 0.35 * flow.mean()) & (flow.n_unique() > 2)


def _by_atmosphere(raw: pl.DataFrame) -> pl.DataFrame:
    """Rows of flights whose total pressure is about 6.9 times what altitude and Mach allow, judged by medians."""
    high = pressure_ratio(raw).filter(pl.col("ratio").is_between(0.75 * KPA_PER_PSI, 1.3 * KPA_PER_PSI))
    if high.is_empty():
        return _none()
    marks = raw.select(*FLIGHT, pl.col("pt_psia").is_not_null()).with_row_index("index")
    marks = marks.join(high, on=FLIGHT, how="semi", maintain_order="left").filter("pt_psia")
    return marks.select("index", pl.lit("unit_kpa").alias("reason"), pl.lit("pt_psia").alias("column_name"))


def pressure_ratio(raw: pl.DataFrame) -> pl.DataFrame:
    """Median total pressure of each flight over that of the standard atmosphere at its median altitude and Mach."""
    needed = ("altitude_ft", "mach", "pt_psia")
    whole = raw.select(*FLIGHT, *needed).drop_nulls(needed)
    medians = whole.group_by(FLIGHT).agg(pl.col(needed).median(), pl.len().alias("n")).filter(pl.col("n") >= 3)
    altitude_m = np.clip(medians["altitude_ft"].to_numpy() * 0.3048, -1000.0, 20000.0)
    mach = np.clip(medians["mach"].to_numpy(), 0.0, 1.0)
    expected_pa = standard_pressure_pa(altitude_m) * total_to_static_pressure(mach)
    ratio = medians["pt_psia"].to_numpy() * 6894.757 / expected_pa
    return medians.select(FLIGHT).with_columns(pl.Series("ratio", ratio, dtype=pl.Float64))
