"""Which faults of a record are found, by kind and size: `python -m benchmarks.record --write`, half an hour.

A fault is silent where a pack's urgency, loss, due date, life or alerts move by more than chance moves them and no
reason names its flight or its line. Chance is what one flight left out moves.
"""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from datetime import date
from functools import partial
from itertools import pairwise
from math import exp, log
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import Texts, markdown, run
from benchmarks.record_faults import KINDS, UNITS, Fault, Record, leave_out, read_record
from benchmarks.scale import night
from pipelines.storage.catalog import connect

PAGE = Path(__file__).parents[1] / "docs/bad-input.md"
SAMPLES = Path(__file__).parents[1] / "data_samples"
HALVES = (
    (("AQX", "LX-AAA"), ("AQX", "LX-AAC"), ("BZR", "A9-BAC")),
    (("AQX", "LX-AAD"), ("BZR", "A9-BAB"), ("BZR", "A9-BAD")),
)
"""Aircraft that have faults on a night, each its own, while those of the other half have none."""
AT_ONCE = len(HALVES[0])
LEFT_OUT = "left_out"
"""Kind of a draw that is no fault: what one flight more or less moves."""
FIRST, LAST = date(2024, 4, 15), date(2024, 6, 10)
UNLOGGED, LOGS = "unlogged work", ("messages.csv", "maintenance.csv")
REASONS = (
    "select coalesce(flight_id, ''), file, reason from quarantine where tail = ? and scope != 'value'",
    "select flight_id, coalesce(other_flight_id, ''), reason from held_flights where tail = ?",
    "select '', file || message_time || pack, note from messages where tail = ? and note is not null",
    "select '', file || done_on || pack, note from maintenance where tail = ? and note is not null",
    f"select flight_id, component || pack, '{UNLOGGED}' from unlogged_work where tail = ?",
    "select since_flight_id, signal, reason from recorder_channels where tail = ?",
)
"""Where reasons stand: flight, place and reason."""
HELD = "select flight_id from held_flights where tail = ?"
PACKS = "select pack, urgency, hx_fouling, hx_fouling_sd, rul_flights from fleet_ranking where tail = ? order by pack"
LIVES = "select pack, component, ended_by, n_flights from unit_lives where tail = ? order by pack, component, life"
ALERTS = "select pack, diagnosis, coalesce(sensor, '') from open_alerts where tail = ? order by all"
LIFE_TOLERANCE = 2
"""Flights by which a life may differ: one that is held, and one that is two."""
LOSS_TOLERANCE, FORECAST_TOLERANCE = 1.0, log(1.25)
"""A loss' own noise, in its standard deviations, and a forecast's, in the logarithm of its flights: a quarter."""
BANDS = {
    "s": (60.0, 3_600.0, 86_400.0, 30 * 86_400.0), "min": (15.0, 30.0), "legs": (2.0, 4.0), "flights": (5.0, 20.0),
    "steps": (3.0, 6.0), "days": (3.0, 10.0, 60.0),
}  # fmt: skip
"""Sizes at which the table begins a new row, by unit."""


class PackOutcome(NamedTuple):
    """Row of a pack in the ranking: `PACKS`."""

    pack: int
    urgency: str
    loss: float | None
    loss_sd: float | None
    flights_left: float | None


class Life(NamedTuple):
    """Life of a unit: `LIVES`."""

    pack: int
    component: str
    ended_by: str | None
    n_flights: int


@dataclass(frozen=True)
class Outcome:
    """What a night made of an aircraft: reasons (flight, place and reason), held flights, packs, lives, open alerts."""

    reasons: frozenset[tuple[str, str, str]]
    held: frozenset[str]
    packs: Sequence[PackOutcome]
    lives: Sequence[Life]
    alerts: frozenset[tuple[Any, ...]]


@dataclass(frozen=True)
class Verdict:
    """What became of one fault.

    Attributes
    ----------
    is_found : bool
        Whether a reason that the sound record has not got names its flight or line.
    moved : tuple of str
        What moved, but for losses and forecasts.
    loss_moved : float
        Largest change of a loss, in its standard deviations.
    life_moved : float
        Largest change of a forecast, in the logarithm of its flights.
    n_other_held, n_other : int
        Flights without a fault that are held, and how many there are.
    """

    kind: str
    size: float
    tail: str
    seed: int
    is_found: bool
    moved: tuple[str, ...]
    loss_moved: float
    life_moved: float
    n_other_held: int
    n_other: int

    @property
    def has_moved(self) -> bool:
        """Whether more moved than chance moves."""
        return bool(self.moved) or self.loss_moved > LOSS_TOLERANCE or self.life_moved > FORECAST_TOLERANCE

    @property
    def is_silent(self) -> bool:
        """Whether more moved than chance moves, and no reason names why."""
        return self.has_moved and not self.is_found


