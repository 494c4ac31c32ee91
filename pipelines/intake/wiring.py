"""Columns in another unit than agreed, or in each other's place: where physics holds only after one change.

A flight's columns must obey the laws of `laws`. Where most rows of a pack break one of them, each unit a column is
written in elsewhere and each swap of two columns is tried. If after one such change all laws hold, the recorder wrote
the column that way: those rows are refused, with the column by name. A faulty sensor breaks laws too, and no change
mends them: its readings are stored, and judged flight by flight afterwards. A Mach number in knots lies outside what a
Mach number can be; of it the values are refused and the rows stored.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from hdt_core.physics.air import GAMMA, R_J_KG_K, mach_from_pressures, standard_pressure_pa
from hdt_core.physics.model import Array
from pipelines.intake.columns import POUND_KG, PSI_PA, SIGNAL_COLUMNS, SIGNAL_NAMES, ZERO_CELSIUS_K
from pipelines.intake.laws import HIGHEST, broken, readings

PACK = ("file_index", "flight_id", "pack")
MOST, FEW = 0.7, 0.12
"""Share of a pack's rows from which on a law is broken, and up to which it holds."""
ENOUGH = 5
"""Rows that must say something of a law, and readings a column must have, not all the same."""
FAR = 1e100
"""A number beyond it counts as it: far from any reading, and its square is still a number."""
SWAPPED, OUTSIDE = "swapped_columns", "out_of_range"
KNOT_M_S = 1852 / 3600
SEA_LEVEL_PA, SEA_LEVEL_SOUND_M_S = 101_325.0, 340.294

Columns = Mapping[str, Array]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
"""Recorded name: values in the recorded unit, NaN where missing."""


@dataclass(frozen=True, slots=True)
class Change:
    """How a file may have been written: what each column holds if it was, and what to say then."""

    reason: str
    says: str
    made: Mapping[str, Callable[[Columns], Array]]
    shifts: bool = False
    """Whether it moves both zero and scale."""
    lows: Mapping[str, float] = field(default_factory=dict)
    """Where it is of just those columns that read as a unit: from where on they do."""

    def of(self, columns: Columns) -> dict[str, Array]:
        """The columns as they should have been written."""
        with np.errstate(all="ignore"):
            return {**columns, **{name: make(columns) for name, make in self.made.items()}}


def _unit(says: str, names: tuple[str, ...], scale: float, offset: float = 0.0, reason: str = "wrong_unit") -> Change:
    def made(name: str) -> Callable[[Columns], Array]:
        return lambda c: c[name] * scale + offset

    shifts = offset != 0.0 and scale != 1.0
    return Change(reason, f"It fits {says}.", {name: made(name) for name in names}, shifts)


def _swap(one: str, other: str) -> Change:
    return Change(SWAPPED, "It fits once they change places.", {one: _take(other), other: _take(one)})


def _take(name: str) -> Callable[[Columns], Array]:
    return lambda c: c[name]


_CELSIUS, _PSI, _POUNDS = (tuple(n for n in SIGNAL_NAMES if n.endswith(e)) for e in ("_degc", "_psia", "_lbpm"))
_UNITS: dict[tuple[str, ...], tuple[tuple[str, float, float, str], ...]] = {
    _CELSIUS: (("°F", 1 / 1.8, -32 / 1.8, "wrong_unit"), ("K", 1.0, -ZERO_CELSIUS_K, "unit_kelvin")),
    _PSI: (
        ("kPa", 1e3 / PSI_PA, 0.0, "unit_kpa"),
        ("hPa", 1e2 / PSI_PA, 0.0, "wrong_unit"),
        ("bar", 1e5 / PSI_PA, 0.0, "wrong_unit"),
        ("inHg", 3386.389 / PSI_PA, 0.0, "wrong_unit"),
    ),
    _POUNDS: (
        ("kg/min", 1 / POUND_KG, 0.0, "wrong_unit"),
        ("kg/s", 60 / POUND_KG, 0.0, "unit_kg_s"),
        ("lb/s", 60.0, 0.0, "wrong_unit"),
    ),
    ("cc_speed_rpm",): (("rad/s", 30 / np.pi, 0.0, "wrong_unit"), ("Hz", 60.0, 0.0, "wrong_unit")),
    ("altitude_ft",): (("m", 1 / 0.3048, 0.0, "wrong_unit"), ("flight levels", 100.0, 0.0, "wrong_unit")),
    ("ram_door_pct",): (("a fraction of 1", 100.0, 0.0, "wrong_unit"),),
}
"""Columns of one unit, and for each other unit its name and the agreed unit as scale and offset of it."""
_WITH_PARTNER = frozenset(("tat_degc", "cc_in_degc", "cc_out_degc"))
_SWAPS = (
    ("hx_in_degc", "hx_out_degc"),
    ("cc_in_degc", "cc_out_degc"),
    ("cc_in_psia", "cc_out_psia"),
    ("hx_in_degc", "ram_out_degc"),
    ("tat_degc", "hx_out_degc"),
    ("tat_degc", "cc_out_degc"),
    ("pt_psia", "cc_out_psia"),
)


