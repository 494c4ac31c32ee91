"""Level two: what is planted is kept out, sound flights stay in, and each rule at its edge."""

import numpy as np
import polars as pl
import pytest
from alter import alter
from twin_flights import NO_LOG

from benchmarks.chain import admit_fleet
from hdt_core.flight.admission import (
    SECOND_LEVEL,
    NominalBaseline,
    Scatter,
    admit,
    learn_baseline,
    learn_scatter,
    leg_indicators,
)
from hdt_core.flight.conductance_index import IndexLevel, add_conductance_index, learn_manifold, leg_conductance
from hdt_core.flight.control_schedules import learn_outlet_schedule
from hdt_core.flight.cross_checks import check_sensors, leg_checks
from hdt_core.flight.legs import REASONS, judge_legs, number_flights
from hdt_core.records.keys import LEG

KEY = ["tail", "flight_id", "pack"]


@pytest.fixture(scope="module")
def level_one(fleet):
    legs, samples = judge_legs(fleet.snapshots)
    return number_flights(legs), samples


@pytest.fixture(scope="module")
def second_verdicts(fleet, level_one):
    return admit_fleet(*level_one, fleet.maintenance, fleet.messages)


@pytest.fixture(scope="module")
def norm(fleet, level_one) -> NominalBaseline:
    return learn_baseline(*level_one, fleet.maintenance, fleet.messages)


def test_second_level_keeps_every_leg(level_one, second_verdicts):
    assert second_verdicts.select(LEG).equals(level_one[0].select(LEG))
    assert second_verdicts.columns == level_one[0].columns


def test_second_level_keeps_first_verdicts(level_one, second_verdicts):
    rejected = level_one[0].with_row_index().filter(pl.col("reason") != "")
    assert second_verdicts["reason"].gather(rejected["index"]).to_list() == rejected["reason"].to_list()


def test_second_level_rejects_for_reason(level_one, second_verdicts):
    assert {"MAINTENANCE", "MESSAGE"} <= set(second_verdicts["reason"]) <= {"", *REASONS, *SECOND_LEVEL}
    assert (second_verdicts["admitted"] == (second_verdicts["reason"] == "")).all()
    assert second_verdicts["admitted"].sum() < level_one[0]["admitted"].sum()


def test_second_level_separates_sick_flights(fleet, second_verdicts):
    arrived = fleet.truth.filter("arrived").join(second_verdicts.select(*KEY, "admitted"), on=KEY, how="left")
    assert arrived.filter("nominal")["admitted"].mean() >= 0.82
    assert arrived.filter("admitted")["contaminant"].mean() <= 0.05


def reasons_with_loss(fleet, level_one, legs: pl.DataFrame, loss: float) -> list[str]:
    """Second verdicts on legs of which the track says such a loss."""
    wear = legs.select(*LEG).with_columns(parameter=pl.lit("hx_fouling"), value=pl.lit(loss), sd=pl.lit(0.02))
    again = admit_fleet(*level_one, fleet.maintenance, fleet.messages, wear)
    return again.join(legs.select(LEG), on=LEG, how="semi")["reason"].to_list()


def test_tracked_loss_rejects_leg(fleet, level_one, second_verdicts):
    sound = second_verdicts.filter("admitted").head(3)
    assert reasons_with_loss(fleet, level_one, sound, 0.3) == ["HX_WORN"] * 3


def test_tracked_soundness_admits_leg(fleet, level_one, second_verdicts):
    worn = second_verdicts.filter(pl.col("reason") == "HX_WORN")
    assert worn.height > 20
    assert set(reasons_with_loss(fleet, level_one, worn, 0.02)) <= {"", "OUTLIER"}


@pytest.mark.parametrize("step_k", [-4.0, 4.0])
def test_outlet_step_flags_own_pack(level_one, step_k):
    legs, samples = level_one
    numbers = legs.select(*LEG, "flight_number")
    span = pl.col("flight_number").is_between(100, 130) & (pl.col("tail") == legs["tail"][0])
    one, two = (span & (pl.col("pack") == pack) for pack in (1, 2))
    rows = samples.join(numbers, on=LEG, how="left", maintain_order="left")
    off = alter(rows, one, hx_out_k=pl.col("hx_out_k") + step_k).drop("flight_number")
    before, after = (
        check_sensors(leg_checks(s, learn_outlet_schedule(s)), legs).join(numbers, on=LEG) for s in (samples, off)
    )
    sound = before.filter(one & ~pl.col("sensor_shift")).select(LEG)
    assert after.join(sound, on=LEG, how="semi")["sensor_shift"].mean() >= 0.9
    share_before, share_after = (checks.filter(two)["sensor_shift"].mean() for checks in (before, after))
    assert share_after <= share_before + 0.1