def outcome(home: Path, tail: str) -> Outcome:
    """Read what a home's catalog has of an aircraft."""
    with connect(home) as con:
        reasons = frozenset(row for query in REASONS for row in con.execute(query, [tail]).fetchall())
        held = frozenset(flight for (flight,) in con.execute(HELD, [tail]).fetchall())
        packs = [PackOutcome(*row) for row in con.execute(PACKS, [tail]).fetchall()]
        lives = [Life(*row) for row in con.execute(LIVES, [tail]).fetchall()]
        alerts = frozenset(con.execute(ALERTS, [tail]).fetchall())
    return Outcome(reasons, held, packs, lives, alerts)


def compare(fault: Fault, seed: int, sound: Outcome, faulty: Outcome) -> Verdict:
    """Judge a fault by what a night made of the record with it and without."""
    new = faulty.reasons - sound.reasons
    pairs = list(zip(sound.packs, faulty.packs, strict=True))
    moved = [f"urgency of pack {a.pack} from {a.urgency} to {b.urgency}" for a, b in pairs if a.urgency != b.urgency]
    moved += [f"loss of pack {a.pack}" for a, b in pairs if (a.loss is None) != (b.loss is None)]
    moved += [f"forecast of pack {a.pack}" for a, b in pairs if (a.flights_left is None) != (b.flights_left is None)]
    moved += [f"alert {' '.join(map(str, alert))}" for alert in sorted(sound.alerts ^ faulty.alerts)]
    moved += _lives_that_differ(sound.lives, faulty.lives)
    losses = [
        abs(a.loss - b.loss) / a.loss_sd for a, b in pairs if a.loss is not None and b.loss is not None and a.loss_sd
    ]
    forecasts = [abs(log(a.flights_left / b.flights_left)) for a, b in pairs if a.flights_left and b.flights_left]
    return Verdict(
        kind=fault.kind,
        size=fault.size,
        tail=fault.record.tail,
        seed=seed,
        is_found=any(_names(reason, fault) for reason in new),
        moved=tuple(moved),
        loss_moved=max(losses, default=0.0),
        life_moved=max(forecasts, default=0.0),
        n_other_held=len(faulty.held - sound.held - fault.flights),
        n_other=len(set(fault.record.flights) - fault.flights),
    )


def _names(reason: tuple[str, str, str], fault: Fault) -> bool:
    """Return whether a reason names a flight of the fault, or a line where the fault is in a log."""
    flight, place, what = reason
    if not fault.flights:
        return what == UNLOGGED or any(log in place for log in LOGS)
    return flight in fault.flights or any(name in place for name in fault.flights)


def _lives_that_differ(sound: Sequence[Life], faulty: Sequence[Life]) -> list[str]:
    """Describe the lives that ended otherwise, or differ in length by more than a flight or two."""
    is_same_end = [life[:3] for life in sound] == [life[:3] for life in faulty]
    pairs = zip(sound, faulty, strict=False)
    if is_same_end and all(abs(a.n_flights - b.n_flights) <= LIFE_TOLERANCE for a, b in pairs):
        return []
    gone = ", ".join(_described(life) for life in sound if life not in faulty)
    come = ", ".join(_described(life) for life in faulty if life not in sound)
    return [f"lives from {gone} to {come}"]


def _described(life: Life) -> str:
    return f"{life.component} {life.pack} of {life.n_flights} flights ({life.ended_by or 'flies'})"


def fly(landing: Path, home: Path, records: Sequence[Record]) -> None:
    """Run a night on what these aircraft deliver."""
    landing.mkdir(exist_ok=True)
    shutil.copy(SAMPLES / "fleet.csv", landing)
    for record in records:
        record.write(landing)
    night(landing, home, shared=False)


