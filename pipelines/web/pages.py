"""The page's HTML: Jinja2, everything escaped, over the base that all pages of the project share."""

import re
from base64 import b64encode
from functools import cache
from hashlib import sha256
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from starlette.responses import HTMLResponse

from hdt_core.health.diagnoses import DIAGNOSES

_POLICY = (
    "default-src 'none'; style-src 'sha256-{}'; img-src data:; form-action 'self'; frame-ancestors 'none'; "
    "base-uri 'none'"
)


def show(template: str, status: int = 200, **context: Any) -> HTMLResponse:
    """A page; nothing in it runs, and nothing is fetched for it."""
    html = _environment().get_template(template).render(language="en", **context)
    (style,) = re.findall(r"<style>(.*?)</style>", html, flags=re.DOTALL)
    digest = b64encode(sha256(style.encode()).digest()).decode()
    return HTMLResponse(html, status, {"content-security-policy": _POLICY.format(digest)})


@cache
def _environment() -> Environment:
    made = Environment(
        loader=ChoiceLoader([PackageLoader("pipelines.web"), PackageLoader("pipelines.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: "" if value is None else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["plainly"] = plainly
    return made


def plainly(diagnosis: str) -> str:
    """A diagnosis as the night shift says it."""
    known = DIAGNOSES.get(diagnosis)
    return known.name if known else diagnosis
