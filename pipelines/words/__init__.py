"""All words that a reader meets, by their English text: gettext's catalogs, one a language.

The English text is the name of a message. Values stand in it as `{name}`; what is not translated is said in English.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from gettext import GNUTranslations, NullTranslations
from importlib import resources
from typing import Any

ENGLISH, DOMAIN = "en", "hdt"
_spoken: ContextVar[str] = ContextVar("language", default=ENGLISH)


class NoLanguageError(ValueError):
    """A language that there are no words of; names those there are."""


def languages() -> list[str]:
    """Languages there are, English first."""
    found = (f.name.removesuffix(".mo") for f in resources.files("pipelines.words").iterdir() if f.name.endswith(".mo"))
    return [ENGLISH, *sorted(found)]


def language() -> str:
    """The language spoken now."""
    return _spoken.get()


@contextmanager
def speaking(wanted: str | None) -> Iterator[None]:
    """Speak a language for a while; English where none is named.

    Raises
    ------
    NoLanguageError
        There is no such language.
    """
    chosen = wanted or ENGLISH
    if chosen not in languages():
        raise NoLanguageError(f"no language {chosen}; there are {', '.join(languages())}")
    token = _spoken.set(chosen)
    try:
        yield
    finally:
        _spoken.reset(token)


@cache
def catalog_of(chosen: str) -> NullTranslations:
    """The catalog of a language, as gettext reads it."""
    if chosen == ENGLISH:
        return NullTranslations()
    with (resources.files("pipelines.words") / f"{chosen}.mo").open("rb") as file:
        return GNUTranslations(file)


def _(message: str, **values: Any) -> str:
    """A message in the language spoken, with its values in it.

    Examples
    --------
    >>> _("{n} packs watched", n=16)
    '16 packs watched'
    """
    said = catalog_of(language()).gettext(message) if message else ""
    return said.format(**values) if values else said


def several(one: str, many: str, n: int, **values: Any) -> str:
    """A message of a number of things; `n` is among its values.

    Examples
    --------
    >>> several("{n} pack", "{n} packs", 1)
    '1 pack'
    """
    said = catalog_of(language()).ngettext(one, many, n)
    return said.format(n=grouped(n), **values)


def number(value: float, digits: int = 0) -> str:
    """A number as the language writes it, with a true minus.

    Examples
    --------
    >>> number(-1234.5, 1)
    '\N{MINUS SIGN}1,234.5'
    """
    figures = f"{value:,.{digits}f}"
    return in_figures(figures if figures.strip("-0.") else figures.removeprefix("-"))


def grouped(n: int) -> str:
    """A count, thousands apart."""
    return in_figures(f"{n:,}")


def in_figures(figures: str) -> str:
    """Digits with a point, and commas between thousands, as the language writes them."""
    true_minus = figures.replace("-", "\N{MINUS SIGN}")
    if language() == ENGLISH:
        return true_minus
    return true_minus.translate({ord(","): "\N{NO-BREAK SPACE}", ord("."): ","})