def _mach_of_sea_level(c: Columns) -> Array:
    return c["mach"] * KNOT_M_S / SEA_LEVEL_SOUND_M_S


def _mach_of_true_airspeed(c: Columns) -> Array:
    """Mach number of a true airspeed in knots at the total air temperature."""
    speed2 = (c["mach"] * KNOT_M_S) ** 2
    sound2 = GAMMA * R_J_KG_K * (c["tat_degc"] + ZERO_CELSIUS_K) - 0.5 * (GAMMA - 1.0) * speed2
    return np.sqrt(np.where(sound2 <= 0.0, np.inf, speed2 / sound2))


def _mach_of_calibrated_airspeed(c: Columns) -> Array:
    """Mach number of a calibrated airspeed in knots at the pressure altitude."""
    impact_pa = SEA_LEVEL_PA * ((1.0 + 0.2 * (c["mach"] * KNOT_M_S / SEA_LEVEL_SOUND_M_S) ** 2) ** 3.5 - 1.0)
    static_pa = standard_pressure_pa(np.clip(c["altitude_ft"] * 0.3048, -1000.0, 20000.0))
    return mach_from_pressures(static_pa + impact_pa, static_pa)


_KNOTS = tuple(
    Change(OUTSIDE, "It fits knots.", {"mach": made})
    for made in (_mach_of_true_airspeed, _mach_of_calibrated_airspeed, _mach_of_sea_level)
)
_READS_AS = {"unit_kelvin": (1.0, -ZERO_CELSIUS_K), "unit_kpa": (1e3 / PSI_PA, 0.0)}
"""Scale and offset of units in which a column reads higher than any air in a pack."""


def _some_of(reason: str) -> Change:
    """The change of just those columns that read as the unit."""
    scale, offset = _READS_AS[reason]
    highest = {c.name: (HIGHEST[c.si_name] - c.offset) / c.scale for c in SIGNAL_COLUMNS if c.si_name in HIGHEST}
    lows = {name: low for name, low in highest.items() if name in (_CELSIUS if offset else _PSI)}

    def made(name: str) -> Callable[[Columns], Array]:
        return lambda c: np.where(c[name] >= lows[name], c[name] * scale + offset, c[name])

    return Change(reason, "", {name: made(name) for name in lows}, lows=lows)


def _changes() -> Iterator[Change]:
    """All changes that are tried, of few columns before those of many."""
    yield from _KNOTS
    for names, units in _UNITS.items():
        for unit in units:
            yield from (_unit(unit[0], (name,), *unit[1:]) for name in names)
    yield from (_swap(*pair) for pair in _SWAPS)
    for names, units in _UNITS.items():
        yield from (_unit(unit[0], names, *unit[1:]) for unit in units if len(names) > 1)
    yield from map(_some_of, _READS_AS)


CHANGES = tuple(_changes())


def miswritten_rows(raw: pl.DataFrame) -> pl.DataFrame:
    """Rows that some recorder wrote otherwise than agreed: `index` (in `raw`), `reason`, `column_name`, `told`.

    Where the reason is `out_of_range` the values of the column are at fault and not the rows.

    Parameters
    ----------
    raw : DataFrame
        `file_index, flight_id, pack` and the signals in recorded units, null where missing or no number.
    """
    units, flights = (_numbered(raw, key) for key in (PACK, PACK[:-1]))
    flight_of = np.zeros(int(units.max(initial=-1)) + 1, np.int64)
    flight_of[units] = flights
    columns = {n: np.clip(raw[n].to_numpy().astype(float), -FAR, FAR) for n in SIGNAL_NAMES}
    odd = np.flatnonzero(np.isin(units, np.flatnonzero(_look(columns, units).share.max(axis=0) >= MOST)))
    if not odd.size:
        return _none()
    suspects, found = _suspects(columns, units, odd), []
    for change in CHANGES:
        cured = _cured(change, suspects, flight_of)
        if cured.any():
            found.append(_told(change, suspects, cured))
            suspects = _suspects(columns, units, suspects.rows[~cured])
    return pl.concat([_none(), *found])


class _Look(NamedTuple):
    """Of each law and unit (laws, units): share of rows that break it, 0 where few say anything; its value's spread."""

    share: Array
    spread: Array


