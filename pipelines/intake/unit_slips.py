"""Find columns in another unit than agreed, or swapped: physics holds only after one change.

A flight's columns must obey the laws of `laws`. Where most rows of a pack violate one of them, each other unit of a
column and each swap of two columns is tried. If all laws hold after one such change, the recorder wrote the column that
way: those rows are rejected, and the column is named. A faulty sensor violates laws too, and no change restores them:
its values are stored, and assessed by flight later. A Mach number in knots is outside the range of Mach numbers; its
values are rejected and the rows stored.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from hdt_core.physics.air import GAMMA, R_J_KG_K, mach_from_pressures, standard_pressure_pa
from hdt_core.physics.model import Array
from hdt_core.records.units import FOOT_M, POUND_KG, PSI_PA, ZERO_CELSIUS_K
from pipelines.intake.columns import (
    HIGHEST,
    SIGNAL_COLUMNS,
    SIGNAL_NAMES,
    law_values,
    violations,
)

PACK = ("file_index", "flight_id", "pack")
BROKEN_SHARE, HOLDING_SHARE = 0.7, 0.12
"""Least share of a pack's rows in violation where a law counts as broken, and largest share where it holds."""
MIN_ROWS = 5
"""Rows with a value of a law that are needed."""
CLIP = 1e100
"""Limit of absolute values: far from any reading, and its square is still finite."""
SWAP, OUTSIDE = "swapped_columns", "out_of_range"
KNOT_M_S = 1852 / 3600
SEA_LEVEL_PA, SEA_LEVEL_SOUND_M_S = 101_325.0, 340.294

Columns = Mapping[str, Array]
"""Recorded name: values in the recorded unit, NaN where missing."""
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Change:
    """A possible slip: how to correct each column, and the sentence that explains it."""

    reason: str
    sentence: str
    corrections: Mapping[str, Callable[[Columns], Array]]
    shifts: bool = False
    """Whether it changes both zero and scale."""
    lows: Mapping[str, float] = field(default_factory=dict)
    """For a change of only the columns that read as a unit: the value from which each does."""

    def apply(self, columns: Columns) -> dict[str, Array]:
        """Correct the columns."""
        with np.errstate(all="ignore"):
            return {**columns, **{name: correct(columns) for name, correct in self.corrections.items()}}


class Unit(NamedTuple):
    """A unit that a column may be in: scale and offset to the agreed one."""

    name: str
    scale: float
    offset: float = 0.0
    reason: str = "wrong_unit"


def _unit(unit: Unit, names: Iterable[str], lows: Mapping[str, float] | None = None) -> Change:
    """Make the change from another unit; with `lows` only of columns that read as that unit, from there on."""

    def to_agreed_unit(name: str) -> Callable[[Columns], Array]:
        low = lows[name] if lows else -np.inf
        return lambda c: np.where(c[name] >= low, c[name] * unit.scale + unit.offset, c[name])

    corrections = {name: to_agreed_unit(name) for name in names}
    if lows:
        return Change(unit.reason, "", corrections, lows=lows)
    return Change(unit.reason, f"It fits {unit.name}.", corrections, unit.offset != 0.0 and unit.scale != 1.0)


def _swap(one: str, other: str) -> Change:
    return Change(SWAP, "It fits once they change places.", {one: _column(other), other: _column(one)})


def _column(name: str) -> Callable[[Columns], Array]:
    return lambda c: c[name]


_CELSIUS, _PSI, _POUNDS = (tuple(n for n in SIGNAL_NAMES if n.endswith(e)) for e in ("_degc", "_psia", "_lbpm"))
_UNITS: dict[tuple[str, ...], tuple[Unit, ...]] = {
    _CELSIUS: (Unit("°F", 1 / 1.8, -32 / 1.8), Unit("K", 1.0, -ZERO_CELSIUS_K, "unit_kelvin")),
    _PSI: (
        Unit("kPa", 1e3 / PSI_PA, reason="unit_kpa"),
        Unit("hPa", 1e2 / PSI_PA),
        Unit("bar", 1e5 / PSI_PA),
        Unit("inHg", 3386.389 / PSI_PA),
    ),
    _POUNDS: (Unit("kg/min", 1 / POUND_KG), Unit("kg/s", 60 / POUND_KG, reason="unit_kg_s"), Unit("lb/s", 60.0)),
    ("cc_speed_rpm",): (
        Unit("rad/s", 30 / np.pi),
        Unit("Hz", 60.0),
        *(Unit("per cent", full_rpm / 100.0) for full_rpm in (24_000, 36_000, 52_000)),
        Unit("thousands of rpm", 1_000.0),
    ),
    ("altitude_ft",): (Unit("m", 1 / FOOT_M), Unit("flight levels", 100.0)),
    ("ram_door_pct",): (Unit("a fraction of 1", 100.0),),
}
"""Other units of the columns that share one."""
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
    static_pa = standard_pressure_pa(np.clip(c["altitude_ft"] * FOOT_M, -1000.0, 20000.0))
    return mach_from_pressures(static_pa + impact_pa, static_pa)


