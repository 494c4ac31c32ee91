"""Templates of all HTML pages of the project: whatever is not markup already is escaped on its way in."""

import re
from base64 import b64encode
from functools import cache
from hashlib import sha256
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from hdt_core.health.evidence import ROLES
from pipelines.report import words
from pipelines.report.units import estimate, in_words, threshold
from pipelines.report.words import visible
from pipelines.words import _, language, several

NOTHING_FETCHED = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def render(template: str, **context: Any) -> str:
    """The page that a template makes of a context."""
    return _environment().get_template(template).render(language=language(), **context)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("pipelines.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
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
    hashes = " ".join(f"'sha256-{b64encode(sha256(s.encode()).digest()).decode()}'" for s in scripts)
    return NOTHING_FETCHED + (f"; script-src {hashes}" if hashes else "")
