"""The page's HTML: Jinja2, everything escaped, over the base that all pages of the project share."""

import re
from functools import cache
from typing import Any

from jinja2 import Environment
from starlette.responses import HTMLResponse

from pipelines.report import words
from pipelines.report.templating import source_hash, templates_of

_POLICY = "default-src 'none'; style-src {}; img-src data:; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"


def show(template: str, status: int = 200, **context: Any) -> HTMLResponse:
    """A page; nothing in it runs, and nothing is fetched for it."""
    html = _environment().get_template(template).render(language="en", **context)
    (style,) = re.findall(r"<style>(.*?)</style>", html, flags=re.DOTALL)
    return HTMLResponse(html, status, {"content-security-policy": _POLICY.format(source_hash(style))})


@cache
def _environment() -> Environment:
    made = templates_of("pipelines.web", "pipelines.report")
    made.filters["plainly"] = words.diagnosis
    return made