def draw(round_number: int, kinds: Sequence[str], folder: Path) -> list[Verdict]:
    """Draw a fault for each aircraft of a half, run the night that meets them, and judge each.

    `folder` holds a landing zone and a home of each half without faults, and the home `sound` of both.
    """
    half = round_number % 2
    seeds = range(round_number * AT_ONCE, (round_number + 1) * AT_ONCE)
    faults = [_draw_fault(seed, kinds, own, folder / "landing") for seed, own in zip(seeds, HALVES[half], strict=True)]
    with tempfile.TemporaryDirectory() as temporary:
        landing = Path(temporary) / "landing"
        home = Path(temporary) / "home"
        shutil.copytree(folder / f"landing{1 - half}", landing)
        shutil.copytree(folder / f"home{1 - half}", home)
        fly(landing, home, [fault.record for fault in faults])
        return [
            compare(fault, seed, outcome(folder / "sound", fault.record.tail), outcome(home, fault.record.tail))
            for seed, fault in zip(seeds, faults, strict=True)
        ]


def _draw_fault(seed: int, kinds: Sequence[str], own: tuple[str, str], landing: Path) -> Fault:
    make = (KINDS | {LEFT_OUT: leave_out})[kinds[seed % len(kinds)]]
    return make(np.random.default_rng([seed, 2024]), _read(own, landing))


def _read(own: tuple[str, str], landing: Path = SAMPLES) -> Record:
    return read_record(landing, *own, FIRST, LAST)


def prepare(folder: Path) -> None:
    """Make the homes that a draw begins with."""
    records = [[_read(own) for own in half] for half in HALVES]
    for number, half in enumerate(records):
        fly(folder / f"landing{number}", folder / f"home{number}", half)
    shutil.copytree(folder / "landing0", folder / "landing")
    shutil.copytree(folder / "home0", folder / "sound")
    fly(folder / "landing", folder / "sound", records[1])


def draw_all(draws: int, workers: int, kinds: Sequence[str] = (*KINDS, LEFT_OUT)) -> Iterator[Verdict]:
    """Draw so many faults, of each kind in turn."""
    with tempfile.TemporaryDirectory() as temporary:
        prepare(Path(temporary))
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            rounds = range(-(-draws // AT_ONCE))
            for found in pool.map(partial(draw, kinds=kinds, folder=Path(temporary)), rounds):
                yield from found


def table(verdicts: Sequence[Verdict]) -> str:
    """Return what became of the faults, by kind and size, as a Markdown table."""
    lines = [["fault", "size", "draws", "named", "not named: nothing moved", "silent"]]
    for kind in KINDS:
        edges = (0.0, *BANDS[UNITS[kind]], float("inf"))
        for low, high in pairwise(edges):
            own = [v for v in verdicts if v.kind == kind and low <= v.size < high]
            if own:
                silent = sum(v.is_silent for v in own)
                named = sum(v.is_found for v in own)
                counts = (len(own), named, len(own) - named - silent, silent)
                lines.append([kind, _band(low, high, UNITS[kind]), *map(str, counts)])
    return markdown(lines)


def _band(low: float, high: float, unit: str) -> str:
    bounds = f"from {low:,.0f}" if high == float("inf") else f"{low:,.0f} to {high:,.0f}"
    return f"{bounds} {unit}"


def main(draws: int = 330, workers: int = 2) -> Texts:
    """Draw faults, and tabulate which are named and which move anything."""
    verdicts = list(draw_all(draws, workers))
    faults = [v for v in verdicts if v.kind in KINDS]
    chance = [v for v in verdicts if v.kind not in KINDS]
    silent = [_described_fault(v) for v in faults if v.is_silent]
    held = sum(v.n_other_held for v in faults)
    others = sum(v.n_other for v in faults)
    loss, forecast = (max(getattr(v, name) for v in chance) if chance else 0.0 for name in ("loss_moved", "life_moved"))
    text = [
        table(faults),
        f"Good flights held beside a fault: {held} of {others:,}. A flight left out ({len(chance)} draws) moves a loss "
        f"by at most {loss:.2f} of its standard deviation and a forecast by {100 * (exp(forecast) - 1):.0f} %.",
        "\n".join(["Silent:", "", *silent]) if silent else "None is silent.",
    ]
    yield "record", "\n\n".join(text)


def _described_fault(verdict: Verdict) -> str:
    what = f"{verdict.kind} of {verdict.size:.0f} {UNITS[verdict.kind]} on {verdict.tail}"
    figures = f"loss by {verdict.loss_moved:.1f} sd, forecast by {100 * (exp(verdict.life_moved) - 1):.0f} %"
    return f"- {what}: {'; '.join([*verdict.moved, figures])}"


if __name__ == "__main__":
    run(main, page=PAGE)