def _apart(legs: pl.DataFrame, column: str, slope: float, mine: pl.Expr) -> pl.DataFrame:
    """Twin's flights whose witness drifts from flight 100 to 140 and is repaired then."""
    rng = np.random.default_rng(5)
    noise = {c: sd * rng.normal(size=legs.height) for c, sd in (("inlet_apart_k", 0.7), ("door_apart_ln", 0.018))}
    drift = pl.when(mine & pl.col("flight_number").is_between(100, 140)).then(pl.col("flight_number") - 100.0)
    twin = legs.select(*LEG, "flight_number").with_columns(pl.Series(c, v) for c, v in noise.items())
    return twin.with_columns(pl.col(column) + slope * drift.otherwise(0.0)).drop("flight_number")


@pytest.mark.parametrize(("column", "slope"), [("inlet_apart_k", 0.15), ("door_apart_ln", 0.004)])
def test_twins_drift_is_rejected_early(fleet, level_one, norm, column, slope):
    """From its first flights on, though no other check sees it."""
    legs, samples = level_one
    mine = (pl.col("tail") == legs["tail"][0]) & (pl.col("pack") == 1)
    signs = leg_indicators(samples, norm)
    logs = fleet.maintenance, fleet.messages
    twins = (_apart(legs, column, rate, mine) for rate in (0.0, slope))
    before, after = (admit(norm, legs, signs, *logs, twin_flights=twin) for twin in twins)
    sound = before.with_columns(legs["flight_number"]).filter("admitted")
    hit = after.join(sound.select(*LEG, "flight_number"), on=LEG)
    assert (hit.filter(mine & pl.col("flight_number").is_between(110, 140))["reason"] == "SENSOR_SHIFT").all()
    assert hit.filter(~mine | ~pl.col("flight_number").is_between(90, 145))["admitted"].mean() > 0.99


def test_ice_makes_leg_restless(level_one):
    legs, samples = level_one
    manifold = learn_manifold(samples, legs)
    enough = pl.col("monitored").sum().over(LEG) >= 10
    icing = enough & pl.col("monitored") & pl.col("monitored").cum_sum().over(LEG).is_between(3, 6)
    iced = alter(samples, icing, hx_out_k=pl.col("hx_out_k") + 4.0)
    calm, restless = (leg_conductance(rows, manifold) for rows in (samples, iced))
    both = calm.join(restless, on=LEG, suffix="_iced").filter(pl.col("index_n") >= 10)
    assert (both["index_unrest"] > 6.5).mean() <= 0.05
    assert (both["index_unrest_iced"] > 6.5).mean() >= 0.8


def test_index_falls_with_true_loss(fleet, level_one):
    legs, samples = level_one
    level = leg_conductance(samples, learn_manifold(samples, legs)).join(fleet.truth, on=KEY)
    sound = level.filter(~pl.col("icing") & ~pl.col("door_fault") & (pl.col("sensor_fault") == ""))
    columns = (pl.col("index_level"), pl.col("apparent_ua_ratio"))
    change = sound.select(c - c.median().over("tail", "pack") for c in columns)
    assert np.corrcoef(change.to_numpy().T)[0, 1] > 0.8


def test_few_samples_have_no_index(level_one):
    legs, samples = level_one
    few = samples.head(3)
    assert add_conductance_index(few, learn_manifold(few, legs))["conductance_index"].null_count() == 3


def test_indicators_are_of_leg_alone(level_one, norm):
    legs, samples = level_one
    some = samples.filter(pl.col("flight_id").is_in(legs["flight_id"].unique().sort().gather_every(7).implode()))
    whole, part = (leg_indicators(s, norm).sort(LEG) for s in (samples, some))
    assert part.equals(whole.join(part.select(LEG), on=LEG, how="semi").sort(LEG))


@pytest.mark.parametrize("share", [0.02, 0.10, 0.25])
def test_mcd_is_not_masked_by_outliers(share):
    rng = np.random.default_rng(8)
    scales = np.array([0.01, 0.2, 0.004])
    x = rng.normal(size=(1000, 3)) * scales
    sick = np.arange(1000) < 1000 * share
    x[sick] += 8.0 * scales * rng.choice([-1, 1], size=3)
    residuals = pl.DataFrame(x, schema=["a", "b", "c"])
    out = learn_scatter(residuals, residuals.columns).flag_outliers(residuals).to_numpy()
    assert out[sick].all()
    assert out[~sick].mean() <= 0.01


def test_norm_survives_json(norm):
    for one in (norm, NominalBaseline()):
        assert NominalBaseline.from_json(one.to_json()) == one


def test_norm_judges_each_tail_alone(fleet, level_one, norm, second_verdicts):
    legs, samples = level_one
    for (tail,), own in legs.group_by("tail"):
        signs = leg_indicators(samples.filter(tail=tail), norm)
        alone = admit(norm, own, signs, fleet.maintenance, fleet.messages)
        assert alone.equals(second_verdicts.filter(tail=tail).select(alone.columns))


