"""One night, with everything Python opens for writing, starts, loads or connects to written to a list.

`python night_under_watch.py LANDING HOME LIST`. Parquet and DuckDB write from native code: for those the test looks at
the folders.
"""

import json
import sys
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1] / "support")]
EVENTS = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "pickle.find_class", "socket.connect")
RECORDED: list[tuple[str, str]] = []


def watch(event: str, arguments: tuple[Any, ...]) -> None:
    """Note what a night should not do."""
    if event in EVENTS:
        RECORDED.append((event, str(arguments[:2])[:200]))
    elif event == "open" and isinstance(arguments[0], str) and any(c in str(arguments[1]) for c in "wax+"):
        RECORDED.append(("write", arguments[0]))


def main(landing: Path, home: Path, target: Path) -> None:
    """Import first: what importing does is no matter of the data's."""
    from nights import run

    import pipelines.definitions
    import pipelines.orchestration.runs  # noqa: F401
    from pipelines.report.page import write_report

    sys.addaudithook(watch)
    night = run(landing, home)
    write_report(home, home / "report.html")
    events = list(RECORDED)
    target.write_text(json.dumps({"failed": night.failed, "events": events}))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
