"""Recordings, real ones and long ones: `python -m benchmarks.recordings aircraft [--write]`.

Claim: our simulator records as two real aircraft do, and an exchanger's outlet is foretold in time that no fit saw.

The recordings are not ours to ship: `HDT_REFERENCE` names the folder that holds `recorder_787_a330`. Compared is how
signals are recorded (last digit, noise from second to second, repeated values) and how the exchanger behaves, never
a parameter's values. `--write` puts the tables into docs/real.md.

    python -m benchmarks.recordings speed

Claim: all parameters of a ten-hour ARINC 717 recording of 1,024 words a second in 5 s of one core, map to arrays. The
recording is made up: random words, half of them numbers, the others four discretes each, 2,555 parameters with 92
million values. The peer is NumPy, which turns every word of the same file into a float64 and does nothing else. CPU of
one thread, best of the rounds, contestants in turn.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.harness import DOCS, Texts, best_cpu_s, markdown, run
from hdt_core.calibration.component_fit import calibrate_component
from hdt_core.components import components
from hdt_core.simulate.design import FleetSettings
from hdt_core.simulate.fleet import simulate_fleet
from hdt_recorder.aircraft_types import AircraftType, read_type
from hdt_recorder.decoding.coding import Coding, Polynomial
from hdt_recorder.decoding.decode import Series
from hdt_recorder.decoding.fit import decode, recognise
from hdt_recorder.decoding.layout import SYNC_WORDS, Counter, Map717, Parameter, Piece, Sample
from hdt_recorder.recordings import open_recording
from hdt_recorder.simulated_recordings import FULL_COUNTS
from hdt_recorder.types_of_zone import packaged_files

ROOT = Path(__file__).parents[1]
REFERENCE = Path(os.environ.get("HDT_REFERENCE", ROOT.parent / "shared/reference")) / "recorder_787_a330"
PAGE = DOCS / "real.md"
FILES = {"787": ("b787_767.zip", "b787_767"), "A330": ("a330_717.wgl.zip", "a330_717")}
COLUMNS = {
    "hot_in_degc": "hot inlet [K]", "hot_out_degc": "hot outlet [K]", "tat_degc": "TAT [K]",
    "pack_flow_lbpm": "pack flow [lb/min]", "ram_door_pct": "ram door [%]", "speed_rpm": "compressor speed [rpm]",
    "outlet_psia": "compressor exit [psi]", "diffuser_pct": "diffuser [%]", "mach": "Mach",
    "altitude_ft": "altitude [ft]",
}  # fmt: skip
SIMULATED = {
    "hot_in_degc": "hx_in_degc", "hot_out_degc": "hx_out_degc", "speed_rpm": "cc_speed_rpm",
    "outlet_psia": "cc_out_psia", "diffuser_pct": "vda_pos",
}  # fmt: skip
SPAN = {"787": slice(60, 228), "A330": slice(300, 592)}
"""Seconds of a simulated recording that are held against a real one: of taxi, of a climb from 3,000 ft."""


def kind_of(name: str) -> AircraftType:
    (file,) = (f for f in packaged_files() if f.stem == FILES[name][1])
    return replace(kind := read_type(file), map_file=REFERENCE / kind.map_file.name)


def recorded(name: str) -> dict[str, list[np.ndarray]]:
    """Values of each column, one array a unit, in the column's unit."""
    kind = kind_of(name)
    recording, layout = open_recording(REFERENCE / FILES[name][0], kind.map_file)
    stations = [s for table in kind.stations.values() for s in table]
    names = {n for s in stations for n in s.parameters}
    series = {s.parameter.name: s for s in decode(recording, [layout.parameters[n] for n in names])}
    return {s.column: [_values(series[n]) * s.scale + s.offset for n in s.parameters] for s in stations}


def _values(series: Series) -> np.ndarray:
    assert series.value is not None
    value = series.value[series.valid]
    return value[:: round(series.parameter.rate_hz)]


def simulated(name: str) -> dict[str, list[np.ndarray]]:
    """The same of both packs of a simulated flight."""
    size = FleetSettings(operators=1, tails=1, flights=1, cpl_share=1.0, suite=name)
    (flight,) = next(simulate_fleet(1, size)).cpl.values()
    packs = [flight.filter(pl.col("pack") == p).sort("report_time")[SPAN[name]] for p in (1, 2)]
    values = {}
    for column in COLUMNS:
        scale = 100.0 / FULL_COUNTS if column == "diffuser_pct" else 1.0
        values[column] = [
            scale * p[SIMULATED.get(column, column)].cast(pl.Float64).drop_nulls().to_numpy() for p in packs
        ]
    return values


