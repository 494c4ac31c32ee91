"""Text of an alert that keeps its phrases and their values, to be written in another language or in other units.

Each piece is a string, its English text. `to_json` stores pieces with the phrases and values that they were made of,
so that nobody has to read a sentence back.
"""

import json
from collections.abc import Iterable
from string import Formatter
from typing import Any, Self


class Phrase(str):
    """A declared phrase with its values as `{name}`; translations cover every one.

    A value is a number, a name or another phrase; a field that is a column of the catalog, such as `{hx_fouling}`,
    stands for its name in parentheses.
    """

    def __new__(cls, text: str) -> Self:
        """Declare a phrase."""
        phrase = super().__new__(cls, text)
        _DECLARED.setdefault(text)
        return phrase


_DECLARED: dict[str, None] = {}


def declared_phrases() -> list[str]:
    """List all phrases that are declared so far."""
    return list(_DECLARED)


class Figures(str):
    """A number as it is written, with its unit where it has one that may be converted."""

    unit: str

    def __new__(cls, figures: str, unit: str = "") -> Self:
        """Join figures and unit."""
        text = super().__new__(cls, f"{figures} {unit}".rstrip())
        text.unit = unit
        return text

    @property
    def number(self) -> str:
        """The figures alone."""
        return self.removesuffix(self.unit).rstrip()


class Column(str):
    """A column of the catalog in parentheses, for an analyst."""

    name: str

    def __new__(cls, name: str) -> Self:
        """Put the name in parentheses."""
        text = super().__new__(cls, f" ({name})")
        text.name = name
        return text


class Text(str):
    """A phrase filled in with values: figures, columns, other texts or plain names.

    A field of the phrase without a value is the name of a column.

    Attributes
    ----------
    phrase : Phrase or str
        As declared, with its fields; of a `whole` text the text itself.
    values : dict
        By field.
    is_continued : bool
        Whether it goes on within a sentence, so that it begins with a small letter.
    """

    phrase: str
    values: dict[str, str]
    is_continued: bool

    def __new__(cls, phrase: Phrase, /, **values: str) -> Self:
        """Fill in the phrase."""
        names = [name for _, name, _, _ in Formatter().parse(phrase) if name]
        filled = {name: values[name] if name in values else Column(name) for name in names}
        return cls._of(phrase.format(**filled), phrase, filled, is_continued=False)

    @classmethod
    def whole(cls, text: str) -> Self:
        """Take a text as it is, braces included: that of a declaration."""
        return text if isinstance(text, cls) else cls._of(text, text, {}, is_continued=False)

    def continued(self) -> Self:
        """Return the text as it goes on within a sentence."""
        return self._of(f"{self[:1].lower()}{self[1:]}", self.phrase, self.values, is_continued=True)

    @classmethod
    def _of(cls, english: str, phrase: str, values: dict[str, str], *, is_continued: bool) -> Self:
        text = super().__new__(cls, english)
        text.phrase = phrase
        text.values = values
        text.is_continued = is_continued
        return text


class TextList(str):
    """Texts in a row, with what stands between them."""

    texts: tuple[str, ...]
    separator: str

    def __new__(cls, texts: Iterable[str], separator: str = "") -> Self:
        """Join the texts."""
        parts = tuple(texts)
        text = super().__new__(cls, separator.join(parts))
        text.texts = parts
        text.separator = separator
        return text


def to_json(text: str) -> str:
    """Write a text with its phrases and values as JSON: see `as_parts`."""
    return dump_parts(as_parts(text))


def dump_parts(parts: Any) -> str:
    """Write what `as_parts` returns, or a list of it, as JSON."""
    return json.dumps(parts, ensure_ascii=False, separators=(",", ":"))


def as_parts(text: str) -> Any:
    """Return a text as JSON has it.

    A plain name is itself; figures are `{"figures": ..., "unit": ...}`, a column `{"column": ...}`, a row of texts
    `{"texts": [...], "separator": ...}` and a phrase `{"phrase": ..., "values": {...}, "is_continued": ...}`.
    """
    match text:
        case Figures():
            return {"figures": text.number, "unit": text.unit}
        case Column():
            return {"column": text.name}
        case TextList():
            return {"texts": [as_parts(t) for t in text.texts], "separator": text.separator}
        case Text():
            values = {name: as_parts(value) for name, value in text.values.items()}
            return {"phrase": text.phrase, "values": values, "is_continued": text.is_continued}
    return str(text)
