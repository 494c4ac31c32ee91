"""A declared component's flights: which calibrate it, which stand apart, the prior moved; where a night goes on."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from by_hand import flights, log, samples_of

from hdt_core.calibration.component_fit import MIN_SAMPLES, declared_estimator, flight_by_flight, recorded_outputs
from hdt_core.components import Component, Limit
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.records.keys import LEG, PACK
from hdt_core.tracking.component_units import (
    _as_built,
    _calibrate_pack,
    _prior,
    _reject_beyond_range,
    _second_level,
    _strays,
    health_by_prior,
    pack_models,
    unit_health,
)
from hdt_core.tracking.loss_filter import checkpoint_rows, read_checkpoints
from hdt_core.tracking.multiple_model_filter import start
from hdt_core.tracking.sisters import design_offset
from hdt_core.tracking.wear_model import Settings

PUMP = PhysicsModel(
    name="pump",
    inputs=(Signal("speed", "1/s"),),
    outputs=(Signal("lift", "m", sigma=0.01), Signal("unseen", "m")),
    params=(
        Param("pmp_size", "m", 2.0, (0.5, 2.1), "design", sd=0.2),
        Param("pmp_loss", "-", 0.0, (-0.1, 0.9), "health", drift=0.01),
    ),
    equations=lambda speed, pmp_size, pmp_loss: (pmp_size * speed * (1.0 - pmp_loss), speed),
)
PART = Component("PMP", "pump", "lift lost", PUMP, "pmp_loss", Limit(0.3, 0.05, 0.05), 100.0, "look")


def samples(lift: list[float], each: int = 4, speed: float = 1.0) -> pl.DataFrame:
    """A flight for each lift, of so many samples."""
    return samples_of(flights(len(lift), lift=lift, speed=speed), each)


def test_flights_start_from_last_converged():
    """The first in the middle of the bounds, and none of fewer than three samples."""
    starts: list = []

    def estimate(problem):
        starts.append(float(problem.prior.mean[0]))
        status = "converged" if len(starts) % 2 else "max_steps"
        belief = SimpleNamespace(mean=np.array([0.1 * len(starts)]), sd=np.array([0.01]))
        return SimpleNamespace(belief=belief, status=status, n_evals=7)

    rows = samples([1.8] * 5, 3)
    short = rows.filter((pl.col("flight_id") != "T-1_001") | (pl.col("time_utc").dt.minute() > 0))
    result = flight_by_flight(short, PUMP, ["pmp_loss"], estimator=SimpleNamespace(name="x", estimate=estimate))
    assert result["flight_id"].to_list() == ["T-1_000", "T-1_002", "T-1_003", "T-1_004"]
    assert starts == pytest.approx([0.4, 0.1, 0.1, 0.3])
    assert result["status"].to_list() == ["converged", "max_steps"] * 2
    assert result.select("pmp_loss", "pmp_loss_sd", "n_evals").row(3) == pytest.approx((0.4, 0.01, 7))


def test_recorded_outputs_are_listed():
    assert (MIN_SAMPLES, recorded_outputs(PUMP, samples([1.8]))) == (3, ["lift"])


@pytest.mark.parametrize(
    ("calm", "off", "stray"),
    [([-1.0] * 10 + [0.0] * 3 + [1.0] * 10, 7.36, 0), ([-1.0] * 10 + [0.0] * 3 + [1.0] * 10, 7.46, 1),
     ([-1.0] * 10 + [0.0] * 3 + [1.0] * 10, -7.46, 1), ([0.0] * 9, 4.9e-9, 0), ([0.0] * 9, 5.1e-9, 1)],
)  # fmt: skip
def test_stray_lies_five_deviations_off(calm, off, stray):
    """Half of the flights lie within 1 of the median: a deviation is 1.4826; without any scatter a billionth."""
    assert _strays(flights(len(calm) + 1, pmp_loss=[*calm, off]), "pmp_loss").height == stray


@pytest.fixture
def legs() -> pl.DataFrame:
    """150 flights, of which the fourth is no good."""
    reason = pl.when(pl.int_range(150) == 3).then(pl.lit("SHORT")).otherwise("reason")
    return flights(150, reason="").with_columns(reason.alias("reason"))


@pytest.mark.parametrize(("life", "n_flights"), [(50.0, 10), (99.0, 10), (300.0, 30), (2000.0, 100)])
def test_first_tenth_of_life_is_baseline(legs, life, n_flights):
    """Ten to a hundred flights."""
    baseline = _as_built(legs, log(), replace(PART, life_flights=life))
    assert baseline.height == n_flights
    assert baseline["flight_id"].to_list()[:5] == ["T-1_000", "T-1_001", "T-1_002", "T-1_004", "T-1_005"]


@pytest.mark.parametrize(
    ("life", "n_flights", "last"),
    [(50.0, 10, "T-1_010"), (99.0, 10, "T-1_010"), (300.0, 14, "T-1_014"), (2000.0, 14, "T-1_014")],
)
def test_baseline_ends_before_replacement(legs, life, n_flights, last):
    """On the day of flight 24: of the 25 flights of the first unit the last ten are about the work."""
    baseline = _as_built(legs, log(("T-1", 1, "PMP", "REPLACED", 24)), replace(PART, life_flights=life))
    assert (baseline.height, baseline["flight_id"].to_list()[-1]) == (n_flights, last)


def lifts_of(n: int) -> pl.DataFrame:
    """A pack's samples by a size of 1.9 m."""
    rng = np.random.default_rng(1)
    rows = samples([1.8] * n, 5).with_columns(speed=pl.Series(rng.uniform(0.5, 1.5, 5 * n)))
    return rows.with_columns(lift=1.9 * pl.col("speed") + pl.Series(0.01 * rng.standard_normal(5 * n)))


