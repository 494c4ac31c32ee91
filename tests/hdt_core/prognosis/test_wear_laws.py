"""Laws of wear of a declared component: what is linear, which the fleet's lives favour, and remaining life by each."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from by_hand import flights, log

from hdt_core.components import LINEAR, RESISTANCE, WearLaw, power_law
from hdt_core.components.pack import CC
from hdt_core.prognosis.component_life import component_prognoses
from hdt_core.prognosis.wear_laws import UNDECLARED, wear_laws

LAWS = [LINEAR, RESISTANCE, power_law(0.5), power_law(2.0)]
NO_MESSAGES = pl.DataFrame(schema={
    "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "flight_id": pl.String, "code": pl.String,
    "text": pl.String, "message_time": pl.Datetime("us", "UTC"),
})  # fmt: skip


def loss_of(law: WearLaw, n: int, limit: float = 0.35) -> np.ndarray:
    """Losses of a unit that reaches the limit on its last flight."""
    losses = np.linspace(0.0, 0.5, 100_001)
    return np.interp(np.linspace(0.0, 1.0, n), law.grown(losses) / law.grown(np.array(limit)), losses)


def make_features(losses: np.ndarray) -> pl.DataFrame:
    """Features of one unit with these losses, its slope that over all of them."""
    n = len(losses)
    slope = float(np.polyfit(np.arange(n), losses, 1)[0])
    columns = {"component": "CC", "loss": losses.tolist(), "loss_sd": 0.005}
    return flights(n, **columns, loss_slope_100_per_flight=slope, flights_since_drop=list(range(n)))


@pytest.mark.parametrize("law", LAWS)
def test_law_slope_is_derivative(law):
    loss = np.array([0.1, 0.3])

    difference = (law.grown(loss + 1e-6) - law.grown(loss - 1e-6)) / 2e-6

    np.testing.assert_allclose(law.slope(loss), difference, rtol=1e-6)


def test_zero_power_is_refused():
    with pytest.raises(ValueError, match="positive power"):
        power_law(0.0)


def test_declared_law_is_used_alone():
    (only,) = wear_laws(replace(CC, wear_law=RESISTANCE), make_features(loss_of(LINEAR, 200)))

    assert only == (RESISTANCE, 1.0)


def test_prior_stands_without_lives():
    weights = wear_laws(CC, make_features(np.zeros(20)))

    assert [x.weight for x in weights] == pytest.approx([x.weight for x in UNDECLARED])


@pytest.mark.parametrize("law", LAWS)
def test_lives_favour_their_law(law):
    lives = [make_features(loss_of(law, 200)).with_columns(tail=pl.lit(f"T-{k}")) for k in range(12)]

    weights = wear_laws(CC, pl.concat(lives))

    assert max(weights, key=lambda x: x.weight).law == law


@pytest.mark.parametrize("law", LAWS)
def test_remaining_life_follows_declared_law(law):
    """Half of a life of 200 flights: a straight line through the loss would err by 30 to 100 flights."""
    part = replace(CC, wear_law=law, life_flights=200.0, limit=replace(CC.limit, mean=0.35, sd=1e-3, unit_sd=1e-3))
    rows = make_features(loss_of(law, 200)[:100])

    left = component_prognoses(rows, NO_MESSAGES, log().with_columns(finding=pl.lit("")), part)["rul_flights"][-1]

    assert left == pytest.approx(100.0, abs=15.0)
