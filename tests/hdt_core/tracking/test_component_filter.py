"""One health parameter of a declared component along a pack: Kalman's filter of a random walk, by hand."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from by_hand import flights

from hdt_core.components import Reading, components
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.tracking.component import design_prior, track_component
from hdt_core.tracking.component_readings import component_readings

VALVE = PhysicsModel(
    name="valve",
    inputs=(Signal("flow_kg_s", "kg/s"),),
    outputs=(Signal("drop_pa", "Pa", sigma=10.0),),
    params=(
        Param("area_m2", "m2", 1e-3, (1e-4, 1e-2), "design"),
        Param("valve_loss", "-", 0.0, (-0.1, 0.9), "health", drift=0.01),
    ),
    equations=lambda flow_kg_s, area_m2, valve_loss: (flow_kg_s / (area_m2 * (1.0 - valve_loss))) ** 2,
)
SD = 0.02


def tracked(seen: list[float | None], statuses: dict[int, str] | None = None) -> pl.DataFrame:
    status = [(statuses or {}).get(k, "converged") for k in range(len(seen))]
    rows = flights(len(seen), valve_loss=pl.Series(seen, dtype=pl.Float64).to_list(), valve_loss_sd=SD)
    return track_component(rows.with_columns(status=pl.Series(status)), VALVE, "V")


def walk(seen: list[float], sigma: float) -> np.ndarray:
    """From as built, as unsure as a uniform variable between the bounds; NaN where no flight is believed."""
    mean, var, told = 0.0, (0.9 + 0.1) ** 2 / 12.0, []
    for value in seen:
        var += 0.01**2
        if np.isfinite(value):
            gain = var / (var + sigma**2)
            mean, var = mean + gain * (value - mean), (1.0 - gain) * var
        told.append((mean, np.sqrt(var)))
    return np.array(told)


def test_a_flight_counts_as_much_as_it_says_and_flights_scatter():
    """Eight steps of 0.03 or more show a scatter of 1.4826 / sqrt 2 of their median, which comes on top."""
    seen = [0.0, 0.03, 0.0, 0.03, 0.0, 0.03, 0.0, 0.03]
    found = tracked(seen)
    np.testing.assert_allclose(found.select("value", "sd"), walk(seen, SD), rtol=1e-5, atol=1e-7)
    more = [*seen, 0.0]
    sigma = np.hypot(SD, 1.4826 * 0.03 / np.sqrt(2.0))
    np.testing.assert_allclose(tracked(more).select("value", "sd"), walk(more, sigma), rtol=1e-5, atol=1e-7)
    assert found.select("component", "parameter", "unit", "estimator").unique().rows() == [
        ("V", "valve_loss", "-", "kalman_filtered")
    ]


@pytest.mark.parametrize(("times", "status"), [(4.95, "ok"), (5.05, "unconfirmed")])
def test_a_step_of_more_than_five_deviations_counts_once_the_next_flight_agrees(times, status):
    """Deviations of a flight's scatter and of the drift of one flight."""
    step = times * np.hypot(SD, 0.01)
    assert tracked([*[0.0] * 5, step, step])["status"].to_list() == [*["ok"] * 5, status, "ok"]
    assert tracked([*[0.0] * 5, step, 0.0])["status"].to_list() == [*["ok"] * 5, status, "ok"]
    assert tracked([*[0.0] * 4, step, 0.0])["status"].to_list()[:5] == ["ok"] * 5
    doubted = tracked([*[0.0] * 5, 3 * step, -3 * step, -3 * step])
    assert doubted["status"].to_list()[5:] == ["unconfirmed", "unconfirmed", "ok"]


def test_a_flight_that_says_nothing_is_predicted():
    said = {2: "diverged", 3: "not_identifiable"}
    found = tracked([0.01, 0.02, 0.7, 0.7, 0.03], said)
    assert found["status"].to_list() == ["ok", "ok", "predicted", "predicted", "ok"]
    np.testing.assert_allclose(
        found.select("value", "sd"), walk([0.01, 0.02, np.nan, np.nan, 0.03], SD), rtol=1e-5, atol=1e-7
    )


def test_a_design_has_a_prior_where_the_declaration_says_it_of_each():
    sure, unsure = Param("a", "-", 2.0, (0.0, 5.0), "design", sd=0.3), Param("b", "-", 1.0, (0.0, 5.0), "design")
    both = replace(VALVE, params=(sure, replace(unsure, sd=0.5)), equations=lambda flow_kg_s, a, b: flow_kg_s * a * b)
    prior = design_prior(both)
    np.testing.assert_allclose(prior.mean, [2.0, 1.0])
    np.testing.assert_allclose(prior.cov, np.diag([0.09, 0.25]))
    assert design_prior(replace(both, params=(sure, unsure))) is None
    with pytest.raises(ValueError, match="no flight"):
        track_component(flights(0, valve_loss=0.1), VALVE, "V")


HXT = components()["HXT"]


def read(values: list[float | None], **changes: object) -> dict[str, object]:
    """The row of one flight with these samples of a channel."""
    reading = Reading(
        **({"name": "hxt_x", "unit": "K", "meaning": "", "value": pl.col("hot_out_k"), "below": 400.0} | changes)
    )
    start = datetime(2024, 1, 1, tzinfo=UTC)
    samples = pl.DataFrame({
        "time_utc": [start + timedelta(seconds=k) for k in range(len(values))], "hot_out_k": values, "hot_in_k": 350.0,
        "tat_k": 280.0, "altitude_m": 3000.0, "mach": 0.4,
    }, schema_overrides={"hot_out_k": pl.Float64}).with_columns(
        operator=pl.lit("TST"), tail=pl.lit("T-1"), flight_id=pl.lit("F"), pack=pl.lit(1, pl.Int32)
    )  # fmt: skip
    return component_readings(samples, replace(HXT, readings=(reading,))).row(0, named=True)


def test_a_reading_is_the_mean_of_samples_without_spikes():
    """Five robust deviations from the median: the median deviation is 1, so 7.4 away."""
    row = read([298.0, 299.0, 300.0, 301.0, 302.0, 307.0, 308.9])
    assert row["status"] == "measured"
    assert row["value"] == pytest.approx(np.mean([298, 299, 300, 301, 302, 307, 308.9]))
    calm = [299.0, 299.0, 300.0, 301.0, 301.0]
    for away, believed in ((7.3, True), (7.5, False)):
        row = read([*calm, *calm, 300.0 + away])
        sound = [*calm, *calm, *([300.0 + away] if believed else [])]
        assert (row["value"], row["sd"]) == pytest.approx((np.mean(sound), np.std(sound, ddof=1)))


@pytest.mark.parametrize(
    ("values", "where", "status"),
    [
        ([300.0] * 5, None, "measured"),
        ([300.0] * 4, None, "few_samples"),
        ([None] * 6, None, "not_recorded"),
        ([300.0] * 6, pl.col("mach") > 0.5, "off_nominal"),
        ([300.0] * 9 + [400.0], None, "one_or_more"),
        ([300.0] * 10 + [400.0], None, "measured"),
        ([300.0] * 9 + [399.9], None, "measured"),
    ],
)
def test_what_a_flight_says_of_a_reading(values, where, status):
    row = read(values, where=where)
    assert row["status"] == status
    assert (row["value"] is None) == (status in ("few_samples", "not_recorded", "off_nominal"))
