"""The page: what to do first, then the evidence, then how far to trust it."""

from importlib import resources

from pipelines.report import attention, components, intake, model
from pipelines.report.facts import Facts
from pipelines.report.figures import figures
from pipelines.report.headline import headline
from pipelines.report.html import Html, join, tag
from pipelines.report.tracks import tracks

_PARTS = (
    ("tonight", "Tonight", headline),
    ("ranking", "Fleet ranking", attention.ranking),
    ("alerts", "Alerts", attention.alerts),
    ("tracks", "Health of each pack", tracks),
    ("components", "Other components", components.components),
    ("gaps", "Data gaps", intake.gaps),
    ("quarantine", "Quarantine", intake.quarantine),
    ("yield", "Filter yield", intake.filter_yield),
    ("design", "How the fleet was built", model.design),
    ("figures", "Model against data", figures),
    ("card", "Model card", model.model_card),
)
# nothing may be fetched, even by a page someone has meddled with
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"


def page(facts: Facts) -> str:
    """The whole document."""
    until = facts.until()
    title = "Fleet health" + (f", {until:%Y-%m-%d}" if until else "")
    head = join(
        Html('<meta charset="utf-8">'),
        Html('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        Html(f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'),
        Html('<link rel="icon" href="data:,">'),
        tag("title", title),
        tag("style", Html(_asset("page.css"))),
    )
    shown = [(key, name, drawn) for key, name, draw in _PARTS if (drawn := draw(facts)) is not None]
    links = (tag("a", name, href=f"#{key}") for key, name, _ in shown)
    search = Html(
        '<label class="search">Find '
        '<input id="find" type="search" placeholder="tail, operator, diagnosis" autocomplete="off">'
        '<output id="found"></output></label>'
    )
    parts = (tag("section", tag("h2", name), drawn, id=key) for key, name, drawn in shown)
    body = join(
        tag("header", tag("h1", title), search, tag("nav", *links, aria_label="Parts of the page")), tag("main", *parts)
    )
    script = tag("script", Html(_asset("page.js")))
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{body}{script}</body></html>\n'


def _asset(name: str) -> str:
    return (resources.files("pipelines.report") / name).read_text(encoding="utf-8")
