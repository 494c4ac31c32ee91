"""The pack of `hand_pack`."""

import polars as pl
import pytest
from hand_pack import DSM, FLIGHT, LAWS

from hdt_core.calibration.dsm import Dsm
from hdt_core.flight.control_schedules import ControlSchedules


@pytest.fixture
def dsm() -> Dsm:
    """Its model."""
    return DSM


@pytest.fixture
def laws() -> ControlSchedules:
    """What its controllers hold."""
    return LAWS


@pytest.fixture
def flight() -> pl.DataFrame:
    """Six samples of a cruise."""
    return FLIGHT