_KNOTS = tuple(
    Change(OUTSIDE, "It fits knots.", {"mach": to_mach})
    for to_mach in (_mach_of_true_airspeed, _mach_of_calibrated_airspeed, _mach_of_sea_level)
)
_LOWS = {c.name: (HIGHEST[c.si_name] - c.offset) / c.scale for c in SIGNAL_COLUMNS if c.si_name in HIGHEST}
"""Values that no air in a pack reaches in the agreed unit, and any does in kelvin and kPa."""


def _changes() -> Iterator[Change]:
    """Yield all changes to try, those of few columns first."""
    pairs = [(unit, names) for names, units in _UNITS.items() for unit in units]
    yield from _KNOTS
    yield from (_unit(unit, (name,)) for unit, names in pairs for name in names)
    yield from (_swap(*pair) for pair in _SWAPS)
    yield from (_unit(unit, names) for unit, names in pairs if len(names) > 1)
    for unit, names in pairs:
        if unit.reason in ("unit_kelvin", "unit_kpa"):
            lows = {name: low for name, low in _LOWS.items() if name in names}
            yield _unit(unit, lows, lows)


CHANGES = tuple(_changes())


def find_unit_slips(raw: pl.DataFrame) -> pl.DataFrame:
    """Find rows in other units or columns than agreed: `index` (in `raw`), `reason`, `column_name`, `sentence`.

    Where the reason is `out_of_range` the values of the column are at fault and not the rows.

    Parameters
    ----------
    raw : DataFrame
        `file_index, flight_id, pack` and the signals in recorded units, null where missing or no number.
    """
    units, flights = (_dense_index(raw, key) for key in (PACK, PACK[:-1]))
    flight_of = np.zeros(int(units.max(initial=-1)) + 1, np.int64)
    flight_of[units] = flights
    columns = {n: np.clip(raw[n].to_numpy().astype(float), -CLIP, CLIP) for n in SIGNAL_NAMES}
    rows = np.flatnonzero(np.isin(units, np.flatnonzero(_check_laws(columns, units).share.max(axis=0) >= BROKEN_SHARE)))
    if not rows.size:
        return _no_rows()
    suspects = _suspects(columns, units, rows)
    slips = []
    for change in CHANGES:
        is_explained = _explained_rows(change, suspects, flight_of)
        if is_explained.any():
            slips.append(_slip_rows(change, suspects, is_explained))
            suspects = _suspects(columns, units, suspects.rows[~is_explained])
    return pl.concat([_no_rows(), *slips])


class _LawCheck(NamedTuple):
    """Of each law and pack (laws, units): share of rows in violation, 0 where few have a value; the value's sd."""

    share: Array
    sd: Array


class _Suspects(NamedTuple):
    """Rows of packs that violate a law and are not explained yet."""

    rows: Index
    columns: Columns
    units: Index
    check: _LawCheck


def _suspects(columns: Columns, units: Index, rows: Index) -> _Suspects:
    part = {name: values[rows] for name, values in columns.items()}
    own = units[rows]
    return _Suspects(rows, part, own, _check_laws(part, own))


def _check_laws(columns: Columns, units: Index) -> _LawCheck:
    signals = {c.si_name: columns[c.name] * c.scale + c.offset for c in SIGNAL_COLUMNS}
    values = law_values(signals)
    checks = [_by_unit(value, wrong, units) for value, wrong in zip(values, violations(values), strict=True)]
    return _LawCheck(*np.stack(checks, axis=1))