def digit(values: list[np.ndarray]) -> float:
    steps = [np.diff(np.unique(v)) for v in values]
    return min((float(s.min()) for s in steps if s.size), default=float("nan"))


def noise(values: list[np.ndarray]) -> float:
    """From one second to the next, by second differences, which know no slow movement. Median of the units."""
    return float(np.median([np.diff(v, 2).std() / 6**0.5 for v in values]))


def repeated(values: list[np.ndarray]) -> float:
    return float(np.mean([np.mean(np.diff(v) == 0.0) for v in values]))


def signals() -> Iterator[list[str]]:
    yield ["type", "signal", *_of_both("last digit", "noise", "repeated")]
    for name in FILES:
        real = recorded(name)
        ours = simulated(name)
        for column, title in COLUMNS.items():
            if column in real:
                pairs = [(f(real[column]), f(ours[column])) for f in (digit, noise, repeated)]
                yield [name, title, *(_number(x) for pair in pairs for x in pair)]


def _of_both(*measures: str) -> list[str]:
    return [f"{what}, {whose}" for what in measures for whose in ("real", "simulated")]


def _number(x: float) -> str:
    return "one value" if np.isnan(x) else f"{x:.2g}"


def samples(name: str, unit: int) -> pl.DataFrame:
    """What the exchanger's component sees of a pack."""
    real = recorded(name)
    lengths = [len(v[min(unit, len(v) - 1)]) for v in real.values()]
    n = min(n for n in lengths if n > 1)
    at = {c: real[c][unit][:n] for c in ("hot_in_degc", "hot_out_degc", "tat_degc", "altitude_ft", "mach") if c in real}
    channels = components()["HXT"].record.channels
    frame = pl.DataFrame({c.signal: at[c.column] * c.scale + c.offset for c in channels})
    return components()["HXT"].record.derive(frame).with_row_index("second")


def foretold(name: str, unit: int, terms: tuple[str, ...], way: pl.Expr | int) -> float:
    """Root mean square of the outlet foretold, of samples that the fit has not seen or of the other pack. [K]"""
    own = samples(name, unit)
    component = components()["HXT"].with_terms(terms)
    learned, rest = (own, samples(name, way)) if isinstance(way, int) else (own.filter(way), own.filter(~way))
    model, _ = calibrate_component(component.model, learned)
    predicted = model.predict({}, {s.name: rest[s.name].to_numpy() for s in model.inputs})["hot_out_k"]
    return float(np.sqrt(np.mean((predicted - rest["hot_out_k"].to_numpy()) ** 2)))


