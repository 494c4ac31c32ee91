"""The pass through all flights: batched equals literal, nothing from the future, honest about what can't be known."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import polars as pl
import pytest
from literal_track import fouling as both_tracks
from twin_flights import NO_LOG, entry, flights_with_loss

from hdt_core.tracking.track import track

IN_ORDER = ["operator", "tail", "pack", "departed_at", "flight_id"]


def fouling(*of, **how) -> pl.DataFrame:
    return both_tracks(*of, **how).filter(pl.col("parameter") == "hx_fouling")


def fouled(frame: pl.DataFrame) -> np.ndarray:
    return frame.filter(pl.col("parameter") == "hx_fouling").sort(IN_ORDER)["value"].to_numpy()


def test_batched_pass_equals_literal_recursion(flights, model):
    parts = [flights.filter(pl.col("tail") == "T-01").head(90), flights.filter(pl.col("tail") != "T-01")]
    uneven = pl.concat(parts).sort(IN_ORDER)
    batched, literal = (fouling(uneven, NO_LOG, model, literal=way) for way in (False, True))
    assert batched.equals(literal)


@pytest.fixture(scope="module")
def whole(flights, model):
    """Track of all flights, without a log."""
    return track(flights, NO_LOG, model).health


def test_later_flights_change_no_estimate(flights, model, fleet):
    """Nor does a later entry of the log."""
    cut = flights["departed_at"].min() + timedelta(days=70)
    causal = ~pl.col("parameter").str.ends_with("_smoothed")
    later_log = log_replacement(fleet, "T-00", 90)
    early = track(flights.filter(pl.col("departed_at") < cut), NO_LOG, model).health.filter(causal)
    same = track(flights, later_log, model).health.filter(causal, pl.col("departed_at") < cut)
    assert early.select(*IN_ORDER, "parameter", "status").equals(same.select(*IN_ORDER, "parameter", "status"))
    for column in ("value", "sd"):
        np.testing.assert_allclose(early[column].to_numpy(), same[column].to_numpy(), atol=1e-12, rtol=0)


def test_earlier_work_changes_no_estimate(flights, model, fleet, whole):
    first = flights["departed_at"].min()
    long_ago = log_replacement(fleet, "T-00", 0).with_columns(done_on=pl.lit(first.date() - timedelta(days=40)))
    assert track(flights, long_ago, model).health.equals(whole)


@pytest.fixture(scope="module")
def with_truth(whole, fleet):
    """Fouling beside the true loss."""
    return whole.filter(parameter="hx_fouling").join(fleet.truth, on=["tail", "flight_id", "pack"])


def test_recovers_true_fouling(with_truth):
    off = with_truth["value"].to_numpy() - with_truth["loss"].to_numpy()
    assert np.abs(off).mean() < 0.03
    assert np.mean(np.abs(off) < 1.645 * with_truth["sd"].to_numpy()) > 0.75


def test_worn_packs_are_ranked_by_loss(with_truth):
    worn = with_truth.filter(pl.col("loss").max().over("tail", "pack") > 0.2)
    for pack in worn.partition_by("tail", "pack"):
        assert pack.select(pl.corr("value", "loss", method="spearman")).item() > 0.97


def test_intervals_cover_many_units(model):
    rng = np.random.default_rng(3)
    off = []
    sd = []
    packs = []
    truth = {}
    for k in range(120):
        at_entry = 0.0 if rng.random() < 0.5 else rng.exponential(0.08)
        loss = 1.0 - np.exp(-(at_entry + rng.choice([2e-4, 1e-3, 2e-3]) * np.arange(60)))
        tail = f"S-{k:03d}"
        packs.append(flights_with_loss(model, loss, offset=rng.normal(0.0, model.offset_sd), seed=k, tail=tail))
        truth[tail] = loss
    rows = fouling(pl.concat(packs).sort(IN_ORDER), NO_LOG, model)
    for pack in rows.partition_by("tail"):
        off.append(pack["value"].to_numpy() - truth[pack["tail"][0]])
        sd.append(pack["sd"].to_numpy())
    covered = np.abs(np.array(off)) < 1.645 * np.array(sd)
    assert 0.82 < covered.mean() < 0.98
    assert abs(np.mean(off)) < 0.015


def test_replacement_sharpens_the_estimate(model):
    loss = np.r_[np.linspace(0.15, 0.45, 80), np.linspace(0.0, 0.05, 60)]
    twin = flights_with_loss(model, loss, offset=0.05)
    rows = fouling(twin, entry(twin, 80, "HX", "REPLACED"), model)
    assert rows["sd"][5] > 2.0 * rows["sd"][100]
    np.testing.assert_allclose(rows["value"].to_numpy()[90:], loss[90:], atol=0.02)


def test_late_entry_ends_as_punctual_one(model):
    twin = flights_with_loss(model, np.r_[np.linspace(0.0, 0.4, 100), np.zeros(40)])
    punctual, late = (fouling(twin, entry(twin, k, "HX", "REPLACED"), model)["value"].to_numpy() for k in (100, 105))
    np.testing.assert_allclose(punctual[110:], late[110:], atol=0.01)


def test_unlogged_replacement_is_inferred(model):
    worn = np.linspace(0.05, 0.3, 100)
    new = np.linspace(0.0, 0.05, 60)
    silent = []
    logged = []
    for k, unit in enumerate(np.linspace(-0.08, 0.02, 6)):
        twin = flights_with_loss(model, np.r_[worn, new], offset=np.r_[np.zeros(100), np.full(60, unit)], seed=k)
        elsewhere = entry(twin, 20, "SENSOR", "INSPECTED")
        for log, off in ((NO_LOG, silent), (elsewhere, logged)):
            off.append(np.abs(fouling(twin, log, model)["value"].to_numpy()[120:] - new[20:]).mean())
    assert np.mean(silent) < 0.025
    # a log that speaks of other work and not of this makes a wash or a fault the likelier story
    assert np.mean(logged) > np.mean(silent)


def test_wash_leaves_part_of_wear(model):
    loss = np.r_[np.linspace(0.0, 0.3, 90), np.linspace(0.08, 0.12, 60)]
    twin = flights_with_loss(model, loss, offset=-0.04)
    rows = fouling(twin, entry(twin, 90, "HX", "CLEANED"), model)
    off = rows["value"].to_numpy() - loss
    # what was not known of the unit before the wash is not known after it either, and no more than that
    np.testing.assert_allclose(off[100:], off[80:90].mean(), atol=0.03)
    assert (np.abs(off) < 2.0 * rows["sd"].to_numpy()).all()


def test_passing_fault_leaves_all_wear(model):
    twin = flights_with_loss(model, np.linspace(0.0, 0.08, 120))
    shifted = pl.int_range(pl.len()).is_between(50, 70)
    faulty = twin.with_columns(ln_ua_ratio=pl.col("ln_ua_ratio") - 0.35 * shifted.cast(pl.Float64))
    sound, during = (fouling(frame, NO_LOG, model) for frame in (twin, faulty))
    np.testing.assert_allclose(during["value"].to_numpy()[80:], sound["value"].to_numpy()[80:], atol=0.02)
    # while it lasts nobody can tell it from a clog, and the estimate says so
    assert (during["sd"].to_numpy()[53:70] > 2.0 * sound["sd"].to_numpy()[53:70]).all()


def test_flights_without_cruise_are_predicted(model):
    twin = flights_with_loss(model, np.zeros(20))
    blind = twin.with_columns(ln_ua_ratio=pl.lit(None, pl.Float64), status=pl.lit("no_cruise"))
    rows = fouling(blind, NO_LOG, model)
    assert rows["status"].unique().to_list() == ["predicted"]
    assert rows["value"].is_finite().all()
    assert (rows["sd"] > 0.04).all()


def test_clog_is_followed(model):
    rows = fouling(flights_with_loss(model, np.repeat([0.05, 0.25], 60)), NO_LOG, model)
    np.testing.assert_allclose(rows["value"].to_numpy()[-1], 0.25, atol=0.05)


def test_stray_flight_moves_little(model):
    twin = flights_with_loss(model, np.full(80, 0.1))
    stray = twin.with_columns(ln_ua_ratio=pl.when(pl.int_range(pl.len()) == 50).then(-0.9).otherwise("ln_ua_ratio"))
    a, b = (fouling(frame, NO_LOG, model)["value"].to_numpy() for frame in (twin, stray))
    assert abs(a[60] - b[60]) < 0.01


def test_vouched_step_is_followed_quickly(model):
    """A blockage of 37 % for six flights: within two, where other sensors vouch for those of the ratio."""
    twin = flights_with_loss(model, np.repeat([0.09, 0.37, 0.0], [60, 6, 10]))
    quiet = twin.with_columns(
        exit_apart_k=pl.lit(0.1),
        flows_apart_ln=pl.lit(0.001),
        tat_apart_k=pl.lit(-0.05),
        ratio_per_exit_k=pl.lit(-0.05),
        ratio_per_ln_flow=pl.lit(0.8),
        ratio_per_tat_k=pl.lit(0.026),
    )
    vouched, alone = (
        fouling(frame, NO_LOG, model).select("value", "sd").to_numpy()[61:66].T for frame in (quiet, twin)
    )
    np.testing.assert_allclose(vouched[0], 0.37, atol=0.07)
    assert (np.abs(vouched[0] - 0.37) < vouched[1]).all()
    assert (vouched[1] < alone[1]).all()
    assert (np.abs(alone[0] - 0.37) < 1.645 * alone[1]).all()


def test_smoothing_reduces_error(model):
    rng = np.random.default_rng(11)
    sensors_sd = np.sqrt(model.offset_sd**2 - 0.03**2)
    frames = []
    logs = []
    truth = []
    for k in range(60):
        worn = rng.choice([0.0, 0.05, 0.15])
        loss = np.r_[worn + np.linspace(0.0, 0.15, 40), np.linspace(0.0, 0.03, 30)]
        unit = np.repeat(rng.normal(0.0, 0.03, 2), [40, 30])
        offset = rng.normal(0.0, sensors_sd) + unit
        frames.append(flights_with_loss(model, loss, offset=offset, seed=k, tail=f"S-{k:02d}"))
        logs.append(entry(frames[-1], 40, "HX", "REPLACED"))
        truth.append(loss)
    rows = both_tracks(pl.concat(frames).sort(IN_ORDER), pl.concat(logs), model)
    names = ("hx_fouling", "hx_fouling_smoothed")
    own = [rows.filter(pl.col("parameter") == n).sort(IN_ORDER) for n in names]
    values, sds = ([f[c].to_numpy().reshape(60, 70) for f in own] for c in ("value", "sd"))
    squares = [np.mean((v - np.array(truth))[:, :40] ** 2) for v in values]
    assert squares[1] < squares[0]
    assert sds[1][:, :40].mean() < sds[0][:, :40].mean()
    # on the last flight there is nothing to look back from
    np.testing.assert_allclose(values[1][:, -1], values[0][:, -1], atol=1e-12)


@pytest.mark.parametrize("n_flights", [1, 3])
def test_short_record_has_wide_estimates(model, n_flights):
    rows = fouling(flights_with_loss(model, np.zeros(n_flights)), NO_LOG, model)
    assert rows["value"].is_not_null().all()
    assert (rows["sd"] > 0.5 * model.offset_sd * 0.5).all()


def test_flights_have_each_parameter_once(flights, whole):
    assert whole.select("tail", "flight_id", "pack", "parameter").is_duplicated().sum() == 0
    assert whole.height == flights.height * whole["parameter"].n_unique()


def test_hidden_parameters_have_no_value(whole):
    hidden = whole.filter(status="not_identifiable")
    assert hidden["value"].null_count() == hidden.height == hidden["sd"].null_count()


def test_values_have_deviations(whole):
    assert (whole.filter(pl.col("value").is_not_null())["sd"].fill_null(-1.0) >= 0.0).all()


def test_no_flights_give_no_rows(flights, model):
    assert track(flights.clear(), NO_LOG, model).health.height == 0


def test_unsure_level_widens_estimates(flights, model):
    models = (model, replace(model, clean_level_sd=0.1))
    sure, unsure = (fouling(flights.sort(IN_ORDER), NO_LOG, m)["sd"].mean() for m in models)
    assert unsure > sure


def log_replacement(fleet, tail: str, k: int) -> pl.DataFrame:
    day = fleet.legs.filter(pl.col("tail") == tail).sort("departed_at")["departed_at"].dt.date().unique().sort()[k]
    row = {"operator": "TST", "tail": tail, "pack": 1, "component": "HX", "action": "REPLACED", "done_on": day}
    return pl.DataFrame([row], schema=NO_LOG.schema)