def _by_unit(value: Array, wrong: Mask, units: Index) -> tuple[Array, Array]:
    """Compute the share of rows that violate one law, and the standard deviation of its value, in each unit."""
    finite = np.isfinite(value)
    n_units = int(units.max(initial=-1)) + 1
    n_with_value = np.bincount(units[~np.isnan(value)], minlength=n_units)
    share = np.bincount(units[wrong], minlength=n_units) / np.maximum(n_with_value, 1) * (n_with_value >= MIN_ROWS)
    n = np.maximum(np.bincount(units[finite], minlength=n_units), 1)
    mean = np.bincount(units[finite], value[finite], n_units) / n
    variance = np.bincount(units[finite], (value[finite] - mean[units[finite]]) ** 2, n_units) / n
    return share, np.sqrt(variance)


def _dense_index(raw: pl.DataFrame, key: tuple[str, ...]) -> Index:
    return raw.select(pl.struct(key).rank("dense"))[:, 0].to_numpy().astype(np.int64) - 1


def _explained_rows(change: Change, suspects: _Suspects, flight_of: Index) -> Mask:
    """Select suspect rows whose unit, the rows of a pack, violates a law as written and none after the change.

    Many changes of zero and scale bring one sensor that reads too high throughout back within the limits. So such a
    change must hold in all packs of the flight, since sensors fail singly; or, where a column has a partner that varies
    with it, must reduce the variation of the broken laws.
    """
    columns = suspects.columns
    units = suspects.units
    before = suspects.check
    if all(np.isnan(columns[name]).all() for name in change.corrections):
        return np.zeros(len(units), bool)
    after = _check_laws(change.apply(columns), units)
    is_explained: Mask = (before.share.max(axis=0) >= BROKEN_SHARE) & (after.share.max(axis=0) <= HOLDING_SHARE)
    if change.shifts and _WITH_PARTNER.issuperset(change.corrections):
        is_explained &= ((before.share < BROKEN_SHARE) | (after.sd < before.sd)).all(axis=0)
    elif change.shifts:
        is_explained &= _in_all_packs(is_explained, flight_of)
    for name in change.corrections if is_explained.any() else ():
        is_explained &= _varies(columns[name], units, len(is_explained))
        if change.reason == SWAP:  # a column that is not recorded can't have been swapped
            is_explained &= np.bincount(units[~np.isnan(columns[name])], minlength=len(is_explained)) > 0
    return is_explained[units]


def _in_all_packs(is_explained: Mask, flight_of: Index) -> Mask:
    """Select units where the change explains all packs of the flight, two or more."""
    packs = np.bincount(flight_of)
    n_explained = np.bincount(flight_of[: len(is_explained)][is_explained], minlength=len(packs))
    whole: Mask = (n_explained == packs) & (packs > 1)
    return whole[flight_of[: len(is_explained)]]


def _varies(values: Array, units: Index, n_units: int) -> Mask:
    """Select units in which a column has more than two values or none: a frozen sensor reveals no unit."""
    values_of_unit = pl.DataFrame({"unit": units, "value": values}).filter(pl.col("value").is_not_nan())
    n_values = values_of_unit.group_by("unit").agg(pl.col("value").n_unique())
    varies: Mask = np.ones(n_units, bool)
    varies[n_values.filter(pl.col("value") <= 2)["unit"].to_numpy()] = False
    return varies


def _slip_rows(change: Change, suspects: _Suspects, is_explained: Mask) -> pl.DataFrame:
    """Return the rows of a change; with them the few that lack its columns, which would be left as a flight of two."""
    has_value = np.any([~np.isnan(suspects.columns[name]) for name in change.corrections], axis=0)
    n_rows = np.bincount(suspects.units)
    share_with_value = np.bincount(suspects.units, has_value) / np.maximum(n_rows, 1)
    is_rest = (share_with_value[suspects.units] >= BROKEN_SHARE) & (change.reason != OUTSIDE)
    index = pl.Series("index", suspects.rows[is_explained & (has_value | is_rest)], dtype=pl.UInt32)
    columns = [n for n, low in change.lows.items() if np.mean(suspects.columns[n][is_explained] >= low) > HOLDING_SHARE]
    words = {
        "reason": change.reason,
        "column_name": ", ".join(columns or change.corrections),
        "sentence": change.sentence or None,
    }
    return pl.DataFrame(index).with_columns(pl.lit(v, pl.String).alias(k) for k, v in words.items())


def _no_rows() -> pl.DataFrame:
    return pl.DataFrame(schema={"index": pl.UInt32} | dict.fromkeys(("reason", "column_name", "sentence"), pl.String))
