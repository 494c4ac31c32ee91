"""Templates of all HTML pages of the project: whatever is not markup already is escaped on its way in."""

import re
from base64 import b64encode
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from hdt_core.alerts.evidence import ROLES
from pipelines.report import words
from pipelines.report.units import estimate, in_words, threshold
from pipelines.report.words import visible
from pipelines.words import _, language, several

NOTHING_FETCHED = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def render(template: str, **context: Any) -> str:
    """The page that a template makes of a context."""
    return _environment().get_template(template).render(language=language(), **context)


def templates_of(*rooms: str, finalize: Callable[[Any], Any] | None = None) -> Environment:
    """Templates of packages, the first that has one; a name that is not given is an error, text may stay as it is."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(room) for room in rooms]),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        finalize=finalize or shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@cache
def _environment() -> Environment:
    made = templates_of("pipelines.report")
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":")}  # in the order given: a chart's parts refer back
    made.globals |= {
        "_": told, "several": several, "anchor": anchor, "estimate": estimate, "evidence": evidence,
        "threshold": threshold, "words": words,
    }  # fmt: skip
    return made


def shown(value: Any) -> Any:
    """A value as a page shows it; what is missing is nothing."""
    if value is None:
        return ""
    return unbroken(visible(value)) if isinstance(value, str) and not isinstance(value, Markup) else value


def unbroken(text: str) -> str:
    """Text whose numbers keep their sign of per cent on their line."""
    return text.replace(" %", "\N{NO-BREAK SPACE}%")


def told(message: str, **values: Any) -> Markup:
    """A message with its values, each escaped unless it is markup."""
    said = Markup(escape(unbroken(visible(_(message)))))
    return said.format(**{k: shown(v) for k, v in values.items()}) if values else said


def evidence(sentence: str) -> Markup:
    """Why an alert stands, the role of each witness to be seen at a glance, differences in both systems of units."""
    escaped = str(in_words(unbroken(visible(words.plain(sentence)))))
    roles = "|".join(_(f"{role}:") for role in (*ROLES, "Else"))
    return Markup(re.sub(rf"(?<!\w)({roles})", r"<b>\1</b>", escaped))


def anchor(*parts: Any) -> str:
    """An id made of `parts`, the same wherever it is asked for."""
    return re.sub(r"[^A-Za-z0-9]+", "-", "-".join(str(p) for p in parts)).strip("-")


def policy(*scripts: str) -> str:
    """What a page may do: fetch nothing, and run these scripts and no other."""
    hashes = " ".join(map(source_hash, scripts))
    return NOTHING_FETCHED + (f"; script-src {hashes}" if hashes else "")


def source_hash(text: str) -> str:
    """A script or a style as a content security policy names it."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"
