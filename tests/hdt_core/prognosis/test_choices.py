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


def washed(n: int, loss: float = 0.2, share_left: float = 0.6) -> Washes:
    """So many washes after the same loss, measured without an error."""
    return Washes(np.full(n, loss), np.full(n, share_left), np.zeros(n))


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
        pl.DataFrame([PACK_1 | {"flight_id": "F"}]), np.array([loss]), "HX", washed(n_washes), predict
    )

    assert rows["choice"].to_list() == ["defer", "wash", "replace"]
    assert (np.diff(rows.select(EVENTS).to_numpy(), axis=0) <= 0.0).all()


@given(loss=st.floats(-0.1, 0.9), share_left=st.floats(0.0, 1.0), n_washes=st.integers(0, 9))
def test_wash_leaves_between_nothing_and_all(loss, share_left, n_washes):
    left = washed(n_washes, loss, share_left).losses_left(np.array([loss]))

    assert (left >= min(loss, 0.0)).all()
    assert (left <= loss).all()


def test_deferring_is_the_published_prognosis(fleet):
    update = update_model(shipped_base(), None, FleetRecord(*fleet))

    deferred = update.choices.filter(choice="defer").sort("component", "tail", "pack")

    keys = ["component", "tail", "pack", "flight_id"]
    published = deferred.select(keys).join(update.prognoses, on=keys, how="left", validate="1:1")
    np.testing.assert_array_equal(deferred[EVENTS].to_numpy(), published[EVENTS].to_numpy())
    assert deferred.height == 16


@pytest.mark.parametrize(
    ("n_washes", "loss", "rests_on"), [(4, 0.2, "prior"), (5, 0.2, "5 washes"), (9, 0.34, "prior")]
)
def test_few_like_washes_leave_the_prior(n_washes, loss, rests_on):
    washes, losses = washed(n_washes), np.array([loss])

    mean, sd = washes.share_left_of(losses)

    assert washes.rests_on(losses) == [rests_on]
    assert ((mean, sd) == (WASH_LEAVES, WASH_LEAVES_SD)) == (rests_on == "prior")


def test_prior_counts_as_one_wash():
    mean, sd = washed(5).share_left_of(np.array([0.2]))

    assert mean[0] == pytest.approx((5 * 0.6 + WASH_LEAVES) / 6)
    assert sd[0] == pytest.approx(np.sqrt((WASH_LEAVES_SD**2 + 0.25**2 + 5 * 0.05**2) / 6))


def test_shown_washes_are_measured():
    flights = pl.DataFrame([PACK_1 | {"departed_at": START + timedelta(days=k)} for k in range(40)])
    losses = flights.with_columns(loss=np.repeat([0.2, 0.05], 20), loss_sd=0.01)
    work = pl.DataFrame(
        [PACK_1 | {"position": 1, "action": "CLEANED", "flown_from": START + timedelta(days=20), "in_force": True}]
    )
    work = pl.concat([work.with_columns(is_shown=is_shown) for is_shown in (True, False)])

    washes = learn_washes(losses, work)

    assert washes.share_left.tolist() == pytest.approx([0.25])
    assert washes.loss.tolist() == pytest.approx([0.2])
