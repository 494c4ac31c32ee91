"""Render the project's HTML pages with Jinja; every value that is not markup is escaped."""

import re
from base64 import b64encode
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from pipelines.report import words
from pipelines.report.units import estimate, quantity, threshold, written
from pipelines.report.words import unbroken, visible
from pipelines.words import _, format_count, language, several
from pipelines.words.evidence import Style, action_text, evidence_text

NOTHING_FETCHED = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def render(template: str, **context: Any) -> str:
    """Render a template of the report."""
    return report_templates().get_template(template).render(language=language(), **context)


def templates_of(*packages: str, finalize: Callable[[Any], Any] | None = None) -> Environment:
    """Return the templates of packages, the first that has a name; an undefined variable is an error."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package) for package in packages]),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        finalize=finalize or printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@cache
def report_templates(*packages: str) -> Environment:
    """Return the report's templates with what they call, after those of other packages."""
    environment = templates_of(*packages, "pipelines.report")
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}  # unsorted: a chart's parts refer back
    environment.globals |= {
        "_": html_text, "several": several, "anchor": anchor, "count": format_count, "estimate": estimate,
        "action": action, "evidence": evidence, "quantity": quantity, "threshold": threshold, "words": words,
    }  # fmt: skip
    return environment


def printable(value: Any) -> Any:
    """Return a value as a page prints it; nothing for None."""
    if value is None:
        return ""
    return unbroken(visible(value)) if isinstance(value, str) and not isinstance(value, Markup) else value


def html_text(message: str, **values: Any) -> Markup:
    """Translate a message and fill in its values, each escaped unless it is markup."""
    text = Markup(escape(unbroken(visible(_(message)))))
    return text.format(**{k: printable(v) for k, v in values.items()}) if values else text


def evidence(stored: str, **how: bool) -> Markup:
    """Format an alert's evidence: the role of each cross check in bold, differences in both systems of units."""
    return Markup(evidence_text(stored, ON_PAGE, **how))


def action(stored: str) -> Markup:
    """Format a recommended action."""
    return Markup(action_text(stored, ON_PAGE))


def _escaped(text: str) -> Markup:
    return escape(unbroken(visible(text)))


def _bold(label: str) -> Markup:
    return Markup("<b>{}</b>").format(label)


ON_PAGE = Style(_escaped, written, _bold)
"""As a page shows texts."""


def anchor(*parts: Any) -> str:
    """Build an element's id from `parts`."""
    return re.sub(r"[^A-Za-z0-9]+", "-", "-".join(str(p) for p in parts)).strip("-")


def policy(*scripts: str) -> str:
    """Build the content security policy of a page: no requests, and these scripts only."""
    hashes = " ".join(map(source_hash, scripts))
    return NOTHING_FETCHED + (f"; script-src {hashes}" if hashes else "")


def source_hash(text: str) -> str:
    """Return the source expression of an inline script or style for a content security policy."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"
