"""What a wash or a replacement leaves, and the chances after it."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hdt_core.prognosis.choices import EVENTS, Washes, forecast_choices, learn_washes
from hdt_core.prognosis.fleet_record import FleetRecord
from hdt_core.prognosis.service import update_model
from hdt_core.tracking.multiple_model_filter import WASH_LEAVES, WASH_LEAVES_SD
from pipelines.learned import shipped_base

PACK_1 = {"operator": "XXX", "tail": "LX-T00", "pack": 1}
START = datetime(2024, 1, 1, tzinfo=UTC)


UNSEEN = np.array([""])
VALUES = ("loss", "share_left", "share_left_sd", "fault")


def make_washes(n: int, loss: float = 0.2, share_left: float = 0.6, finding: str = "") -> Washes:
    """So many washes after the same loss, measured without an error."""
    return Washes(np.full(n, loss), np.full(n, share_left), np.zeros(n), np.full(n, finding))


@given(
    loss=st.floats(-0.1, 0.9),
    chances=arrays(float, (7, len(EVENTS)), elements=st.floats(0.0, 1.0)),
    n_washes=st.integers(0, 9),
)
def test_chance_never_rises_with_thoroughness(loss, chances, n_washes):
    left = iter(chances)

    def predict(numbers, losses):
        own = pl.DataFrame([next(left) for _ in numbers], schema=EVENTS, orient="row")
        return own.with_columns(
            **{k: pl.lit(v) for k, v in PACK_1.items()},
            flight_id=pl.lit("F"),
            component=pl.lit("HX"),
            departed_at=pl.lit(START),
        )

    rows = forecast_choices(
        pl.DataFrame([PACK_1 | {"flight_id": "F"}]), np.array([loss]), "HX", make_washes(n_washes), predict
    )

    assert rows["choice"].to_list() == ["defer", "wash", "replace"]
    assert (np.diff(rows.select(EVENTS).to_numpy(), axis=0) <= 0.0).all()


@given(loss=st.floats(-0.1, 0.9), share_left=st.floats(0.0, 1.0), n_washes=st.integers(0, 9))
def test_wash_leaves_part_of_loss(loss, share_left, n_washes):
    left = make_washes(n_washes, loss, share_left).losses_left(np.array([loss]), UNSEEN)

    assert (left >= min(loss, 0.0)).all()
    assert (left <= loss).all()


def test_deferring_equals_published_prognosis(fleet):
    update = update_model(shipped_base(), None, FleetRecord(*fleet))

    deferred = update.choices.filter(choice="defer").sort("component", "tail", "pack")

    keys = ["component", "tail", "pack", "flight_id"]
    published = deferred.select(keys).join(update.prognoses, on=keys, how="left", validate="1:1")
    np.testing.assert_array_equal(deferred[EVENTS].to_numpy(), published[EVENTS].to_numpy())
    assert deferred.height == 16


@pytest.mark.parametrize(
    ("n_washes", "loss", "rests_on"), [(4, 0.2, "prior"), (5, 0.2, "5 washes"), (9, 0.34, "prior")]
)
def test_few_like_washes_keep_prior(n_washes, loss, rests_on):
    washes = make_washes(n_washes)
    losses = np.array([loss])

    mean, sd = washes.share_left_of(losses, UNSEEN)

    assert washes.rests_on(losses, UNSEEN) == [rests_on]
    assert ((mean, sd) == (WASH_LEAVES, WASH_LEAVES_SD)) == (rests_on == "prior")


def test_prior_counts_as_one_wash():
    mean, sd = make_washes(5).share_left_of(np.array([0.2]), UNSEEN)

    assert mean[0] == pytest.approx((5 * 0.6 + WASH_LEAVES) / 6)
    assert sd[0] == pytest.approx(np.sqrt((WASH_LEAVES_SD**2 + 0.25**2 + 5 * 0.05**2) / 6))


@pytest.mark.parametrize(("finding", "share_left"), [("CLOGGED", 0.1), ("FOULED", 0.6), ("", 0.35)])
def test_wash_effect_follows_finding(finding, share_left):
    clogged = make_washes(500, share_left=0.1, finding="CLOGGED")
    fouled = make_washes(500, share_left=0.6, finding="FOULED")
    both = Washes(*(np.concatenate([getattr(w, name) for w in (clogged, fouled)]) for name in VALUES))

    mean, _ = both.share_left_of(np.array([0.2]), np.array([finding]))

    assert mean[0] == pytest.approx(share_left, abs=0.001)


def test_rare_finding_keeps_prior():
    assert make_washes(9, finding="FOULED").rests_on(np.array([0.2]), np.array(["CLOGGED"])) == ["prior"]


def log_line(day: int, action: str, finding: str) -> dict:
    at = START + timedelta(days=day)
    work = {"position": 1, "flown_from": at, "in_force": True, "is_shown": True}
    return PACK_1 | work | {"action": action, "finding": finding, "counts_from": at}


def learn_from(*lines: dict) -> Washes:
    """Washes of a pack that lost 20 % until day 20 and 5 % since."""
    flights = pl.DataFrame([PACK_1 | {"departed_at": START + timedelta(days=k)} for k in range(40)])
    losses = flights.with_columns(loss=np.repeat([0.2, 0.05], 20), loss_sd=0.01)
    log = pl.DataFrame(lines)
    return learn_washes(losses, log.filter(pl.col("action") != "INSPECTED"), log)


def test_shown_washes_are_measured():
    wash = log_line(20, "CLEANED", "")

    washes = learn_from(wash, wash | {"is_shown": False})

    assert washes.share_left.tolist() == pytest.approx([0.25])
    assert washes.loss.tolist() == pytest.approx([0.2])


@pytest.mark.parametrize(
    ("inspected_on", "own", "finding"), [(18, "", "CLOGGED"), (18, "FOULED", "FOULED"), (22, "", ""), (-12, "", "")]
)
def test_wash_takes_finding_of_inspection(inspected_on, own, finding):
    washes = learn_from(log_line(inspected_on, "INSPECTED", "CLOGGED"), log_line(20, "CLEANED", own))

    assert washes.fault.tolist() == [finding]


@pytest.mark.parametrize(
    ("lines", "finding"),
    [
        ([(18, "CLOGGED")], ""),
        ([(20, "CLOGGED")], ""),
        ([(25, "CLOGGED")], "CLOGGED"),
        ([(25, "CLOGGED"), (26, "FOULED")], "FOULED"),
        ([(25, "CLOGGED"), (26, "NO_FAULT_FOUND")], ""),
    ],
)
def test_unit_has_last_inspected_finding(lines, finding):
    washes = learn_from(log_line(20, "CLEANED", ""), *(log_line(day, "INSPECTED", fault) for day, fault in lines))

    assert washes.faults_of(pl.DataFrame([PACK_1], schema_overrides={"pack": pl.Int32})).tolist() == [finding]