N = 30
NO_MESSAGE = pl.DataFrame(
    schema=dict.fromkeys(("operator", "tail", "code"), pl.String)
    | {"pack": pl.Int32, "message_time": pl.Datetime("us", "UTC")}
)
LEGS = pl.select(flight_number=pl.int_range(N)).with_columns(
    operator=pl.lit("TST"), tail=pl.lit("T"), pack=pl.lit(1, pl.Int32), reason=pl.lit(""), admitted=pl.lit(True),
    flight_id=pl.col("flight_number").cast(pl.String).str.zfill(2), n_nominal=pl.lit(9, pl.Int64),
    departed_at=pl.datetime(2024, 3, 1, 6, time_zone="UTC", time_unit="us") + pl.duration(days=pl.col("flight_number")),
)  # fmt: skip


def verdicts(
    legs: pl.DataFrame = LEGS, health: pl.DataFrame | None = None, scatter: Scatter | None = None, **signs: list[object]
) -> pl.DataFrame:
    """Second-level verdicts on legs that show these signs."""
    steps = {"index_step": [0.0] * N, "flow_step_ln": [0.0] * N}
    own = {"index_level": [0.0] * N, "index_n": [8] * N, "index_unrest": [0.0] * N} | steps | signs
    indicators = legs.select(LEG).with_columns(pl.Series(k, v) for k, v in own.items())
    baseline = NominalBaseline(level=IndexLevel(clean=0.0, stray=0.0), scatter=scatter)
    return admit(baseline, legs, indicators, NO_LOG, NO_MESSAGE, health).sort("flight_id")


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
def test_worn_leg_is_rejected(parameter, value, sd, reason):
    """1.645 deviations below .15; .075 of a diameter, which goes with the root of the pressure rise."""
    result = verdicts(health=losses(parameter, value, sd))
    assert set(result["reason"]) == {reason}
    assert set(result["n_nominal"]) == {0 if reason else 9}


def test_exchanger_is_reason_before_compressor():
    both = pl.concat([losses("cc_efficiency_loss", 0.3, 0.0), losses("hx_fouling", 0.3, 0.0)])
    assert set(verdicts(health=both)["reason"]) == {"HX_WORN"}


@pytest.mark.parametrize(
    ("health", "late"),
    [(None, "HX_WORN"), (losses("hx_fouling", 0.0, 0.0), ""), (losses("cc_efficiency_loss", 0.0, 0.0), "HX_WORN")],
    ids=["untracked", "exchanger tracked", "compressor tracked"],
)
def test_index_judges_untracked_exchanger(health, late):
    result = verdicts(health=health, index_level=[0.0] * 20 + [-0.2] * 10)
    assert result["reason"].to_list() == [""] * 20 + [late] * 10


def test_earlier_reason_stays():
    legs = alter(LEGS, pl.col("flight_number") == 3, reason=pl.lit("ICING"))
    result = verdicts(legs, index_unrest=[7.0] * N, index_level=[0.3 * (k == 5) for k in range(N)])
    assert result["reason"].to_list() == ["ICING" if k == 3 else "UNREST" for k in range(N)]
    assert not result["admitted"].any()


@pytest.mark.parametrize(
    ("n", "off_k", "out"),
    [(8, 0.7, True), (20, 0.7, True), (7, 0.7, False), (7, 0.75, True), (None, 1.98, True), (None, 1.96, False)],
)
def test_few_samples_weaken_outlier(n, off_k, out):
    """Weighted by the root of an eighth of its samples, one where the number is not known: 3.48 deviations of .2 K is
    the 99.95 % quantile of one normal residual."""
    scatter = Scatter(("inlet_minus_tat_k_off",), (0.0,), ((25.0,),))
    few = pl.Series([n] * N, dtype=pl.Int64)
    result = verdicts(scatter=scatter, inlet_minus_tat_k=[0.0] * 29 + [off_k], index_n=few)
    assert result["reason"].to_list() == [""] * 29 + (["OUTLIER"] if out else [""])


@pytest.mark.parametrize(("step", "out"), [(0.0, True), (0.04, True), (0.06, False)])
def test_step_of_flow_is_no_outlier(step, out):
    """0.05 beyond a level that scatters by 0.002."""
    check = "pack_over_compressor_flow_ln"
    scatter = Scatter((f"{check}_off",), (0.0,), ((1.0 / 0.002**2,),))
    result = verdicts(scatter=scatter, flow_step_ln=[step] * N, **{check: [0.0] * 29 + [0.05]})
    assert result["reason"].to_list() == [""] * 29 + (["OUTLIER"] if out else [""])
