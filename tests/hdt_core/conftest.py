"""The fleet of `made`, its model and its flights, made once."""

import pytest
from made import Fleet, made_fleet


@pytest.fixture(scope="session")
def fleet() -> Fleet:
    """Five aircraft of 120 flights, ram outlet fitted."""
    return made_fleet(5, 120)


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
def made():
    """Module `made`: constants, `group_flow` and `made_fleet`."""
    import made as support

    return support
