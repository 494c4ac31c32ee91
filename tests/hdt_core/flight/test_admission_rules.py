"""Level two's verdicts at their edges: the twin's losses, the order of the rules, outliers of few samples."""

import polars as pl
import pytest

from hdt_core.flight.admission import admit
from hdt_core.flight.nominal import IndexLevel, Scatter
from hdt_core.flight.nominal_baseline import NominalBaseline
from hdt_core.records.keys import LEG

N = 30
TEXT = dict.fromkeys(("operator", "tail", "component", "action", "code"), pl.String)
NO_WORK = pl.DataFrame(schema=TEXT | {"pack": pl.Int32, "done_on": pl.Date})
NO_MESSAGE = pl.DataFrame(schema=TEXT | {"pack": pl.Int32, "message_time": pl.Datetime("us", "UTC")})
LEGS = pl.select(flight_number=pl.int_range(N)).with_columns(
    operator=pl.lit("TST"), tail=pl.lit("T"), pack=pl.lit(1, pl.Int32), reason=pl.lit(""), admitted=pl.lit(True),
    flight_id=pl.col("flight_number").cast(pl.String).str.zfill(2), n_nominal=pl.lit(9, pl.Int64),
    departed_at=pl.datetime(2024, 3, 1, 6, time_zone="UTC", time_unit="us") + pl.duration(days=pl.col("flight_number")),
)  # fmt: skip


def verdicts(
    legs: pl.DataFrame = LEGS, health: pl.DataFrame | None = None, scatter: Scatter | None = None, **signs: list[object]
) -> pl.DataFrame:
    """Second-level verdicts on legs that show these signs."""
    own = {"index_level": [0.0] * N, "index_n": [8] * N, "index_unrest": [0.0] * N} | signs
    indicators = legs.select(LEG).with_columns(pl.Series(k, v) for k, v in own.items())
    baseline = NominalBaseline(level=IndexLevel(clean=0.0, stray=0.0), scatter=scatter)
    return admit(baseline, legs, indicators, NO_WORK, NO_MESSAGE, health).sort("flight_id")


def losses(parameter: str, value: float, sd: float | None) -> pl.DataFrame:
    rows = LEGS.select(LEG).with_columns(parameter=pl.lit(parameter), value=pl.lit(value))
    return rows.with_columns(sd=pl.lit(sd, pl.Float64))


@pytest.mark.parametrize(
    ("parameter", "value", "sd", "reason"),
    [
        ("hx_fouling", 0.1171, 0.02, ""), ("hx_fouling", 0.1172, 0.02, "HX_WORN"),
        ("hx_fouling", 0.151, None, "HX_WORN"), ("hx_fouling", 0.15, None, ""),
        ("cc_efficiency_loss", 0.151, None, "CC_WORN"),
        ("cc_diameter_loss", 0.0751, None, "CC_WORN"), ("cc_diameter_loss", 0.0749, None, ""),
    ],
)  # fmt: skip
def test_a_loss_is_below_its_limit_with_probability_95_per_cent(parameter, value, sd, reason):
    """1.645 deviations below .15; .075 of a diameter, which goes with the root of the pressure rise."""
    result = verdicts(health=losses(parameter, value, sd))
    assert set(result["reason"]) == {reason}
    assert set(result["n_nominal"]) == {0 if reason else 9}


def test_the_exchanger_speaks_first_and_the_twin_over_the_index():
    both = pl.concat([losses("cc_efficiency_loss", 0.3, 0.0), losses("hx_fouling", 0.3, 0.0)])
    assert set(verdicts(health=both)["reason"]) == {"HX_WORN"}
    low = {"index_level": [0.0] * 20 + [-0.2] * 10}
    assert verdicts(**low)["reason"].to_list() == [""] * 20 + ["HX_WORN"] * 10
    assert set(verdicts(health=losses("hx_fouling", 0.0, 0.0), **low)["reason"]) == {""}
    assert verdicts(health=losses("cc_efficiency_loss", 0.0, 0.0), **low)["reason"].to_list()[-1] == "HX_WORN"


def test_an_earlier_reason_stays_and_rules_come_in_order():
    legs = LEGS.with_columns(reason=pl.when(pl.col("flight_number") == 3).then(pl.lit("ICING")).otherwise(pl.lit("")))
    result = verdicts(legs, index_unrest=[7.0] * N, index_level=[0.3 * (k == 5) for k in range(N)])
    assert result["reason"].to_list() == ["ICING" if k == 3 else "UNREST" for k in range(N)]
    assert not result["admitted"].any()


@pytest.mark.parametrize(
    ("n", "off_k", "out"),
    [(8, 0.7, True), (20, 0.7, True), (7, 0.7, False), (7, 0.75, True), (None, 1.98, True), (None, 1.96, False)],
)
def test_an_outlier_of_few_samples_counts_as_its_mean_deserves(n, off_k, out):
    """Weighted by the root of an eighth of its samples, one where the number is not known: 3.48 deviations of .2 K is
    the 99.95 % quantile of one normal residual."""
    scatter = Scatter(("inlet_minus_tat_k_off",), (0.0,), ((25.0,),))
    result = verdicts(
        scatter=scatter, inlet_minus_tat_k=[0.0] * 29 + [off_k], index_n=pl.Series([n] * N, dtype=pl.Int64)
    )
    assert result["reason"].to_list() == [""] * 29 + (["OUTLIER"] if out else [""])
