"""Landing zones of simulated aircraft: any operator and tail, whatever part of their files came."""

import re
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from hdt_core.simulate.design import FleetSettings
from hdt_core.simulate.fleet import Aircraft, by_month, simulate_fleet

STAMP = "%Y-%m-%dT%H:%M:%SZ"


@dataclass
class Zone:
    """What one aircraft's ground station will drop, in the recorder's units; change it, then `drop` it."""

    operator: str
    tail: str
    snapshots: pl.DataFrame
    cpl: dict[str, pl.DataFrame]
    messages: pl.DataFrame | None
    maintenance: pl.DataFrame | None
    fleet: pl.DataFrame

    @property
    def flights(self) -> list[str]:
        """Flight ids, in order of departure."""
        return self.snapshots["flight_id"].unique().sort().to_list()

    def only(self, flights: list[str]) -> "Zone":
        """The same aircraft with some of its flights."""
        rows = self.snapshots.filter(pl.col("flight_id").is_in(flights))
        cpl = {f: log for f, log in self.cpl.items() if f in flights}
        return Zone(self.operator, self.tail, rows, cpl, self.messages, self.maintenance, self.fleet)

    def folder(self, landing: Path) -> Path:
        """Where its files lie."""
        return landing / self.operator / self.tail

    def _make_folder(self, landing: Path, kind: str) -> Path:
        folder = self.folder(landing) / kind
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def drop_csv(self, landing: Path) -> None:
        """One text file a flight."""
        folder = self._make_folder(landing, "acms")
        for (flight,), rows in self.snapshots.partition_by("flight_id", as_dict=True).items():
            rows.write_csv(folder / f"{flight}.csv", datetime_format=STAMP)

    def drop_history(self, landing: Path) -> None:
        """One Parquet file a month."""
        folder = self._make_folder(landing, "acms")
        for month, rows in by_month(self.snapshots).items():
            rows.write_parquet(folder / f"history_{month}.parquet")

    def drop_logs(self, landing: Path) -> None:
        """The 1 Hz logs."""
        folder = self._make_folder(landing, "cpl")
        for flight, log in self.cpl.items():
            log.write_parquet(folder / f"{flight}.parquet")

    def drop_papers(self, landing: Path) -> None:
        """What was written down: messages.csv and maintenance.csv."""
        self.folder(landing).mkdir(parents=True, exist_ok=True)
        for name, frame in (("messages", self.messages), ("maintenance", self.maintenance)):
            if frame is not None:
                frame.write_csv(self.folder(landing) / f"{name}.csv", datetime_format=STAMP)


def drop_fleet(landing: Path, zones: list[Zone]) -> None:
    """fleet.csv of these aircraft."""
    landing.mkdir(parents=True, exist_ok=True)
    pl.concat([z.fleet for z in zones], how="vertical_relaxed").write_csv(landing / "fleet.csv")


def simulated(
    seed: int, flights: int, *, operator: str, tail: str, cpl: int = 0, first_day: str = "2024-03-04"
) -> Zone:
    """One aircraft of the project's own simulator, under any operator and tail."""
    share = min(1.0, cpl / flights)
    size = FleetSettings(operators=1, tails=1, flights=flights, first_day=first_day, cpl_share=share)
    return renamed(next(iter(simulate_fleet(seed, size))), operator, tail)


def renamed(aircraft: Aircraft, operator: str, tail: str) -> Zone:
    """A simulated aircraft under another name."""
    own = re.escape(aircraft.tail) + "_"

    def flight(frame: pl.DataFrame) -> pl.DataFrame:
        return frame.with_columns(pl.col("flight_id").str.replace(own, tail + "_"))

    fleet = aircraft.fleet.with_columns(operator=pl.lit(operator), tail=pl.lit(tail))
    cpl = {re.sub(own, tail + "_", f): flight(log) for f, log in aircraft.cpl.items()}
    return Zone(operator, tail, flight(aircraft.snapshots), cpl, flight(aircraft.messages), aircraft.maintenance, fleet)
