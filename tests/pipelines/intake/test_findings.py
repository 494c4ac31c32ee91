"""Lines of the log of cases that count as a delivered file."""

from datetime import UTC, datetime

import polars as pl
import pytest
from small_catalog import OWN

from hdt_core.alerts.succession import KINDS_OF_NIGHT
from hdt_core.tables import TABLES
from pipelines.intake.findings import case_files


@pytest.mark.parametrize(("kind", "n_files"), [*((kind, 0) for kind in sorted(KINDS_OF_NIGHT)), ("watch", 1)])
def test_lines_of_a_night_are_no_file(kind, n_files):
    line = OWN | {"line": 1, "at": datetime(2024, 6, 19, tzinfo=UTC), "alert_id": "a1", "kind": kind, "person": "Ada"}

    files = case_files(TABLES["raw_cases"].schema.conform(pl.DataFrame([line])))

    assert len(files) == n_files
