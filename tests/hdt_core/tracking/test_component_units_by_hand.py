"""A declared component's flights: which calibrate it, which stand apart, the prior moved; where a night goes on."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from by_hand import flights, log

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
    many = flights(len(lift), lift=lift).rename({"departed_at": "time_utc"}).drop("status")
    rows = pl.concat([many.with_columns(pl.col("time_utc") + pl.duration(minutes=k)) for k in range(each)])
    return rows.with_columns(speed=pl.lit(speed)).sort("time_utc")


def test_flights_start_from_last_converged():
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
    assert starts == pytest.approx([0.4, 0.1, 0.1, 0.3])  # the middle of the bounds, then where one converged
    assert result["status"].to_list() == ["converged", "max_steps"] * 2
    assert result.select("pmp_loss", "pmp_loss_sd", "n_evals").row(3) == pytest.approx((0.4, 0.01, 7))
    assert (MIN_SAMPLES, recorded_outputs(PUMP, rows)) == (3, ["lift"])


@pytest.mark.parametrize(
    ("calm", "off", "stray"),
    [([-1.0] * 10 + [0.0] * 3 + [1.0] * 10, 7.36, 0), ([-1.0] * 10 + [0.0] * 3 + [1.0] * 10, 7.46, 1),
     ([-1.0] * 10 + [0.0] * 3 + [1.0] * 10, -7.46, 1), ([0.0] * 9, 4.9e-9, 0), ([0.0] * 9, 5.1e-9, 1)],
)  # fmt: skip
def test_stray_lies_five_deviations_off(calm, off, stray):
    """Half of the flights lie within 1 of the median: a deviation is 1.4826; without any scatter a billionth."""
    assert _strays(flights(len(calm) + 1, pmp_loss=[*calm, off]), "pmp_loss").height == stray


@pytest.mark.parametrize(("life", "flights_taken"), [(50.0, 10), (99.0, 10), (300.0, 30), (2000.0, 100)])
def test_first_tenth_of_life_is_baseline(life, flights_taken):
    part = Component(*(getattr(PART, f) for f in ("code", "name", "lost", "model", "loss", "limit")), life, "look")
    reason = pl.when(pl.int_range(150) == 3).then(pl.lit("SHORT")).otherwise("reason")
    legs = flights(150, reason="").with_columns(reason.alias("reason"))
    baseline = _as_built(legs, log(), part)
    assert baseline.height == flights_taken
    assert baseline["flight_id"].to_list()[:5] == ["T-1_000", "T-1_001", "T-1_002", "T-1_004", "T-1_005"]
    # replaced on the day of flight 24: of the 25 flights of the first unit the last ten are about the work
    first = _as_built(legs, log(("T-1", 1, "PMP", "REPLACED", 24)), part)
    assert first["flight_id"].to_list()[-1] == ("T-1_010" if flights_taken == 10 else "T-1_014")
    assert first.height == (10 if flights_taken == 10 else 14)


@pytest.mark.parametrize(("n", "n_rows"), [(9, 0), (10, 2)])
def test_ten_flights_calibrate_a_pack(n, n_rows):
    rng = np.random.default_rng(1)
    rows = samples([1.8] * n, 5).with_columns(speed=pl.Series(rng.uniform(0.5, 1.5, 5 * n)))
    rows = rows.with_columns(lift=1.9 * pl.col("speed") + pl.Series(0.01 * rng.standard_normal(5 * n)))
    stray, design = _calibrate_pack(rows, PART)
    assert (stray.height, len(design)) == (0, n_rows)
    if n_rows:
        name, value, sd, unit, count, identifiable, version, made_by = design[0]
        assert (name, unit, count, identifiable, len(version), made_by) == ("pmp_size", "m", 10, True, 12, "nls")
        assert value == pytest.approx(1.9, abs=0.01)
        assert sd == pytest.approx(0.01 / np.sqrt((rows["speed"] ** 2).sum()), rel=0.2)
        halved = pl.when(pl.col("flight_id") == "T-1_004").then(0.5).otherwise(1.0)
        odd = rows.with_columns(lift=pl.col("lift") * halved)
        stray, design = _calibrate_pack(odd, PART)
        assert (stray["flight_id"].to_list(), design[0][4]) == (["T-1_004"], 9)
        assert design[0][1] == pytest.approx(1.9, abs=0.01)


def test_declared_estimator_is_used():
    rows = samples([1.9 + 0.01 * (-1) ** k for k in range(12)])
    legs = rows.select(LEG).unique(maintain_order=True).with_columns(reason=pl.lit(""))
    none = log()
    losses = {}
    n_evals = {}
    for method in ("nls", "pso"):
        part = replace(PART, estimator=method)
        design = rows.select(PACK).head(1).with_columns(component=pl.lit("PMP")).join(
            pl.DataFrame([r[:6] for r in _calibrate_pack(rows, part)[1][:1]], orient="row",
                         schema=["parameter", "value", "sd", "unit", "n_flights", "identifiable"]), how="cross",
        )  # fmt: skip
        assert design["value"].to_list() == pytest.approx([1.9], abs=1e-3)
        flown, (health, _) = unit_health(rows.with_columns(nominal=True), legs, design, none, part)
        losses[method] = health["value"]
        n_evals[method] = flown["n_evals"].median()
    np.testing.assert_allclose(losses["pso"], losses["nls"], atol=1e-4)
    assert n_evals["pso"] > 5 * n_evals["nls"]
    with pytest.raises(ValueError, match=r"component PMP: estimator is nls, pso, ekf, ukf, pinn.*, not guess"):
        declared_estimator(replace(PART, estimator="guess"))


def test_second_level_names_its_reasons():
    legs = flights(4, reason=["SHORT", "", "", ""])
    key = legs.select(LEG)
    pack = legs.select(PACK).unique()
    own = _second_level(legs, key[2:3], pack)
    assert own.select("reason", "admitted").rows() == [("SHORT", False), ("", True), ("STRAY", False), ("", True)]
    none = _second_level(legs, key.clear(), pack.clear())
    assert none["reason"].to_list() == ["SHORT", *["NOT_COMMISSIONED"] * 3]
    assert not none["admitted"].any()
    assert _prior(PART) == [("pmp_size", 2.0, 0.2, "m", 0, False, f"prior {PART.version}", "prior")]


@pytest.mark.parametrize(("loss", "status"), [(-0.0991, "not_identifiable"), (-0.0989, "converged")])
def test_loss_at_bound_is_unidentifiable(loss, status):
    """A thousandth of the span of 1 above -0.1."""
    rows = flights(1, pmp_loss=loss).with_columns(status=pl.lit("converged"))
    assert _reject_beyond_range(rows, samples([1.0]), PART)["status"].to_list() == [status]


def test_flights_move_the_prior():
    """A lift of 1.7 is a loss of 0.15 at a size of 2 m, of 0.19 at 2.1 m, as large as it may be."""
    built = design_offset(samples([1.7, 1.7]), PUMP, PART)
    assert built == (pytest.approx(0.0, abs=1e-6), pytest.approx(np.log(2.1 / 2.0), abs=1e-6), None)
    rows = flights(4, pmp_loss=[0.15, 0.15, None, 0.15], pmp_loss_sd=[0.02, None, 0.1, 0.02])
    status = pl.Series(["converged"] * 3 + ["not_identifiable"])
    health = health_by_prior(rows.with_columns(status=status), built.sd, PART)
    shift_var = (0.15 - (1.0 - 1.7 / 2.1)) ** 2
    weight = 0.15**2 / (0.15**2 + 0.02**2 + shift_var)
    np.testing.assert_allclose(health["value"], [weight * 0.15, 0.0, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(health["sd"], [0.15 * np.sqrt(1.0 - weight), 0.15, 0.15, 0.15], rtol=1e-6)
    assert set(health["status"]) == {"prior_only"}


def test_pack_models_follow_design_order():
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
    models = list(pack_models(rows, pl.concat([other, design]), PART))
    np.testing.assert_allclose([model.nominal["pmp_size"] for model, _, _ in models], sizes)
    assert [on_prior for _, on_prior, _ in models] == [True, False] * 20
    assert [own.height for *_, own in models] == [0, 4] + [0] * 38


PACKS = pl.DataFrame({"operator": ["TST"] * 2, "tail": ["A", "B"], "pack": [1, 1]}).cast({"pack": pl.Int32})
PACKS = PACKS.with_columns(component=pl.lit("PMP"), parameter=pl.lit("pmp_loss"))
IDS = [["a0", "a1", "a2", "a3"], ["b0", "b1"]]


@pytest.mark.parametrize(
    ("segments", "now", "begin"),
    [
        ([1, 2, 3], IDS, [2, 0]), ([1, 2], IDS, [1, 0]), ([1], IDS, [0, 0]), ([1, 3], IDS, [0, 0]),
        ([2, 3], IDS, [2, 0]),
        ([1, 2, 3], [["a0", "a1", "a2", "other"], ["b0"]], [1, 0]),
        ([1, 2, 3], [["a0", "x", "y", "z"], ["b0"]], [0, 0]),
    ],
)  # fmt: skip
def test_night_resumes_before_last_segment(segments, now, begin):
    state = start(Settings(0.0, 0.01, 0.05))
    stored = checkpoint_rows(PACKS, IDS, read_checkpoints(None, PACKS, IDS), {(0, c): state for c in [0, *segments]})
    assert stored["chapter"].unique().sort().to_list() == segments
    others = read_checkpoints(stored, PACKS.with_columns(parameter=pl.lit("pmp_leak")), now)
    assert (others.begin.tolist(), others.valid.height) == ([0, 0], 0)
    result = read_checkpoints(stored, PACKS, now)
    assert result.begin.tolist() == begin
    assert list(result.checkpoints) == ([(0, begin[0])] if begin[0] else [])
    for one in result.checkpoints.values():
        for name in ("log_weight", "mean", "cov", "pace", "since", "unlogged", "faulty"):
            np.testing.assert_array_equal(getattr(one, name), getattr(state, name))
    again = checkpoint_rows(PACKS, now, result, {(0, 2): state._replace(mean=state.mean + 1.0), (1, 0): state})
    expected = sorted({c for c in segments if now[0][c] == IDS[0][c]} | {2})
    assert again["chapter"].unique().sort().to_list() == expected
    assert again.filter(chapter=2)["seen"].unique().to_list() == [now[0][2]]
    assert again.filter(chapter=2).height == len(state.pack)
