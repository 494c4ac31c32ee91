"""A fleet so small that a night takes seconds, and children that may be killed at it."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from nights import keep_base
from soundness import faults, state
from zones import drop_fleet, simulated

from pipelines.storage.store import Store


@dataclass
class Children:
    """Nights in processes of their own."""

    zygote: subprocess.Popen[str]
    base: Path

    def night(self, landing: Path, home: Path, **how: Any) -> tuple[int | None, str]:
        """Signal that ended the child (0: none, it ended well; None: it failed) and what it said."""
        request = {"landing": str(landing), "home": str(home)} | how
        assert self.zygote.stdin
        assert self.zygote.stdout
        self.zygote.stdin.write(json.dumps(request) + "\n")
        self.zygote.stdin.flush()
        answer = json.loads(self.zygote.stdout.readline())
        status = answer["status"]
        killed = os.WTERMSIG(status) if os.WIFSIGNALED(status) else None
        return (0 if status == 0 else killed), answer["said"]

    def complete_night(self, landing: Path, home: Path, **how: Any) -> None:
        """A night that ends well and has nothing to say."""
        assert self.night(landing, home, **how) == (0, "")

    def home(self, path: Path) -> Path:
        """A new home that knows the simulated lives already."""
        keep_base(self.base, path)
        return path


@pytest.fixture(scope="session")
def children(sample_home: Path) -> Iterator[Children]:
    """The process that forks children."""
    command = [sys.executable, Path(__file__).with_name("zygote.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield Children(process, sample_home)
        assert process.stdin
        process.stdin.close()


@pytest.fixture
def home(children: Children, tmp_path: Path) -> Path:
    """A new home of a test's own."""
    return children.home(tmp_path / "home")


@dataclass(frozen=True)
class Tiny:
    """One aircraft of four flights: history, a flight delivered twice, a row that is wrong; and how a night ends."""

    landing: Path
    end: dict[str, Any]

    def check_end(self, home: Path) -> None:
        """A home is sound, and as an undisturbed night leaves it."""
        assert faults(home, self.landing) == []
        assert state(home) == self.end


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory, children: Children) -> Tiny:
    """The landing zone and the tables after an undisturbed night. Read only."""
    root = tmp_path_factory.mktemp("tiny")
    landing = root / "landing"
    zone = simulated(5, 4, operator="QQX", tail="Z9")
    drop_fleet(landing, [zone])
    zone.only(zone.flights[:2]).drop_history(landing)
    zone.only(zone.flights[1:]).drop_csv(landing)
    zone.drop_papers(landing)
    spoil(landing)
    home = children.home(root / "home")
    children.complete_night(landing, home)
    assert faults(home, landing) == []
    return Tiny(landing, state(home))


def spoil(landing: Path) -> None:
    """One row gets an impossible pack."""
    file = max(landing.glob("*/*/acms/*.csv"))
    lines = file.read_text().splitlines()
    fields = lines[5].split(",")
    fields[lines[0].split(",").index("pack")] = "7"
    file.write_text("\n".join([*lines[:5], ",".join(fields), *lines[6:], ""]))


@pytest.fixture
def landing(tiny: Tiny, tmp_path: Path) -> Path:
    """A landing zone of one's own."""
    return Path(shutil.copytree(tiny.landing, tmp_path / "landing", copy_function=shutil.copy2))


@pytest.fixture(scope="session")
def intact():
    """What lies under a final name is whole, and nothing is there twice."""

    def check(home: Path) -> None:
        for file in home.glob("tables/**/[!.]*.parquet"):
            pl.read_parquet(file)
        for table in ("raw_snapshots", "raw_flights"):
            frame = Store(home).read_table(table)
            keys = [c for c in ("operator", "flight_id", "pack", "time_utc", "source") if c in frame.columns]
            assert not frame.select(pl.struct(keys).is_duplicated().any()).item(), table

    return check
