"""Timing of contestants that do the same work in turn, and the table of results."""

import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from os import cpu_count
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"))


@dataclass(frozen=True, slots=True)
class Candidate:
    """Contestant that does `count` pieces of the work; `run` returns its answers."""

    run: Callable[[], np.ndarray]
    count: int = 1


@dataclass(frozen=True, slots=True)
class Claim:
    """Median processor seconds a piece of `work`, ours first; the answers' distance from ours; goals.

    Parameters
    ----------
    seconds : dict of candidate to float
    apart : dict of candidate to float
        Largest difference from our answers.
    goals : dict of candidate to float
        How many times longer a peer should take.
    """

    work: str
    seconds: dict[str, float]
    apart: dict[str, float]
    goals: dict[str, float] = field(default_factory=dict)

    @property
    def ours_s(self) -> float:
        """Return our own time. [s]"""
        return next(iter(self.seconds.values()))

    @property
    def ratios(self) -> dict[str, float]:
        """Return each peer's time over ours."""
        return {peer: peer_s / self.ours_s for peer, peer_s in list(self.seconds.items())[1:]}


def race(
    work: str,
    candidates: Mapping[str, Candidate],
    rounds: int,
    *,
    goals: Mapping[str, float] | None = None,
) -> Claim:
    """Run every contestant once a round, ours first, after one warm-up round; return medians over the rounds."""
    durations: dict[str, list[float]] = {name: [] for name in candidates}
    answers: dict[str, np.ndarray] = {}
    with threadpool_limits(1):
        for turn in range(rounds + 1):
            for name, candidate in candidates.items():
                started = time.process_time()
                answers[name] = np.asarray(candidate.run())
                if turn > 0:
                    durations[name].append((time.process_time() - started) / candidate.count)
    ours = next(iter(answers.values()))
    apart = {name: _apart(ours, other) for name, other in list(answers.items())[1:]}
    medians = {name: float(np.median(seconds)) for name, seconds in durations.items()}
    return Claim(work, medians, apart, dict(goals or {}))


def machine(packages: Sequence[str]) -> str:
    """Describe the machine in one line."""
    versions = ", ".join(f"{name} {_version(name)}" for name in packages)
    return f"{_processor()}, {cpu_count()} cores, one used; Python {platform.python_version()}, {versions}."


def _apart(ours: np.ndarray, other: np.ndarray) -> float:
    """Return the largest difference over the answers both have; a slow peer does only the first pieces."""
    return float(np.abs(ours[: len(other)] - other[: len(ours)]).max())


def times(ratio: float) -> str:
    """Format a ratio."""
    return f"{ratio:,.0f} x" if ratio >= 10.0 else f"{ratio:.1f} x"


def clock(seconds: float) -> str:
    """Format a time in a suitable unit."""
    size, unit = next((u for u in UNITS if seconds >= u[0]), UNITS[-1])
    return f"{seconds / size:.3g} {unit}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"