def test_nine_flights_calibrate_no_pack():
    stray, design = _calibrate_pack(lifts_of(9), PART)
    assert (stray.height, len(design)) == (0, 0)


def test_ten_flights_calibrate_a_pack():
    rows = lifts_of(10)
    stray, design = _calibrate_pack(rows, PART)
    assert (stray.height, len(design)) == (0, 2)
    name, value, sd, unit, count, identifiable, version, made_by = design[0]
    assert (name, unit, count, identifiable, len(version), made_by) == ("pmp_size", "m", 10, True, 12, "nls")
    assert value == pytest.approx(1.9, abs=0.01)
    assert sd == pytest.approx(0.01 / np.sqrt((rows["speed"] ** 2).sum()), rel=0.2)


def test_stray_flight_calibrates_nothing():
    halved = pl.when(pl.col("flight_id") == "T-1_004").then(0.5).otherwise(1.0)
    stray, design = _calibrate_pack(lifts_of(10).with_columns(lift=pl.col("lift") * halved), PART)
    assert (stray["flight_id"].to_list(), design[0][4]) == (["T-1_004"], 9)
    assert design[0][1] == pytest.approx(1.9, abs=0.01)


def test_declared_estimator_is_used():
    """For design and health: a swarm ends where least squares does, and takes longer."""
    rows = samples([1.9 + 0.01 * (-1) ** k for k in range(12)])
    legs = rows.select(LEG).unique(maintain_order=True).with_columns(reason=pl.lit(""))
    losses = {}
    n_evals = {}
    for method in ("nls", "pso"):
        part = replace(PART, estimator=method)
        design = rows.select(PACK).head(1).with_columns(component=pl.lit("PMP")).join(
            pl.DataFrame([r[:6] for r in _calibrate_pack(rows, part)[1][:1]], orient="row",
                         schema=["parameter", "value", "sd", "unit", "n_flights", "identifiable"]), how="cross",
        )  # fmt: skip
        assert design["value"].to_list() == pytest.approx([1.9], abs=1e-3)
        estimates, (health, _) = unit_health(rows.with_columns(nominal=True), legs, design, log(), part)
        losses[method] = health["value"]
        n_evals[method] = estimates["n_evals"].median()
    np.testing.assert_allclose(losses["pso"], losses["nls"], atol=1e-4)
    assert n_evals["pso"] > 5 * n_evals["nls"]


def test_unknown_estimator_is_refused():
    with pytest.raises(ValueError, match=r"component PMP: estimator is nls, pso, ekf, ukf, pinn.*, not guess"):
        declared_estimator(replace(PART, estimator="guess"))


@pytest.mark.parametrize(
    ("is_calibrated", "expected"),
    [
        (True, [("SHORT", False), ("", True), ("STRAY", False), ("", True)]),
        (False, [("SHORT", False), *[("NOT_COMMISSIONED", False)] * 3]),
    ],
)
def test_second_level_names_its_reasons(is_calibrated, expected):
    legs = flights(4, reason=["SHORT", "", "", ""])
    n = int(is_calibrated)
    rows = _second_level(legs, legs.select(LEG)[2 : 2 + n], legs.select(PACK).unique()[:n])
    assert rows.select("reason", "admitted").rows() == expected


def test_prior_names_its_version():
    assert _prior(PART) == [("pmp_size", 2.0, 0.2, "m", 0, False, f"prior {PART.version}", "prior")]


@pytest.mark.parametrize(("loss", "status"), [(-0.0991, "not_identifiable"), (-0.0989, "converged")])
def test_loss_at_bound_is_unidentifiable(loss, status):
    """A thousandth of the span of 1 above -0.1."""
    rows = flights(1, pmp_loss=loss).with_columns(status=pl.lit("converged"))
    assert _reject_beyond_range(rows, samples([1.0]), PART)["status"].to_list() == [status]


def test_design_offset_spans_design_bounds():
    """A lift of 1.7 is a loss of 0.15 at a size of 2 m, of 0.19 at 2.1 m, as large as it may be."""
    built = design_offset(samples([1.7, 1.7]), PUMP, PART)
    assert built == (pytest.approx(0.0, abs=1e-6), pytest.approx(np.log(2.1 / 2.0), abs=1e-6), None)