def held_out() -> Iterator[list[str]]:
    """Halves, every other half minute, and the other pack."""
    trials = ["second half by the first", "first by the second", "half minutes in turn", "other pack"]
    yield ["type", "pack", "model", *trials]
    for name in FILES:
        for unit in (0, 1):
            half = pl.col("second") < samples(name, unit).height // 2
            ways: list[pl.Expr | int] = [half, ~half, pl.col("second") // 30 % 2 == 0]
            for title, terms in (("no term", ()), ("water_spray", ("water_spray",))):
                errors = [f"{foretold(name, unit, terms, way):.2f}" for way in ways]
                other = f"{foretold(name, unit, terms, 1 - unit):.2f}" if name == "A330" else "half the flow"
                yield [name, f"{unit + 1}", title, *errors, other]


def scatter() -> Iterator[list[str]]:
    """Effectiveness over the time compared: all of its scatter, that within minutes, and from second to second."""
    yield ["type", "pack", *_of_both("scatter", "within a minute", "noise")]
    for name in FILES:
        real = _effectiveness(recorded(name))
        ours = _effectiveness(simulated(name))
        for unit, (a, b) in enumerate(zip(real, ours, strict=True), 1):
            measures = (np.std, _about_slow, lambda values: noise([values]))
            yield [name, f"{unit}", *(f"{f(x):.4f}" for f in measures for x in (a, b))]


def _effectiveness(values: Mapping[str, list[np.ndarray]]) -> list[np.ndarray]:
    hot = values["hot_in_degc"]
    out = values["hot_out_degc"]
    tat = values["tat_degc"]
    n = min(len(v) for v in (*hot, *out, *tat))
    return [(hot[u][:n] - out[u][:n]) / (hot[u][:n] - tat[min(u, len(tat) - 1)][:n]) for u in (0, 1)]


def _about_slow(values: np.ndarray) -> float:
    """Scatter about a straight line through each minute: a climb moves the level."""
    parts = [values[i : i + 60] for i in range(0, len(values) - 59, 60)]
    return float(np.mean([np.std(p - np.polyval(np.polyfit(np.arange(60), p, 1), np.arange(60))) for p in parts]))


def lags() -> Iterator[list[str]]:
    """Time constant by which the outlet of a climb follows what its inlets ask for, by the sprayed model."""
    yield ["pack", "time constant of the best fit [s]", "rms at 0 s [K]", "rms there [K]"]
    model = components()["HXT"].with_terms(("water_spray",)).model
    for unit in (0, 1):
        own = samples("A330", unit)
        rms_by_lag = {}
        for lag_s in range(41):
            keep = np.exp(-1.0 / lag_s) if lag_s else 0.0
            slow = own.with_columns(
                pl.col(c).ewm_mean(alpha=1.0 - keep, adjust=False) for c in ("hot_in_k", "tat_k", "ram_flux_kg_s_m2")
            )
            fitted, _ = calibrate_component(model, slow)
            predicted = fitted.predict({}, {s.name: slow[s.name].to_numpy() for s in model.inputs})["hot_out_k"]
            rms_by_lag[lag_s] = float(np.sqrt(np.mean((predicted - own["hot_out_k"].to_numpy()) ** 2)))
        best = min(rms_by_lag, key=rms_by_lag.__getitem__)
        yield [f"{unit + 1}", f"{best}", f"{rms_by_lag[0]:.2f}", f"{rms_by_lag[best]:.2f}"]


HOURS, WORDS, ROUNDS = 10, 1024, 3


def parameters() -> dict[str, Parameter]:
    by_name = {}
    number = Coding("binary", bits=11, sign=11, steps=(Polynomial((0.0, 0.25)),))
    switch = Coding("discrete", texts={0: "OFF", 1: "ON"})
    for word in range(2, WORDS):
        for low, coding, bits in [(0, number, 12)] if word % 2 else [(i, switch, 1) for i in range(4)]:
            at = tuple(Sample(float(s), (Piece(s * WORDS + word, low, bits),)) for s in range(4))
            by_name[f"P{word}_{low}"] = Parameter(f"P{word}_{low}", coding, at, 1.0)
    return by_name


def recording(hours: int) -> np.ndarray:
    """Words, (seconds, words a second)."""
    seconds = hours * 3600
    words = np.random.default_rng(0).integers(0, 4096, (seconds, WORDS), dtype=np.uint16)
    words[:, 0] = np.resize(SYNC_WORDS, seconds)
    words[::4, 1] = np.arange(seconds // 4) % 4096
    return words


def stream(words: np.ndarray) -> np.ndarray:
    """Twelve bits after twelve bits, the least significant first."""
    a, b = words.reshape(-1, 2).T
    return np.stack([a & 255, a >> 8 | (b & 15) << 4, b >> 4], axis=1).astype(np.uint8).ravel()


def speed(hours: int = HOURS) -> Texts:
    """Time of a recording of so many hours."""
    layout = Map717(WORDS, parameters(), Counter(Piece(1, 0, 12)))
    words = recording(hours)
    aligned = words.view(np.uint8).ravel()
    bits = stream(words)
    values = 0

    def read(data: np.ndarray) -> None:
        nonlocal values
        values = sum(s.t_s.size for s in decode(recognise(data, layout), layout.parameters.values()))

    contestants: dict[str, Callable[[], object]] = {
        "NumPy, every word a float64": lambda: aligned.view("<u2").astype(np.float64),
        "ours, words in 16 bits": lambda: read(aligned),
        "ours, stream of bits": lambda: read(bits),
    }
    best = best_cpu_s(contestants, ROUNDS)
    peer = next(iter(best.values()))
    size = f"{len(layout.parameters):,} parameters, {values / 1e6:.0f} million values"
    lines = [[f"{hours} h, {WORDS:,} words a second, {size}", "CPU [s]", "times the peer"]]
    yield "", markdown([*lines, *([name, f"{s:.2f}", f"{s / peer:.1f}"] for name, s in best.items())])


def aircraft() -> Texts:
    """Return each table of the page."""
    if not REFERENCE.is_dir():
        raise SystemExit(f"no recordings in {REFERENCE}: set HDT_REFERENCE")
    for mark, table in (("signals", signals()), ("scatter", scatter()), ("held out", held_out()), ("lags", lags())):
        yield mark, markdown(list(table))


if __name__ == "__main__":
    run(aircraft, speed, page=PAGE)
