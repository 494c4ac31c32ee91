"""Write an alert's texts, stored as phrases and values (`hdt_core.alerts.text`), in the language in use."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hdt_core.alerts import component_alerts  # noqa: F401 - declares phrases
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.evidence import ELSE, ROLES, capitalised
from hdt_core.alerts.phrases import CHECKS, SIGNALS
from hdt_core.alerts.text import Column, Text, TextList, declared_phrases, to_json
from hdt_core.components import components
from pipelines.words import _, catalog_of, in_figures, language


@dataclass(frozen=True, slots=True)
class Style:
    """How the parts of a text are written: a page escapes them and shows quantities in two systems of units."""

    text: Callable[[str], str] = str
    figures: Callable[[str, str], str] = lambda figures, unit: f"{in_figures(figures)} {unit}".rstrip()
    label: Callable[[str], str] = str
    has_columns: bool = False


PLAIN, WITH_COLUMNS = Style(), Style(has_columns=True)
"""As the night shift reads it; with the catalog's names of columns, as an analyst does."""


def phrases() -> list[str]:
    """List every phrase of evidence and actions, those of installed components included."""
    texts = [text for c in components().values() for text in (c.name, c.lost, c.action, c.otherwise, c.waiting)]
    names = [text for d in DIAGNOSES.values() for text in (d.name, d.action)]
    labels = [f"{label}:" for label in (*ROLES, ELSE)]
    return list(dict.fromkeys([*declared_phrases(), *SIGNALS.values(), *CHECKS.values(), *names, *texts, *labels]))


def stored_action(text: str) -> str:
    """Return a declared action as `action_phrases` has it."""
    return to_json(TextList([Text.whole(text)]))


def action_text(stored: str, style: Style = PLAIN) -> str:
    """Write a recommended action from `action_phrases`."""
    return _write(json.loads(stored), style)


def evidence_text(stored: str, style: Style = PLAIN, *, has_alternatives: bool = True) -> str:
    """Write evidence from `evidence_phrases`, a sentence a section; without what else may be, and the cost of waiting,
    where these are listed already."""
    sections = json.loads(stored)
    labels = [section["label"] for section in sections]
    shown = sections if has_alternatives else sections[: labels.index(ELSE)]
    return style.text(" ").join(_sentence(section, style) for section in shown)


def _sentence(section: dict[str, Any], style: Style) -> str:
    text = _write(section["texts"], style)
    if not section["label"]:
        return capitalised(text) + style.text(".")
    return style.label(_(f"{section['label']}:")) + style.text(" ") + text + style.text(".")


def _write(part: Any, style: Style) -> str:
    """Write one part, of the form of `hdt_core.alerts.text.as_parts`."""
    match part:
        case {"figures": figures, "unit": unit}:
            return style.figures(figures, unit)
        case {"column": name}:
            return style.text(Column(name) if style.has_columns else "")
        case {"texts": texts, "separator": separator}:
            return style.text(separator).join(_write(text, style) for text in texts)
        case {"phrase": phrase, "values": values, "is_continued": is_continued}:
            template = style.text(catalog_of(language()).gettext(phrase) if phrase else "")
            text = template.format(**{n: _write(v, style) for n, v in values.items()}) if values else template
            return text[:1].lower() + text[1:] if is_continued else text
    return style.text(part)
