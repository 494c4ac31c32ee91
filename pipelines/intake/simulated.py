"""Write a simulated fleet as a landing zone, with the truth in another folder."""

from collections.abc import Iterator
from pathlib import Path

import polars as pl

from hdt_core.simulate.design import FleetSettings
from hdt_core.simulate.fleet import Aircraft, by_month, design_truth, simulate_fleet
from pipelines.intake.landing_file import RECORDER
from pipelines.intake.readers import Writer, readers
from pipelines.storage.files import replacing

_TIME = "%Y-%m-%dT%H:%M:%SZ"


def write_fleet(folder: Path, seed: int, size: FleetSettings, form: str = "") -> Iterator[str]:
    """Write `folder/landing` and `folder/truth`; yields each aircraft's name when its files are there.

    With `form`, each logged flight is a recorder's file of that format and nothing else is delivered of it; otherwise
    history is one Parquet file a month, as an operator delivers its past. The truth is one row a flight and pack
    (`health`), a life or fault (`events`), a design value (`design`).
    """
    landing = folder / "landing"
    truth = folder / "truth"
    _parquet(design_truth(seed), truth / "design.parquet")
    tables = []
    type_column = {}
    write = None
    if form:
        name, write = readers()[RECORDER].install(landing, size.suite, form)
        type_column = {"type": pl.lit(name)}
    for aircraft in simulate_fleet(seed, size):
        _deliver(aircraft, landing / aircraft.operator / aircraft.tail, write)
        tables.append((aircraft.fleet.with_columns(**type_column), aircraft.health, aircraft.events))
        yield f"{aircraft.operator} {aircraft.tail}"
    fleets, healths, events = zip(*tables, strict=True)
    _csv(pl.concat(fleets), landing / "fleet.csv")
    _parquet(pl.concat(healths), truth / "health.parquet")
    _parquet(pl.concat(events), truth / "events.parquet")


def _deliver(aircraft: Aircraft, folder: Path, write: Writer | None) -> None:
    _csv(aircraft.messages, folder / "messages.csv")
    _csv(aircraft.maintenance, folder / "maintenance.csv")
    if write:
        for flight, rows in aircraft.cpl.items():
            write(rows, folder / RECORDER / f"{flight}.dat")
        return
    for month, rows in by_month(aircraft.snapshots).items():
        _parquet(rows, folder / "acms" / f"history_{month}.parquet")
    for flight, rows in aircraft.cpl.items():
        _parquet(rows, folder / "cpl" / f"{flight}.parquet")


def _parquet(frame: pl.DataFrame, path: Path) -> None:
    with replacing(path) as temporary:
        frame.write_parquet(temporary, compression="zstd")


def _csv(frame: pl.DataFrame, path: Path) -> None:
    with replacing(path) as temporary:
        frame.write_csv(temporary, datetime_format=_TIME)
