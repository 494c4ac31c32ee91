"""A column written in the wrong unit is found by physics, in every flight; a sound fleet is never accused."""

from pathlib import Path

import polars as pl
import pytest

from pipelines.intake.plausibility import slipped_rows

SAMPLES = Path(__file__).parents[3] / "data_samples"
KELVIN, KPA, KG_S = (1.0, 273.15), (6.894757, 0.0), (0.45359237 / 60.0, 0.0)
SLIPS = [
    *((c, KELVIN, "unit_kelvin") for c in ("tat_degc", "hx_in_degc", "hx_out_degc", "cc_in_degc", "cc_out_degc")),
    *((c, KPA, "unit_kpa") for c in ("pt_psia", "cc_in_psia", "cc_out_psia")),
    *((c, KG_S, "unit_kg_s") for c in ("pack_flow_lbpm", "cc_flow_lbpm")),
]


@pytest.fixture(scope="module")
def fleet():
    """A month of four aircraft of two operators, faults, dead sensors and switched-off packs included."""
    paths = [
        p for tail in ("LX-AAA", "LX-AAB", "A9-BAB", "A9-BAD") for p in SAMPLES.glob(f"*/{tail}/acms/*-04.parquet")
    ]
    frame = pl.concat([pl.read_parquet(p) for p in paths], how="diagonal_relaxed")
    return frame.with_columns(pl.lit(0, pl.Int32).alias("file_index"))


def test_a_sound_fleet_is_not_accused(fleet):
    assert slipped_rows(fleet).is_empty()


@pytest.mark.parametrize(("column", "unit", "reason"), SLIPS, ids=[c for c, _, _ in SLIPS])
def test_one_column_in_another_unit_is_found(column, unit, reason, fleet):
    scale, offset = unit
    found = slipped_rows(fleet.with_columns(pl.col(column) * scale + offset))
    assert set(found["reason"]) == {reason}
    assert all(column in c for c in found["column_name"])
    assert found.height > 0.985 * fleet[column].count()  # what is missed are flights with a dead sensor or a pack off