class _Suspects(NamedTuple):
    """Rows of units that break a law and are not explained yet."""

    rows: Index
    columns: Columns
    units: Index
    look: _Look


def _suspects(columns: Columns, units: Index, rows: Index) -> _Suspects:
    part, own = {name: values[rows] for name, values in columns.items()}, units[rows]
    return _Suspects(rows, part, own, _look(part, own))


def _look(columns: Columns, units: Index) -> _Look:
    signals = {c.si_name: columns[c.name] * c.scale + c.offset for c in SIGNAL_COLUMNS}
    values = readings(signals)
    looks = [_in_units(value, wrong, units) for value, wrong in zip(values, broken(values), strict=True)]
    return _Look(*np.stack(looks, axis=1))


def _in_units(value: Array, wrong: Mask, units: Index) -> tuple[Array, Array]:
    """Share of rows that break one law, and the standard deviation of its value, in each unit."""
    known = np.isfinite(value)
    n_units = int(units.max(initial=-1)) + 1
    told = np.bincount(units[~np.isnan(value)], minlength=n_units)
    share = np.bincount(units[wrong], minlength=n_units) / np.maximum(told, 1) * (told >= ENOUGH)
    n = np.maximum(np.bincount(units[known], minlength=n_units), 1)
    mean = np.bincount(units[known], value[known], n_units) / n
    away2 = np.bincount(units[known], (value[known] - mean[units[known]]) ** 2, n_units) / n
    return share, np.sqrt(away2)


def _numbered(raw: pl.DataFrame, key: tuple[str, ...]) -> Index:
    return raw.select(pl.struct(key).rank("dense"))[:, 0].to_numpy().astype(np.int64) - 1


def _cured(change: Change, suspects: _Suspects, flight_of: Index) -> Mask:
    """Of each suspect row whether its unit, the rows of a pack, breaks a law as written and none after the change.

    One sensor that reads too much all along can be brought back within the spans by many a change of zero and scale.
    So such a change must be that of all packs of the flight, for sensors fail one by one; or, where a column has a
    partner that moves as it does, must let the broken laws vary less.
    """
    columns, units, before = suspects.columns, suspects.units, suspects.look
    if all(np.isnan(columns[name]).all() for name in change.made):
        return np.zeros(len(units), bool)
    after = _look(change.of(columns), units)
    cured: Mask = (before.share.max(axis=0) >= MOST) & (after.share.max(axis=0) <= FEW)
    if change.shifts and _WITH_PARTNER.issuperset(change.made):
        cured &= ((before.share < MOST) | (after.spread < before.spread)).all(axis=0)
    elif change.shifts:
        cured &= _in_all_packs(cured, flight_of)
    for name in change.made if cured.any() else ():
        cured &= _lively(columns[name], units, len(cured))
        if change.reason == SWAPPED:  # with a column that is not recorded there is nothing to change places with
            cured &= np.bincount(units[~np.isnan(columns[name])], minlength=len(cured)) > 0
    return cured[units]


def _in_all_packs(cured: Mask, flight_of: Index) -> Mask:
    """Of each unit whether all packs of its flight, two or more, are cured."""
    packs = np.bincount(flight_of)
    sick = np.bincount(flight_of[: len(cured)][cured], minlength=len(packs))
    whole: Mask = (sick == packs) & (packs > 1)
    return whole[flight_of[: len(cured)]]


def _lively(values: Array, units: Index, n_units: int) -> Mask:
    """Of each unit whether a column reads more than two values or none: a sensor that stands still tells no unit."""
    read = pl.DataFrame({"unit": units, "value": values}).filter(pl.col("value").is_not_nan())
    counts = read.group_by("unit").agg(pl.col("value").n_unique())
    lively: Mask = np.ones(n_units, bool)
    lively[counts.filter(pl.col("value") <= 2)["unit"].to_numpy()] = False
    return lively


def _told(change: Change, suspects: _Suspects, cured: Mask) -> pl.DataFrame:
    recorded = np.any([~np.isnan(suspects.columns[name]) for name in change.made], axis=0)
    index = pl.Series("index", suspects.rows[cured & recorded], dtype=pl.UInt32)
    read = [n for n, low in change.lows.items() if np.mean(suspects.columns[n][cured] >= low) > FEW]
    words = {"reason": change.reason, "column_name": ", ".join(read or change.made), "told": change.says or None}
    return pl.DataFrame(index).with_columns(pl.lit(v, pl.String).alias(k) for k, v in words.items())


def _none() -> pl.DataFrame:
    return pl.DataFrame(schema={"index": pl.UInt32} | dict.fromkeys(("reason", "column_name", "told"), pl.String))
