"""Upper bound of a night's gain from an accelerator: `python -m benchmarks.accelerator [S|M|L] [--write]`.

One first night in one process, Dagster and all; processor seconds of what could go to a device because it works on all
flights at once as arrays, and Amdahl's bound on the whole if it took no time there. `--write` puts the table into
docs/scale.md.
"""

import importlib
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.harness import arguments, machine, show
from benchmarks.scale import SIZES, night
from pipelines.intake.simulated import write_fleet

PAGE = Path(__file__).parents[1] / "docs" / "scale.md"
PARTS = {
    "estimation of all flights at once": [("pipelines.assets.twin", "estimate_flights")],
    "the exchanger's equations over arrays, whoever asks": [("hdt_core.calibration.exchanger", "ln_conductance_ratio")],
    "the Digital System Model": [("pipelines.assets.calibration", "calibrate")],
    "tracks of the twins, flight after flight": [("pipelines.assets.twin", "track")],
}


def timed(spent: Counter[str]) -> None:
    """Instrument the named functions to count their processor seconds."""
    for part, places in PARTS.items():
        for module_name, name in places:
            module = importlib.import_module(module_name)
            setattr(module, name, _timed(getattr(module, name), part, spent))


def _timed(call: Callable[..., Any], part: str, spent: Counter[str]) -> Callable[..., Any]:
    def counted(*args: Any, **kwargs: Any) -> Any:
        began = time.process_time()
        try:
            return call(*args, **kwargs)
        finally:
            spent[part] += time.process_time() - began

    return counted


def table(size: str, whole_s: float, spent: Counter[str]) -> str:
    """Return the table as Markdown."""
    s = SIZES[size]
    lines = [
        f"| a first night of {s.operators * s.tails * s.flights:,} flights | processor [s] | share | bound |",
        "| --- | ---: | ---: | ---: |",
        f"| all | {whole_s:.1f} | | |",
    ]
    for part in PARTS:
        share = spent[part] / whole_s
        lines.append(f"| {part} | {spent[part]:.2f} | {share:.1%} | {1 / (1 - share):.3f} |")
    lines.append(f"\n{machine()}")
    return "\n".join(lines)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("size", nargs="?", default="M", choices=SIZES)
    options = parser.parse_args()
    spent: Counter[str] = Counter()
    timed(spent)
    with tempfile.TemporaryDirectory() as scratch:
        list(write_fleet(Path(scratch), 11, SIZES[options.size]))
        began = time.process_time()
        night(Path(scratch, "landing"), Path(scratch, "home"), shared=False)
        text = table(options.size, time.process_time() - began, spent)
    show("accelerator", text, PAGE, write=options.write)


if __name__ == "__main__":
    main()
