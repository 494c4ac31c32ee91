"""One landing zone full of hostile files, and the home that a night made of it."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import polars as pl
import pytest
from hostile import CANARY, plant
from nights import keep_base, once
from zones import drop_fleet, simulated

from pipelines.storage.catalog import connect


@dataclass(frozen=True)
class Watched:
    """What a night over hostile files left behind."""

    root: Path
    landing: Path
    home: Path
    failed: dict[str, str]
    events: list[tuple[str, str]]
    quarantine: pl.DataFrame
    output: str


@pytest.fixture(scope="session")
def watched(tmp_path_factory: pytest.TempPathFactory, sample_home: Path) -> Watched:
    """A good aircraft among all that is hostile; a secret in the environment."""
    root = once(tmp_path_factory, "watched", lambda root: _watch_a_night(root, sample_home))
    report = json.loads((root / "told.json").read_text())
    with connect(root / "home") as con:
        aside = con.sql("select * from quarantine").pl()
    return Watched(root, root / "landing", root / "home", report["failed"], report["events"], aside, report["output"])


def _watch_a_night(root: Path, sample_home: Path) -> None:
    root.mkdir()
    landing = root / "landing"
    home = root / "home"
    zone = simulated(5, 3, operator="QQX", tail="Z9")
    drop_fleet(landing, [zone])
    zone.drop_csv(landing)
    zone.drop_papers(landing)
    plant(root, landing)
    keep_base(sample_home, home)
    script = Path(__file__).with_name("night_under_watch.py")
    secrets = {"DAGSTER_PG_PASSWORD": CANARY, "AWS_SECRET_ACCESS_KEY": CANARY}
    command = [sys.executable, script, landing, home, root / "told.json"]
    env = os.environ | secrets
    done = subprocess.run(command, env=env, capture_output=True, text=True, cwd=root, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    report = json.loads((root / "told.json").read_text())
    (root / "told.json").write_text(json.dumps(report | {"output": done.stdout + done.stderr}))
