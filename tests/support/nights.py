"""A night as the command runs it, without bars."""

import atexit
import fcntl
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from pipelines.lineage import STAGES, Stage, steps
from pipelines.orchestration.around_night import lock_home
from pipelines.orchestration.nightly import Night, run_night
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import publish
from pipelines.storage.store import Store


class Silent:
    """No progress bars."""

    def start(self, label: str, total: int) -> None: ...

    def advance(self, cells: int) -> None: ...


def run(landing: Path, home: Path) -> Night:
    """One night, as `hdt nightly` does it."""
    with lock_home(home):
        night = run_night(landing, home, Silent())
        publish(home)
    return night


def stages_of(first: int, last: int | None = None, stages: Sequence[Stage] = STAGES) -> list[Stage]:
    """Stages of some of the night's steps."""
    return [stage for step in steps(stages)[first:last] for stage in step.stages]


def steps_up_to(stage: str) -> int:
    """Number of the night's first steps, that of a stage the last."""
    return 1 + next(i for i, step in enumerate(steps(STAGES)) if stage in {s.name for s in step.stages})


def unfolded(stages: Sequence[Stage]) -> list[Stage]:
    """The same, each run with as many flights as one that reads files."""
    return [replace(stage, batch_factor=1) for stage in stages]


def keep_base(source: Path, home: Path) -> None:
    """The model of simulated lives is the same for every fleet: `home` takes that of `source` and need not fit it."""
    target = home / "tables/prognosis_base"
    target.parent.mkdir(parents=True)
    shutil.copytree(source / "tables/prognosis_base", target)
    Ledger(home).mark("prognosis_base", Ledger(source).cells("prognosis_base"))


@cache
def _published() -> Path:
    folder = tempfile.TemporaryDirectory(prefix="published-")
    atexit.register(folder.cleanup)
    return publish(Path(folder.name)).parent


def empty_home(home: Path) -> Store:
    """Tables without a row and their catalog, of no night on record: a copy, for to make them takes two seconds."""
    shutil.copytree(_published(), home, dirs_exist_ok=True, ignore=shutil.ignore_patterns("ledger*"))
    return Store(home)


def once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that one test process makes and all share; none may write to it."""
    worker = tmp_path_factory.getbasetemp()
    shared = (worker.parent if worker.name.startswith("popen-") else worker) / name
    with open(shared.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not shared.exists():
            make(shared)
    return shared
