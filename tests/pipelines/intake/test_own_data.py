"""The how-to of own data: what it writes is taken in whole and is what the recorder said."""

from datetime import UTC, datetime
from pathlib import Path

import polars as pl
from pages import walk
from polars.testing import assert_frame_equal

from pipelines.intake.landing import list_landing
from pipelines.intake.snapshots import read_snapshots

ROOT = Path(__file__).parents[3]
NOW = datetime(2026, 1, 1, tzinfo=UTC)


def test_the_flight_of_the_how_to_is_taken_in_as_the_recorder_gave_it(monkeypatch):
    monkeypatch.chdir(ROOT)
    page = walk("raw-data.md")
    written, sample = list_landing(page["landing"]), list_landing(ROOT / "data_samples")
    mine = read_snapshots([f for f in written.files if f.tail == "9H-XYZ"], NOW)
    same = read_snapshots([f for f in sample.files if f"data_samples/{f.path}" == page["sample"]], NOW)
    assert written.quarantine.height == mine.quarantine.height == 0
    assert mine.rows["operator"].unique().to_list() == ["XYZ"]
    columns = ["time_utc", "pack", "altitude_m", "mach", "tat_k", "total_pressure_pa", "hx_in_k", "hx_out_k",
             "ram_door_open", "pack_flow_kg_s"]  # fmt: skip
    assert mine.rows.height == same.rows.height > 30
    assert_frame_equal(mine.rows.select(columns), same.rows.select(columns), rel_tol=1e-6)
    assert mine.rows.select(pl.col("ram_out_k", "cc_speed_rad_s").is_null().all()).row(0) == (True, True)
