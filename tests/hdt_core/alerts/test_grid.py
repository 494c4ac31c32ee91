"""The fleet as arrays, and no alert that rests on a prior: what a flight did not move raises nothing."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from one_pack import alerts, departure, features, work

from hdt_core.alerts.cases import UNOBSERVED, Grid, Limits
from hdt_core.alerts.component_alerts import raise_component_alerts
from hdt_core.components import components


def grid_of(*flown: tuple[str, int, float]) -> Grid:
    """Flight, pack and x of each leg."""
    rows = pl.DataFrame(flown, schema={"flight_id": pl.String, "pack": pl.Int32, "x": pl.Float64}, orient="row")
    day = pl.col("flight_id").str.slice(1).cast(pl.Int64)
    departed_at = datetime(2024, 1, 1, tzinfo=UTC) + day * timedelta(days=1)
    return Grid.from_frame(rows.with_columns(departed_at=departed_at, operator=pl.lit("TST"), tail=pl.lit("T-1")))


LEGS = (("F1", 1, 1.0), ("F1", 2, 2.0), ("F2", 1, 3.0), ("F3", 1, 5.0), ("F3", 2, 6.0))


def test_across_reads_other_pack():
    grid = grid_of(*LEGS)
    np.testing.assert_array_equal(grid.across(grid.values("x")), [[2.0, np.nan, 6.0], [1.0, 5.0, np.nan]])
    assert grid.across(grid.values("x") > 2.0).tolist() == [[False, False, True], [False, True, False]]


def test_grid_counts_flights_of_packs():
    grid = grid_of(*LEGS)
    assert (grid.partner().tolist(), grid.count(0), grid.count(1)) == ([1, 0], 3, 2)


def test_lone_pack_has_no_partner():
    one = grid_of(LEGS[0])
    assert (one.shape, one.is_flight.tolist(), one.partner().tolist()) == ((1, 1), [[True]], [-1])


def test_grid_of_no_flights_is_empty():
    assert grid_of().shape == (0, 0)


N = 40
NO_WORK = work(departure(0)).clear()
BEFORE_ANY = np.zeros(N, dtype=bool)


def status(observed: np.ndarray, otherwise: str = "predicted") -> pl.Series:
    return pl.Series("s", np.where(observed, "ok", otherwise))


@pytest.mark.parametrize("observed", [BEFORE_ANY, np.arange(N) < 10])
@pytest.mark.parametrize("otherwise", UNOBSERVED)
def test_unobserved_drift_raises_nothing(observed, otherwise):
    drift = features(np.linspace(0.0, 0.6, N)).with_columns(
        status(observed, otherwise).alias("hx_fouling_status"), pl.lit(None, pl.Float64).alias("hx_fouling_flight"),
        hx_passage_300=pl.Series(np.where(observed, 0.0, 0.99)), hx_fouling_step_3=pl.lit(0.0),
    )  # fmt: skip
    assert alerts(drift, NO_WORK)["diagnosis"].to_list() == []


def test_partly_observed_wear_raises_alert():
    worn = features(np.where(np.arange(N) < 10, 0.0, 0.3)).with_columns(
        status(np.arange(N) % 2 == 0).alias("hx_fouling_status"), hx_fouling_step_3=pl.lit(0.0)
    )
    assert alerts(worn, NO_WORK)["diagnosis"].to_list() == ["HX_FOULING"]


def test_unobserved_next_unit_raises_nothing():
    observed = np.arange(N) < 20
    worn = features(np.full(N, 0.3)).with_columns(
        status(observed).alias("hx_fouling_status"),
        pl.when(pl.Series(observed)).then("hx_fouling_flight").alias("hx_fouling_flight"),
        hx_fouling_step_3=pl.lit(0.0),
    )
    cases = alerts(worn, work(departure(20), timed=True))
    assert [flight < departure(20) for flight in cases["raised_at"]] == [True]


@pytest.mark.parametrize("otherwise", UNOBSERVED)
def test_unobserved_compressor_loss_raises_nothing(otherwise):
    drift = features(np.zeros(N)).with_columns(
        status(BEFORE_ANY, otherwise).alias("cc_efficiency_loss_status"),
        cc_efficiency_loss=pl.lit(0.2), cc_efficiency_loss_sd=pl.lit(0.01),
    )  # fmt: skip
    assert alerts(drift, NO_WORK)["diagnosis"].to_list() == []
    assert alerts(drift.drop("cc_efficiency_loss_status"), NO_WORK)["diagnosis"].to_list() == ["CC_DEGRADED"]


@pytest.mark.parametrize(("loss_status", "raised"), [("ok", 1), *((s, 0) for s in UNOBSERVED)])
def test_unobserved_component_loss_raises_nothing(loss_status, raised):
    component = next(c for c in components().values() if c.record is not None)
    described = features(np.zeros(N)).with_columns(
        component=pl.lit(component.code), loss=pl.lit(3.0 * component.warn_loss), loss_sd=pl.lit(0.01),
        loss_status=pl.lit(loss_status), loss_slope_30_per_flight=pl.lit(0.0), loss_step_3=pl.lit(0.0),
    )  # fmt: skip
    assert raise_component_alerts(described, NO_WORK, component, Limits()).height == raised


def test_flags_carry_from_observed_flight():
    by_flight = status(np.array([False, True, False, True, False, False])).alias("hx_fouling_status")
    grid = Grid.from_frame(features(np.zeros(6)).with_columns(by_flight))
    flags = np.array([[1, 0, 1, 1, 0, 0]], dtype=bool)
    ended = np.array([[0, 0, 0, 0, 0, 1]], dtype=bool)
    assert grid.as_observed(flags, "hx_fouling", ended).astype(int).tolist() == [[0, 0, 0, 1, 1, 0]]
