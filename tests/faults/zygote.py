"""A process that has imported everything and done nothing: it forks a child for each night, so that a kill is cheap.

It must not touch a frame itself: a fork would take over Polars' threads as locks without owners. It reads one JSON
object a line: `landing`, `home` and, if wanted, `fault` (see `fault_points.arm`), `kill_after_s`, `file_limit` (bytes
a file may grow to), `nobody` (drop privileges), `steps` (only the first of the chain), `publish` (so often, instead of
a night), `only` (flights up to this one), `cut` (the fault is a power cut). It answers with the child's wait status and
what it said.
"""

import json
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1] / "support")]
os.environ["POLARS_MAX_THREADS"] = "1"

import polars  # noqa: E402
from nights import Silent, stages_of  # noqa: E402
from powercut import Disk  # noqa: E402

import pipelines.definitions  # noqa: E402
import pipelines.orchestration.runs  # noqa: E402, F401
from benchmarks import fault_points  # noqa: E402
from pipelines.orchestration import around_night, nightly  # noqa: E402
from pipelines.storage import files  # noqa: E402
from pipelines.storage.publication import publish  # noqa: E402


def work(request: dict) -> None:
    """One child's life."""
    landing = Path(request["landing"])
    home = Path(request["home"])
    if "fault" in request:
        fault_points.arm(request["fault"], cut_of(home, **request["cut"]) if "cut" in request else None)
    if "file_limit" in request:
        resource.setrlimit(resource.RLIMIT_FSIZE, (request["file_limit"],) * 2)
    if request.get("nobody") and os.geteuid() == 0:
        os.setgid(65534)
        os.setuid(65534)
    if "publish" in request:
        for _ in range(request["publish"]):
            publish(home)
        return
    # the empty flight_id of cells above flights comes before all others
    only = polars.col("flight_id") <= request["only"] if "only" in request else None
    nightly.STAGES = stages_of(0, request.get("steps"))
    with around_night.lock_home(home):
        night, _ = nightly.complete_night(landing, home, Silent(), only)
    os.write(2, "\n".join(night.repairs).encode())
    if night.failed:
        sys.exit(f"failed: {night.failed}")


def cut_of(home: Path, lose_history: bool = False, sync: bool = True) -> Callable[[], None]:
    """A power cut, after a night that syncs its files or, to see that it matters, doesn't."""
    disk = Disk(home, home.with_name(f"shadow{os.getpid()}"))
    if not sync:
        files._sync = lambda path: None
    return lambda: disk.cut(lose_history)


def child(request: dict, output: int) -> None:
    """Run `work` and end, whatever it raises, without the parent's clean-up."""
    os.dup2(output, 2)
    code = 0
    try:
        work(request)
    except SystemExit as stop:
        code = 1
        os.write(2, str(stop.code).encode())
    except BaseException as error:
        code = 2
        os.write(2, f"{type(error).__name__}: {error}".encode())
    os._exit(code)


def main() -> None:
    """Fork, wait, answer."""
    for line in sys.stdin:
        request = json.loads(line)
        reader, writer = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(reader)
            child(request, writer)
        os.close(writer)
        timer = threading.Timer(request.get("kill_after_s", 600), os.kill, (pid, signal.SIGKILL))
        timer.start()
        with os.fdopen(reader, errors="replace") as stream:
            message = stream.read()
        timer.cancel()
        timer.join()
        _, status = os.waitpid(pid, 0)
        print(json.dumps({"status": status, "said": message[-2000:]}), flush=True)


if __name__ == "__main__":
    main()
