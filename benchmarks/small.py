"""Every command of the documentation, small: `python -m benchmarks.small [NAME ...] [--write]`.

Claim: the published tables are those of the present sources. A table of the pages takes minutes to hours; `small.toml`
has each command with arguments that take seconds, and `small/` what it printed when the tables were last written. Where
scores or counts of a small run move, those of the page have moved too: run its command again, then this with `--write`.
Times are not compared; of commands that print nothing else (`times`) only that they end well is asked. Iterative
methods end elsewhere where a processor's linear algebra adds in another order: `small/NAME.ORDER.md` has what another
order prints, and a run must be that of one file:

    OPENBLAS_CORETYPE=Haswell python -m benchmarks.small promise --write --order haswell
"""

import math
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from benchmarks.harness import arguments

HERE = Path(__file__).parent
_DECLARED = tomllib.loads((HERE / "small.toml").read_text(encoding="utf-8"))
COMMANDS: dict[str, str] = _DECLARED["commands"]
"""By name, the words after `python -m benchmarks.`."""
OF_TIMES: dict[str, str] = _DECLARED["times"]
"""The same of commands whose output is times alone."""
TIMES = re.compile(r"\b(time|CPU|processor|per second|ratio|MB|files)\b|\[(s|ms|us)\]", re.IGNORECASE)
"""Heads of columns, and rows, that depend on the machine."""
SAME = 1e-3
"""Relative difference of two figures that print alike on two machines."""
Cells = dict[tuple[str, str, int, str], str]


def run(name: str) -> str:
    """Run a command in a process of its own and return what it printed; raise with the end of it where it failed."""
    module, *words = (COMMANDS | OF_TIMES)[name].split()
    command = [sys.executable, "-m", f"benchmarks.{module}", *words]
    done = subprocess.run(command, cwd=HERE.parent, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[1:])}: {done.stderr[-2000:]}")
    return done.stdout


def cells(printed: str) -> Cells:
    """Return all tables but times, by mark, first cell of the row, how often it came before, and column."""
    found: Cells = {}
    mark = ""
    head: list[str] = []
    for line in printed.splitlines():
        if line.startswith("## "):
            mark = line.removeprefix("## ")
        if not line.startswith("| "):
            head = []
            if re.search(r"\d", line) and not TIMES.search(line):
                found[mark, re.sub(r"[-\d.,e+ ]+", "#", line), sum(k[0] == mark for k in found), ""] = line
            continue
        row = [cell.strip() for cell in line.removeprefix("| ").removesuffix(" |").split(" | ")]
        if not head:
            head = row
            continue
        if TIMES.search(row[0]) or set(line) <= set("| -:"):
            continue
        for column, cell in zip(head[1:], row[1:], strict=False):
            if not TIMES.search(column):
                n_before = sum(key[:2] == (mark, row[0]) and key[3] == column for key in found)
                found[mark, row[0], n_before, column] = cell
    return found


def moved(before: Cells, now: Cells) -> list[str]:
    """List the cells that differ, each as `mark, row, column: before, now`."""
    return [
        f"{key[0]}, {key[1]}, {key[3]}: {before.get(key)}, {now.get(key)}"
        for key in {**before, **now}
        if not _is_same(before.get(key), now.get(key))
    ]


def _is_same(one: str | None, other: str | None) -> bool:
    if one == other or one is None or other is None:
        return one == other
    numbers = [re.findall(r"-?\d[\d,]*\.?\d*(?:e[-+]?\d+)?", text) for text in (one, other)]
    pairs = zip(*([float(n.replace(",", "")) for n in own] for own in numbers), strict=False)
    has_same_form = len(numbers[0]) == len(numbers[1]) > 0
    return has_same_form and all(math.isclose(a, b, rel_tol=SAME, abs_tol=1e-9) for a, b in pairs)


def place(name: str, order: str = "") -> Path:
    """Return the file of what a command printed, on processors that add in another `order`."""
    return HERE / "small" / f"{name}.{order}.md".replace("..", ".")


def moved_since(name: str, printed: str) -> list[str]:
    """List the cells that differ from the nearest of the files that are stored of a command."""
    files = sorted((HERE / "small").glob(f"{name}.*md"))
    now = cells(printed)
    return min((moved(cells(f.read_text(encoding="utf-8")), now) for f in files), key=len, default=["nothing stored"])


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("names", nargs="*", default=list(COMMANDS))
    parser.add_argument("--write", action="store_true", help="store what the commands print")
    parser.add_argument("--order", default="", help="name of the order of additions that is stored")
    options = parser.parse_args()
    for name in options.names:
        printed = run(name)
        lines = moved_since(name, printed)
        print(f"{name}: {len(lines)} moved", *lines[:20], sep="\n  ", flush=True)
        if options.write:
            place(name, options.order).parent.mkdir(exist_ok=True)
            place(name, options.order).write_text(printed)
