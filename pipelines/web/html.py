"""Render pages that run no script and fetch nothing."""

import re
from functools import cache
from typing import Any

from jinja2 import Environment
from starlette.responses import HTMLResponse

from pipelines.report import words
from pipelines.report.templating import report_templates, source_hash

_POLICY = "default-src 'none'; style-src {}; img-src data:; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"


def html_page(template: str, status: int = 200, **context: Any) -> HTMLResponse:
    """Render a page with its content security policy; browsers do not store it."""
    html = _environment().get_template(template).render(language="en", **context)
    (style,) = re.findall(r"<style>(.*?)</style>", html, flags=re.DOTALL)
    headers = {"content-security-policy": _POLICY.format(source_hash(style)), "cache-control": "no-store"}
    return HTMLResponse(html, status, headers)


@cache
def _environment() -> Environment:
    environment = report_templates("pipelines.web")
    environment.filters["label"] = words.diagnosis
    environment.filters["last_day"] = words.last_day
    return environment