def test_flights_move_the_prior():
    """Which stays as unsure as the design."""
    rows = flights(4, pmp_loss=[0.15, 0.15, None, 0.15], pmp_loss_sd=[0.02, None, 0.1, 0.02])
    status = pl.Series(["converged"] * 3 + ["not_identifiable"])
    built = design_offset(samples([1.7, 1.7]), PUMP, PART)
    health = health_by_prior(rows.with_columns(status=status), built.sd, PART)
    shift_var = (0.15 - (1.0 - 1.7 / 2.1)) ** 2
    weight = 0.15**2 / (0.15**2 + 0.02**2 + shift_var)
    np.testing.assert_allclose(health["value"], [weight * 0.15, 0.0, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(health["sd"], [0.15 * np.sqrt(1.0 - weight), 0.15, 0.15, 0.15], rtol=1e-6)
    assert set(health["status"]) == {"prior_only"}


def test_pack_models_follow_design_order():
    """A model rests on the prior where no flight calibrated its pack."""
    sizes = np.linspace(1.0, 2.0, 40)
    design = pl.DataFrame(
        {
            "operator": "TST",
            "tail": [f"T-{k * 7 % 40}" for k in range(40)],
            "pack": 1,
            "component": "PMP",
            "parameter": "pmp_size",
            "value": sizes,
            "n_flights": [0, 12] * 20,
        }
    )
    rows = samples([1.8]).with_columns(tail=pl.lit("T-7"))
    other = design.with_columns(component=pl.lit("OTHER"), value=pl.lit(9.9))
    models, on_prior, own = zip(*pack_models(rows, pl.concat([other, design]), PART), strict=True)
    np.testing.assert_allclose([model.nominal["pmp_size"] for model in models], sizes)
    assert list(on_prior) == [True, False] * 20
    assert [frame.height for frame in own] == [0, 4] + [0] * 38


PACKS = pl.DataFrame({"operator": ["TST"] * 2, "tail": ["A", "B"], "pack": [1, 1]}).cast({"pack": pl.Int32})
PACKS = PACKS.with_columns(component=pl.lit("PMP"), parameter=pl.lit("pmp_loss"))
IDS = [["a0", "a1", "a2", "a3"], ["b0", "b1"]]


STATE = start(Settings(0.0, 0.01, 0.05))
each_night = pytest.mark.parametrize(
    ("segments", "now", "begin"),
    [
        ([1, 2, 3], IDS, [2, 0]), ([1, 2], IDS, [1, 0]), ([1], IDS, [0, 0]), ([1, 3], IDS, [0, 0]),
        ([2, 3], IDS, [2, 0]),
        ([1, 2, 3], [["a0", "a1", "a2", "other"], ["b0"]], [1, 0]),
        ([1, 2, 3], [["a0", "x", "y", "z"], ["b0"]], [0, 0]),
    ],
)  # fmt: skip


def stored_rows(segments: list[int]) -> pl.DataFrame:
    """Checkpoints of the first pack after these segments, beside that of its start."""
    return checkpoint_rows(PACKS, IDS, read_checkpoints(None, PACKS, IDS), {(0, c): STATE for c in [0, *segments]})


@each_night
def test_night_resumes_before_last_segment(segments, now, begin):
    """The last that stands, and not before what is stored."""
    result = read_checkpoints(stored_rows(segments), PACKS, now)
    assert result.begin.tolist() == begin
    assert list(result.checkpoints) == ([(0, begin[0])] if begin[0] else [])
    for one in result.checkpoints.values():
        for name in ("log_weight", "mean", "cov", "pace", "since", "unlogged", "faulty"):
            np.testing.assert_array_equal(getattr(one, name), getattr(STATE, name))


@each_night
def test_start_is_not_stored(segments, now, begin):
    assert stored_rows(segments)["chapter"].unique().sort().to_list() == segments


@each_night
def test_other_parameter_begins_anew(segments, now, begin):
    others = read_checkpoints(stored_rows(segments), PACKS.with_columns(parameter=pl.lit("pmp_leak")), now)
    assert (others.begin.tolist(), others.valid.height) == ([0, 0], 0)


@each_night
def test_new_checkpoints_join_valid_ones(segments, now, begin):
    result = read_checkpoints(stored_rows(segments), PACKS, now)
    again = checkpoint_rows(PACKS, now, result, {(0, 2): STATE._replace(mean=STATE.mean + 1.0), (1, 0): STATE})
    expected = sorted({c for c in segments if now[0][c] == IDS[0][c]} | {2})
    assert again["chapter"].unique().sort().to_list() == expected
    assert again.filter(chapter=2)["seen"].unique().to_list() == [now[0][2]]
    assert again.filter(chapter=2).height == len(STATE.pack)
