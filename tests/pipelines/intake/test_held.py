"""What people read of flights that are held."""

import pytest

from pipelines.intake.faults import REASONS
from pipelines.intake.held import held_lines
from pipelines.words import use_language

ONE = {"operator": "AQX", "tail": "LX-AAA", "reason": "out_of_reach", "likely_cause": "year", "n": 1, "flight_id": "F"}


@pytest.mark.parametrize(
    ("group", "line"),
    [
        (ONE, f"AQX LX-AAA: F. {REASONS['out_of_reach'].sentence} Likely cause: another year."),
        (
            ONE | {"n": 3},
            f"AQX LX-AAA: 3 flights from F on. {REASONS['out_of_reach'].sentence} Likely cause: another year.",
        ),
        (ONE | {"reason": "no_flight", "likely_cause": None}, f"AQX LX-AAA: F. {REASONS['no_flight'].sentence}"),
    ],
)
def test_held_flights_share_a_line(group, line):
    assert held_lines([group]) == [line]


def test_other_languages_name_the_cause():
    with use_language("de"):
        assert held_lines([ONE])[0].endswith("Wahrscheinliche Ursache: ein anderes Jahr.")
