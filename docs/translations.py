"""`python -m docs.translations`: collect all messages, keep their translations and compile them. Needs Babel."""

from datetime import UTC, datetime
from pathlib import Path

from babel.messages.catalog import Catalog
from babel.messages.extract import extract_from_file
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po, write_po

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.flight.component_legs import REASONS as UNIT_REASONS
from pipelines.report import words
from pipelines.report.tasks import ACTIONS
from pipelines.report.tonight import STATUSES
from pipelines.words import ENGLISH
from pipelines.words.evidence import phrases

ROOT = Path(__file__).parents[1] / "pipelines"
HERE = ROOT / "words"
KEYWORDS = {"_": None, "html_text": None, "several": (1, 2)}
DATA_VALUES = (
    "high", "medium", "low", "replaced", "cleaned", "inspected", "adjusted", "fleet", "operator", "tail", "file", "row",
    "value", "result", "note", "flight", "fouled", "clogged", "corroded", "damaged", "no fault found",
)  # fmt: skip
"""Values of columns that a page translates."""


def collect_messages() -> Catalog:
    """Collect every message of code, templates and declarations."""
    catalog = Catalog(charset="utf-8")
    for path in sorted([*ROOT.rglob("*.py"), *ROOT.rglob("templates/**/*.html")]):
        method = "python" if path.suffix == ".py" else "jinja2"
        for _line, message, _comments, _context in extract_from_file(method, path, keywords=KEYWORDS):
            catalog.add(message)
    for message in declared_messages():
        catalog.add(message)
    return catalog


def declared_messages() -> list[str]:
    """List messages that stand in tables and declarations instead of calls."""
    limits = [name for name, _unit in words.THRESHOLDS.values()]
    tables = (
        words.URGENCY,
        words.REASONS,
        words.PARTS,
        words.SIDES,
        words.NAMES,
        ACTIONS,
        STATUSES,
        words.STATES,
        UNIT_REASONS,
    )
    labels = [text for table in tables for text in table.values()] + [loss for loss, _ in words.WEARS.values()]
    return [*phrases(), *labels, *limits, *DATA_VALUES, *(d.name for d in DIAGNOSES.values())]


def update_catalog(language: str, messages: Catalog) -> Catalog:
    """Return a language's catalog of these messages with the translations it has; unused ones are dropped."""
    path = HERE / f"{language}.po"
    catalog = Catalog(locale=language, charset="utf-8")
    if path.exists():
        with path.open("rb") as file:
            catalog = read_po(file, locale=language)
    catalog.update(messages, no_fuzzy_matching=True)
    catalog.obsolete.clear()
    # the same bytes whenever it is written
    catalog.project, catalog.version, catalog.fuzzy = "hybrid-digital-twin", "0", False
    catalog.header_comment, catalog.msgid_bugs_address, catalog.last_translator = f"# Words in {language}.", "", ""
    catalog.creation_date = catalog.revision_date = datetime(2026, 1, 1, tzinfo=UTC)
    return catalog


def write_catalog(language: str, catalog: Catalog) -> None:
    """Write both forms: `.po` for translators, `.mo` for gettext."""
    with (HERE / f"{language}.po").open("wb") as file:
        write_po(file, catalog, width=120, no_location=True, omit_header=False, sort_output=True, ignore_obsolete=True)
    with (HERE / f"{language}.mo").open("wb") as file:
        write_mo(file, catalog)


if __name__ == "__main__":
    messages = collect_messages()
    for code in sorted({p.stem for p in HERE.glob("*.po")} - {ENGLISH}):
        catalog = update_catalog(code, messages)
        write_catalog(code, catalog)
        missing = [m.id for m in catalog if m.id and not m.string]
        print(f"{code}: {len(catalog)} messages, {len(missing)} not translated")
