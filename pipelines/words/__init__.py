"""Translate messages by their English text with gettext's catalogs, one a language.

The English text is the message's id. Values stand in it as `{name}`; a message without a translation stays English.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from gettext import GNUTranslations, NullTranslations
from importlib import resources
from typing import Any

from hdt_core.loading import UserError

ENGLISH, DOMAIN = "en", "hdt"
_language: ContextVar[str] = ContextVar("language", default=ENGLISH)


def languages() -> list[str]:
    """List the languages, English first."""
    files = (f.name for f in resources.files("pipelines.words").iterdir())
    return [ENGLISH, *sorted(name.removesuffix(".mo") for name in files if name.endswith(".mo"))]


def language() -> str:
    """Return the language in use."""
    return _language.get()


@contextmanager
def use_language(name: str | None) -> Iterator[None]:
    """Use a language within the block; English without a name.

    Raises
    ------
    UserError
        There is no such language.
    """
    code = name or ENGLISH
    if code not in languages():
        raise UserError(f"no language {code}; there are {', '.join(languages())}")
    token = _language.set(code)
    try:
        yield
    finally:
        _language.reset(token)


@cache
def catalog_of(code: str) -> NullTranslations:
    """Load the catalog of a language."""
    if code == ENGLISH:
        return NullTranslations()
    with (resources.files("pipelines.words") / f"{code}.mo").open("rb") as file:
        return GNUTranslations(file)


def _(message: str, **values: Any) -> str:
    """Translate a message and fill in its values.

    Examples
    --------
    >>> _("{n} packs watched", n=16)
    '16 packs watched'
    """
    text = catalog_of(language()).gettext(message) if message else ""
    return text.format(**values) if values else text


def several(one: str, many: str, n: int, **values: Any) -> str:
    """Translate a message about `n` things and fill in its values, `n` among them.

    Examples
    --------
    >>> several("{n} pack", "{n} packs", 1)
    '1 pack'
    """
    text = catalog_of(language()).ngettext(one, many, n)
    return text.format(n=format_count(n), **values)


def number(value: float, digits: int = 0) -> str:
    """Format a number as the language writes it, with a true minus sign.

    Examples
    --------
    >>> number(-1234.5, 1)
    '\N{MINUS SIGN}1,234.5'
    """
    figures = f"{value:,.{digits}f}"
    return in_figures(figures if figures.strip("-0.") else figures.removeprefix("-"))


def format_count(n: int) -> str:
    """Format a count as the language writes it."""
    return in_figures(f"{n:,}")


def in_figures(figures: str) -> str:
    """Convert digits with a point, and commas between thousands, to the writing of the language."""
    true_minus = figures.replace("-", "\N{MINUS SIGN}")
    if language() == ENGLISH:
        return true_minus
    return true_minus.translate({ord(","): "\N{NO-BREAK SPACE}", ord("."): ","})
