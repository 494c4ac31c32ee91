"""Format quantities in SI and in US cockpit units; the page shows one of the two."""

import re
from typing import Any

from markupsafe import Markup, escape

from hdt_core.robust import Z_90
from pipelines.report.words import THRESHOLDS, figures, percent, unbroken, visible
from pipelines.words import _, in_figures, number

SYSTEMS = ("si", "us")
_US = {
    "K": ("°F", 1.8, 0.0),
    "°C": ("°F", 1.8, 32.0),
    "kg/s": ("lb/min", 132.277, 0.0),
    "W/K": ("Btu/(h·°F)", 1.895634, 0.0),
    "m": ("in", 39.37008, 0.0),
    "m2": ("in²", 1550.003, 0.0),
    "mm": ("in", 0.03937008, 0.0),
    "m/count": ("in/count", 39.37008, 0.0),
    "m3": ("in³", 61_023.74, 0.0),
    "10⁻³ m³": ("in³", 61.02374, 0.0),
    "Pa": ("psi", 1.450377e-4, 0.0),
}
"""US name, factor and offset of a unit. A temperature in K is a difference."""
_IN_WORDS = re.compile(r"([+\-\N{MINUS SIGN}]?\d+(?:[.,](\d+))?) (K|kg/s)(?!\w)")


def to_us(value: float, unit: str) -> tuple[float, str]:
    """Convert a value to US units; a unit without a US one stays.

    Examples
    --------
    >>> to_us(100.0, "°C")
    (212.0, '°F')
    """
    name, factor, offset = _US.get(unit, (unit, 1.0, 0.0))
    return value * factor + offset, name


def both(si: Any, us: Any) -> Markup:
    """Write a text in both systems of units; the page shows one of them."""
    one = escape(si)
    other = escape(us)
    return one if one == other else Markup('<span class="si">{}</span><span class="us">{}</span>').format(one, other)


def quantity(value: float, unit: str, digits: int = 0) -> Markup:
    """Format a number with its unit in both systems."""
    other, name = to_us(value, unit)
    return both(f"{number(value, digits)} {unit}", f"{number(other, digits)} {name}")


def threshold(limit: str, value: float) -> Markup:
    """Format the limit of an alert's rule."""
    name, unit = THRESHOLDS[limit]
    return Markup("{} {}").format(_(name), percent(value, 1) if unit == "%" else quantity(value, unit, 1))


def estimate(value: float | None, sd: float | None, unit: str) -> Markup:
    """Format an estimate with its interval and unit in both systems; text after the unit follows at the end."""
    if value is None:
        return escape(figures(None))
    unit, at, condition = visible(unit).partition(" at ")
    ends = [value] if sd is None else [value, value - Z_90 * sd, value + Z_90 * sd]
    us = [to_us(v, unit)[0] for v in ends]
    name = to_us(0.0, unit)[1]
    return both(_estimate(ends, unit), _estimate(us, name)) + in_words(at + condition)


def _estimate(ends: list[float], unit: str) -> str:
    value = f"{figures(ends[0])} {unit}".removesuffix(" -")
    if len(ends) == 1:
        return value
    interval = _("{low} to {high}", low=figures(ends[1]), high=figures(ends[2]))
    return f"{value} ({interval})"


def written(figures: str, unit: str) -> Markup:
    """Write stored figures with their unit in both systems; a temperature in K is a difference."""
    si = unbroken(f"{in_figures(figures)} {unit}".rstrip())
    return both(si, _us_text(figures, figures.partition(".")[2], unit) if unit in _US else si)


def in_words(text: str) -> Markup:
    """Write the quantities in a text in both systems; a temperature in K is a difference."""
    parts = []
    last = 0
    for match in _IN_WORDS.finditer(text):
        parts += [escape(text[last : match.start()]), both(match[0], _us_text(*match.groups()))]
        last = match.end()
    return Markup("").join([*parts, escape(text[last:])])


def _us_text(figures: str, decimals: str | None, unit: str) -> str:
    value, name = to_us(float(figures.replace("\N{MINUS SIGN}", "-").replace(",", ".")), unit)
    sign = "+" if figures.startswith("+") else ""
    return f"{sign}{number(value, len(decimals or ''))} {name}"
