"""A landing zone to write into, and one good flight to spoil."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import polars as pl
import pytest

from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.snapshots import Intake, read_snapshots

DIRTY = Path(__file__).parents[2] / "data" / "dirty" / "landing"
NOW = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture(scope="session")
def now() -> datetime:
    return NOW


@pytest.fixture(scope="session")
def good_flight() -> bytes:
    """One flight as delivered, 42 rows of two packs; the file `LX-AAA_20240525_04.csv`."""
    return (DIRTY / "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv").read_bytes()


@pytest.fixture
def deliver(tmp_path: Path) -> Callable[[dict[str, bytes]], list[LandingFile]]:
    """Write files below a landing zone and list it."""

    def write(files: dict[str, bytes]) -> list[LandingFile]:
        for name, content in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        return list_landing(tmp_path).files

    return write


@pytest.fixture(scope="session")
def balanced() -> Callable[[Intake], Intake]:
    """Let an intake pass that lost and invented no row."""

    def check(intake: Intake) -> Intake:
        stored = intake.rows.group_by("file").agg(pl.len().cast(pl.Int64).alias("stored"))
        aside = intake.quarantine.group_by("file").agg(pl.col("n_rows").sum())
        ledger = intake.delivered.join(stored, on="file", how="left").join(aside, on="file", how="left").fill_null(0)
        assert ledger.filter(pl.col("n_delivered") != pl.col("stored") + pl.col("n_rows")).is_empty()
        assert not intake.rows.select(pl.selectors.float().is_nan().any()).row(0).count(True)
        return intake

    return check


@pytest.fixture(scope="session")
def read(balanced) -> Callable[..., Intake]:
    """`read_snapshots`, checked to balance."""

    def call(files) -> Intake:
        files = [files] if isinstance(files, LandingFile) else files
        return balanced(read_snapshots([f for f in files if f.kind != "fleet"]))

    return call
