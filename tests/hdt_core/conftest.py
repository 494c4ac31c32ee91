"""The fleet of `known_fleet`, its model and its flights, made once; and an aircraft of two packs."""

from collections.abc import Callable

import polars as pl
import pytest
from known_fleet import Fleet, fleet_with_truth
from two_packs import fly_two_packs


@pytest.fixture(scope="session")
def fleet() -> Fleet:
    """Five aircraft of 120 flights, ram outlet fitted."""
    return fleet_with_truth(5, 120)


@pytest.fixture(scope="session")
def model(fleet):
    """Digital system model of `fleet`."""
    from hdt_core.calibration.calibrate import calibrate

    return calibrate(fleet.samples, fleet.legs, fleet.maintenance)


@pytest.fixture(scope="session")
def flights(fleet, model):
    """Per-flight estimates of `fleet`."""
    from hdt_core.calibration.flight_estimates import estimate_flights

    return estimate_flights(fleet.samples, model)


@pytest.fixture(scope="session")
def fleets():
    """Module `known_fleet`: constants, `group_flow` and `fleet_with_truth`."""
    import known_fleet as support

    return support


@pytest.fixture(scope="session")
def fly() -> Callable[..., pl.DataFrame]:
    """Flights of one aircraft, its witnesses known."""
    return fly_two_packs


@pytest.fixture(scope="session")
def nothing_done() -> pl.DataFrame:
    """A maintenance log without an entry."""
    schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "done_on": pl.Date}
    return pl.DataFrame(schema=schema | {"component": pl.String, "action": pl.String, "finding": pl.String})
