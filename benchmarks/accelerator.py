"""Upper bound of a night's gain from an accelerator: `python -m benchmarks.accelerator [S|M|L]`.

One first night in one process, Dagster and all; processor seconds of what could go to a device because it works on all
flights at once as arrays, and Amdahl's bound on the whole if it took no time there.
"""

import argparse
import tempfile
import time
from pathlib import Path

from benchmarks.harness import count_time, machine, markdown
from benchmarks.scale import SIZES, night
from hdt_core.calibration import exchanger
from pipelines.assets import calibration, twin
from pipelines.intake.simulated import write_fleet

PARTS = {
    "estimation of all flights at once": (twin, "estimate_flights"),
    "the exchanger's equations over arrays, whoever asks": (exchanger, "ln_conductance_ratio"),
    "the Digital System Model": (calibration, "calibrate"),
    "tracks of the twins, flight after flight": (twin, "track"),
}


def table(size: str, whole_s: float, spent: dict[str, list[float]]) -> str:
    """Return the table as Markdown."""
    s = SIZES[size]
    lines = [[f"a first night of {s.operators * s.tails * s.flights:,} flights", "processor [s]", "share", "bound"]]
    lines.append(["all", f"{whole_s:.1f}", "", ""])
    for part, (_, cpu_s) in spent.items():
        share = cpu_s / whole_s
        lines.append([part, f"{cpu_s:.2f}", f"{share:.1%}", f"{1 / (1 - share):.3f}"])
    return f"{markdown(lines)}\n\n{machine()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("size", nargs="?", default="M", choices=SIZES)
    options = parser.parse_args()
    spent = {part: [0.0, 0.0] for part in PARTS}
    for part, (module, name) in PARTS.items():
        count_time(module, name, spent[part])
    with tempfile.TemporaryDirectory() as scratch:
        list(write_fleet(Path(scratch), 11, SIZES[options.size]))
        began = time.process_time()
        night(Path(scratch, "landing"), Path(scratch, "home"), shared=False)
        print(table(options.size, time.process_time() - began, spent))


if __name__ == "__main__":
    main()
