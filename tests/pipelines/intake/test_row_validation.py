"""Rows of recorder files: times at the limits of their day, packs that count from 0, pressures, fewer packs."""

from dataclasses import replace

import pytest
from spoils import Spoil, column, field, fields_of, joined

CSV = "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
N = 42  # rows of the good flight


@pytest.fixture
def read_spoiled(good_flight, deliver, read):
    """Read the good flight, spoiled."""
    return lambda *spoils: read(deliver({CSV: _in_turn(spoils)(good_flight)}))


def _in_turn(spoils: tuple[Spoil, ...]) -> Spoil:
    def spoil(content: bytes) -> bytes:
        for one in spoils:
            content = one(content)
        return content

    return spoil


@pytest.mark.parametrize(
    ("time", "reasons"),
    [
        (b"2024-05-24T21:00:00Z", []),
        (b"2024-05-24T20:59:59Z", ["time_contradicts_flight_id"]),
        (b"2024-05-27T00:00:00Z", []),
        (b"2024-05-27T00:00:01Z", ["time_contradicts_flight_id"]),
    ],
)
def test_times_are_near_the_day_of_departure(read_spoiled, time, reasons):
    """From three hours before it to 48 hours after its begin."""
    faults = read_spoiled(field(1, "report_time", time)).quarantine.filter(scope="row")

    assert faults["reason"].to_list() == reasons


def test_highest_pack_shows_that_packs_count_from_1(read_spoiled):
    intake = read_spoiled(*(field(row, "pack", b"0") for row in range(1, 11)))

    assert (intake.rows.height, set(intake.rows["pack"])) == (N - 10, {1, 2})


@pytest.mark.parametrize(("n_rows", "is_noted"), [(2, False), (3, True)])
def test_three_pressures_are_implausible(read_spoiled, n_rows, is_noted):
    halved = column("pt_psia", lambda pressure: 0.5 * pressure)
    reasons = read_spoiled(lambda content: joined(fields_of(content)[: n_rows + 1]), halved).quarantine["reason"]

    assert ("implausible_pressure" in reasons) is is_noted


@pytest.mark.parametrize(("n_stored", "reasons"), [(2, []), (3, ["fewer_packs"])])
def test_list_with_fewer_packs_is_noted(good_flight, deliver, read, n_stored, reasons):
    (file,) = deliver({CSV: good_flight})

    assert read(replace(file, packs_stored=n_stored)).quarantine["reason"].to_list() == reasons
