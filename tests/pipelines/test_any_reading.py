"""Whatever finite values or none a recorder gives, every table that is made of them honours its declaration."""

import json

import polars as pl
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from hdt_core.alerts.alerts import raise_alerts
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.flight.admission import NominalBaseline, admit, leg_indicators
from hdt_core.flight.control_schedules import ControlSchedules
from hdt_core.flight.legs import judge_legs
from hdt_core.health.features import features
from hdt_core.health.residuals import residuals
from hdt_core.health.sensor_checks import cross_checks
from hdt_core.tables import TABLES
from hdt_core.tables.raw import SIGNALS, RawMaintenance, RawMessages
from hdt_core.tracking.track import track
from pipelines.assets.calibration import CONTROLLERS, LEGS, laws_of
from pipelines.assets.twin import model_of
from pipelines.storage.store import Store

NO_WORK = RawMaintenance.create_empty()
NO_MESSAGES = RawMessages.create_empty()
ODD = st.sampled_from([None, 0.0, -0.0, -1.0, 1.0, 1e-300, -1e-300, 5e-324, 1e300, -1e300, 1.7e308, 1e6, 250.0])
READING = ODD | st.none() | st.floats(allow_nan=False, allow_infinity=False)
SPOILED = st.lists(st.tuples(st.sampled_from(SIGNALS), READING, st.sampled_from([1, 2, 3, 17])), min_size=1, max_size=6)
"""Signal, what it reads, and in every how many-th row."""


@pytest.fixture(scope="module")
def store(sample_home):
    return Store(sample_home)


@pytest.fixture(scope="module")
def models(store):
    """What was learned of the sample fleet: model, norm of legs, laws of controllers."""
    laws = store.read_table("calibration_schedules")
    controllers = ControlSchedules.from_dict(json.loads(laws_of(laws, CONTROLLERS)))
    return model_of(store.read_table("calibration_dsm")), NominalBaseline.from_json(laws_of(laws, LEGS)), controllers


@pytest.fixture(scope="module")
def recorded(store):
    """Three flights of one aircraft."""
    raw = store.read_table("raw_snapshots", [("BZR", "A9-BAC")])
    flights = raw["flight_id"].unique().sort()[20:23]
    return raw.filter(pl.col("flight_id").is_in(flights.implode()))


def chain(raw, dsm, norm, laws) -> dict[str, pl.DataFrame]:
    """Every table that is made of recorded rows."""
    verdicts, samples = judge_legs(raw)
    signs = leg_indicators(samples, norm)
    checks = cross_checks(samples, laws)
    flights = estimate_flights(samples, dsm)
    apart = residuals(samples, flights, dsm)
    health, chapters = track(flights, NO_WORK, dsm)
    described = features(health, apart, verdicts, NO_WORK, twin_flights=flights, cross_checks=checks)
    return {
        "legs_samples": samples,
        "legs_verdicts": verdicts,
        "legs_indicators": signs,
        "features_cross_checks": checks,
        "twin_flights": flights,
        "residuals": apart,
        "twin_health": health,
        "twin_checkpoints": chapters,
        "legs_admitted": admit(norm, verdicts, signs, NO_WORK, NO_MESSAGES, health),
        "features": described,
        "features_alerts": raise_alerts(described, NO_WORK),
    }


@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(spoiled=SPOILED)
@example(spoiled=[("cc_flow_kg_s", 0.0, 1)])  # the ln of pack flow over it was infinite in 1 of 3,382 rows
@example(spoiled=[("cc_flow_kg_s", -1.0, 1), ("pack_flow_kg_s", 1e300, 2)])
@example(spoiled=[("hx_out_k", 1e300, 2), ("cc_in_pa", 5e-324, 1)])
def test_any_reading_gives_finite_results(spoiled, recorded, models):
    raw = recorded.with_row_index("place")
    for signal, value, each in spoiled:
        here = pl.col("place") % each == 0
        raw = raw.with_columns(pl.when(here).then(pl.lit(value, pl.Float64)).otherwise(signal).alias(signal))
    for table, frame in chain(raw.drop("place"), *models).items():
        entry = TABLES[table]
        conformed = entry.conform(frame)
        assert entry.schema.faults(conformed) == [], table
        assert all(column.is_finite().all() for column in conformed.select(pl.selectors.float())), table


def test_dead_flow_spares_other_flights(recorded, models):
    """One flight's zero costs no other flight a digit."""
    one, *others = recorded["flight_id"].unique().sort()
    sick = recorded.with_columns(pl.when(flight_id=one).then(0.0).otherwise("cc_flow_kg_s").alias("cc_flow_kg_s"))
    good, bad = (chain(raw, *models)["twin_flights"] for raw in (recorded, sick))
    rest = pl.col("flight_id").is_in(others)
    assert bad.filter(rest).equals(good.filter(rest))
    assert bad.filter(flight_id=one)["flows_apart_ln"].null_count() == 2
    assert set(bad["status"]) == {"ok"}
