"""Write simulated flights as recordings, with the parameter map and the type description that read them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from hdt_core.simulate.recorder import SUITES
from hdt_recorder.aircraft_types import PACK, AircraftType, Station, read_type
from hdt_recorder.decoding.encode import encode_717, encode_767
from hdt_recorder.decoding.layout import Map717, ParameterMap
from hdt_recorder.decoding.plain_map import read_toml
from hdt_recorder.types_of_zone import packaged_files
from pipelines.intake.readers import TYPES, Writer
from pipelines.storage.files import replacing

Floats = npt.NDArray[np.float64]
NAMES = {"787": "B787-767", "A330": "A330-717"}
BITS, SIGN = 23, 1
FULL_COUNTS = 950.0
"""Counts of the simulated diffuser that are 100 % of its travel."""
COLUMN_OF: Mapping[str, str] = {
    "hot_in_degc": "hx_in_degc", "hot_out_degc": "hx_out_degc", "speed_rpm": "cc_speed_rpm", "inlet_degc": "cc_in_degc",
    "inlet_psia": "cc_in_psia", "outlet_degc": "cc_out_degc", "outlet_psia": "cc_out_psia", "acm_rpm": "cc_speed_rpm",
    "ram_exit_pct": "ram_door_pct",
}  # fmt: skip
"""The contract's column that equals a component's column of the same pack."""
NOT_SIMULATED = frozenset({"return_pct", "fan_rpm"})
WORDS_A_PARAMETER = 2


@dataclass(frozen=True)
class Recorder:
    """A recorder of one type: its parameters and their layout."""

    kind: AircraftType
    layout: ParameterMap
    places: Mapping[str, tuple[Station, int, int]]
    """Per parameter: its column, the unit, and how many units its table has."""

    def write(self, flight: pl.DataFrame, path: Path) -> None:
        """Write one flight's 1 Hz rows of both packs as a recording."""
        packs = [flight.filter(pl.col("pack") == p).sort("report_time") for p in (1, 2)]
        values = {name: _values(packs, *self.places[name]) for name in self.places} | self._clock(packs[0])
        data = encode_717(self.layout, values) if isinstance(self.layout, Map717) else encode_767(self.layout, values)
        with replacing(path) as temporary:
            Path(temporary).write_bytes(data)

    def _clock(self, rows: pl.DataFrame) -> dict[str, Floats]:
        moment = rows["report_time"]
        parts = {"hour": moment.dt.hour(), "minute": moment.dt.minute(), "second": moment.dt.second()}
        return {name: parts[part].cast(pl.Float64).to_numpy() for part, name in self.kind.clock.items()}


def install(landing: Path, suite: str, form: str) -> tuple[str, Writer]:
    """Write type and map into a landing zone's `types/`, and return the type's name and the writer of recordings.

    Parameters
    ----------
    suite : str
        Type of aircraft, one of `NAMES`.
    form : str
        `717` or `767`.
    """
    (file,) = (f for f in packaged_files() if read_type(f).name == NAMES[suite])
    kind = read_type(file)
    text = file.read_text("utf-8")
    map_name = f"maps/{file.stem}_as_{form}.toml"
    description = text.replace(f'map = "{kind.map_file.name}"', f'map = "{map_name}"')
    places = _places(kind)
    layout = _map_717(kind, places, suite) if form == "717" else _map_767(kind, places, suite)
    for path, content in (
        (landing / TYPES / file.name, _without_rates(description)),
        (landing / TYPES / map_name, layout),
    ):
        with replacing(path) as temporary:
            Path(temporary).write_text(content, encoding="utf-8")
    recorder = Recorder(read_type(landing / TYPES / file.name), read_toml(layout), places)
    return recorder.kind.name, recorder.write


def _without_rates(text: str) -> str:
    """Drop the rates of the real recorder: the simulated one writes every parameter once a second."""
    return text.replace(", rate_hz = 1 }", " }").replace(", rate_hz = 2,", ",")


def _places(kind: AircraftType) -> dict[str, tuple[Station, int, int]]:
    """Return the first column of each parameter, those of the packs before others."""
    places: dict[str, tuple[Station, int, int]] = {}
    for table in sorted(kind.stations, key=lambda t: t != PACK):
        for station in kind.stations[table]:
            for unit, name in enumerate(station.parameters):
                if name:
                    places.setdefault(name, (station, unit, kind.units[table]))
    return places


def _values(packs: list[pl.DataFrame], station: Station, unit: int, units: int) -> Floats:
    """Return a parameter's values in the recorder's unit; units of a component are shared out among the packs."""
    rows = packs[unit * len(packs) // units]
    column = station.column
    if column == "diffuser_pct":
        values = rows["vda_pos"].cast(pl.Float64).to_numpy() * (100.0 / FULL_COUNTS)
    elif column in NOT_SIMULATED:
        values = np.zeros(rows.height)
    else:
        values = rows[COLUMN_OF.get(column, column)].cast(pl.Float64).to_numpy()
    return np.asarray((values - station.offset) / station.scale)


def _step(station: Station, suite: str) -> float:
    """Return the resolution of a parameter, in the recorder's unit."""
    column = COLUMN_OF.get(station.column, station.column)
    sensors = SUITES[suite].sensors
    return (sensors[column].step if column in sensors else 0.0625) / station.scale


def _numbers(kind: AircraftType, places: Mapping[str, tuple[Station, int, int]], suite: str) -> Iterator[str]:
    """Yield name, unit and scale of every parameter, as lines of the map."""
    for name, (station, _, _) in places.items():
        unit = station.unit or station.column.rpartition("_")[2]
        yield f'name = "{name}"\nunit = "{unit}"\nsigned = true\nscale = {_step(station, suite)!r}'
    for name in kind.clock.values():
        yield f'name = "{name}"\nsigned = true'


def _map_717(kind: AircraftType, places: Mapping[str, tuple[Station, int, int]], suite: str) -> str:
    entries_of_numbers = list(_numbers(kind, places, suite))
    words = 64
    while words < 2 + WORDS_A_PARAMETER * len(entries_of_numbers):
        words *= 2
    head = f'format = "ARINC 717"\nwords_per_second = {words}\ncounter = {{ subframe = 1, word = 2, bits = "1-12" }}\n'
    where = 'subframe = [1, 2, 3, 4]\nword = [[{}], [{}]]\nbits = ["1-12", "1-12"]'
    entries = (f"[[parameter]]\n{t}\n{where.format(3 + 2 * i, 4 + 2 * i)}\n" for i, t in enumerate(entries_of_numbers))
    return "\n".join([head, *entries])


def _map_767(kind: AircraftType, places: Mapping[str, tuple[Station, int, int]], suite: str) -> str:
    head = 'format = "ARINC 767"\nrevision = "SIMULATED"\nframes = [{ number = 3, rate_hz = 1 }]\n'
    entries = (f"[[parameter]]\n{t}\nframe = 3\nsize = {BITS + SIGN}\n" for t in _numbers(kind, places, suite))
    return "\n".join([head, *entries])
