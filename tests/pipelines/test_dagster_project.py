"""The folder is a Dagster project as any other: its commands work in a fresh clone, and leave git nothing to see."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DAGSTER = str(Path(sys.executable).with_name("dagster"))
QUESTION = "{ assetNodes { assetKey { path } } }"


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """What git has of the project, committed."""
    named = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False).stdout.decode()
    code = (".gitignore", "dagster.yaml", "pyproject.toml", "hdt_core/", "pipelines/", "dagster_batched/", "sql/")
    for name in filter(lambda n: n.startswith(code) and (ROOT / n).is_file(), named.split("\0")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, tmp_path / name)
    for words in (["init", "-q"], ["add", "-A"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


@contextmanager
def started(clone: Path, *words: str, home: bool) -> Iterator[subprocess.Popen[str]]:
    """Dagster's own command in the clone, ended as by Ctrl+C; `home` sets DAGSTER_HOME to the clone."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("DAGSTER_", "HDT_"))}
    environment |= {"PYTHONPATH": str(clone), "PATH": f"{Path(DAGSTER).parent}{os.pathsep}{os.environ['PATH']}"}
    environment |= {"DAGSTER_HOME": str(clone)} if home else {}
    with subprocess.Popen(
        [DAGSTER, *words],
        cwd=clone,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl+C reaches all of a terminal's processes
    ) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
                try:
                    process.communicate(timeout=60)
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)


def new_files(clone: Path) -> str:
    """What git would show as new."""
    return subprocess.run(
        ["git", "status", "--porcelain", "--untracked-files=all"], cwd=clone, capture_output=True, text=True, check=True
    ).stdout.replace("A  ", "")


def wait_for(ask: Callable[[], str], process: subprocess.Popen[str]) -> str:
    """The first answer of a server that is starting."""
    while True:
        try:
            return ask()
        except (urllib.error.URLError, ConnectionError):
            assert process.poll() is None, process.communicate()[0][-2000:]
            time.sleep(0.3)


def test_definitions_validate_without_a_home_of_dagsters(clone):
    before = new_files(clone)
    with started(clone, "definitions", "validate", home=False) as process:
        words = process.communicate(timeout=120)[0]
    assert process.returncode == 0, words[-2000:]
    assert "All code locations passed validation" in words
    assert new_files(clone) == before
    assert (clone / "hdt_home/dagster/history").is_dir()  # where `hdt --home hdt_home` keeps it


def test_dev_answers_with_a_home_of_dagsters(clone):
    before = new_files(clone)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/graphql",
        json.dumps({"query": QUESTION}).encode(),
        {"Content-Type": "application/json"},
    )

    def ask() -> str:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.read().decode()

    with started(clone, "dev", "--port", str(port), home=True) as process:
        nodes = json.loads(wait_for(ask, process))["data"]["assetNodes"]
        running = new_files(clone)
    assert ["prognoses"] in [n["assetKey"]["path"] for n in nodes]
    assert before == running == new_files(clone)
