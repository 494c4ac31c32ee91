"""`python -m pipelines.translations`: every message found anew, translations kept and compiled. Wants Babel (dev)."""

from datetime import UTC, datetime
from pathlib import Path

from babel.messages.catalog import Catalog
from babel.messages.extract import extract_from_file
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po, write_po

from hdt_core.alerts.diagnoses import DIAGNOSES
from pipelines.report import words
from pipelines.report.answers import CHOICES, STATES, STATUSES
from pipelines.words import ENGLISH
from pipelines.words.evidence import phrases

ROOT = Path(__file__).parent
HERE = ROOT / "words"
KEYWORDS = {"_": None, "told": None, "several": (1, 2)}
SAID_BY_DATA = (
    "high", "medium", "low", "replaced", "cleaned", "inspected", "adjusted", "fleet", "operator", "tail", "file", "row",
    "value", "result", "note", "flight", "fouled", "clogged", "corroded", "damaged", "no fault found",
)  # fmt: skip
"""What columns hold, and a page shows in words."""


def found() -> Catalog:
    """Every message of code, templates and declarations."""
    catalog = Catalog(charset="utf-8")
    for path in sorted([*ROOT.rglob("*.py"), *ROOT.rglob("templates/**/*.html")]):
        how = "python" if path.suffix == ".py" else "jinja2"
        for _line, message, _comments, _context in extract_from_file(how, path, keywords=KEYWORDS):
            catalog.add(message)
    for message in declared():
        catalog.add(message)
    return catalog


def declared() -> list[str]:
    """Messages that are not written where they are said."""
    limits = [name for name, _unit in words.THRESHOLDS.values()]
    tables = (words.URGENCY, words.REASONS, words.PARTS, words.SIDES, words.NAMES, CHOICES, STATUSES, STATES)
    said = [text for table in tables for text in table.values()] + [lost for lost, _ in words.WEARS.values()]
    return [*phrases(), *said, *limits, *SAID_BY_DATA, *(d.name for d in DIAGNOSES.values())]


def translated(language: str, messages: Catalog) -> Catalog:
    """The catalog of a language over these messages: what was translated stays so, what is said no more is left out."""
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


def write(language: str, catalog: Catalog) -> None:
    """Both forms: for who translates, and for gettext."""
    with (HERE / f"{language}.po").open("wb") as file:
        write_po(file, catalog, width=120, no_location=True, omit_header=False, sort_output=True, ignore_obsolete=True)
    with (HERE / f"{language}.mo").open("wb") as file:
        write_mo(file, catalog)


if __name__ == "__main__":
    messages = found()
    for known in sorted({p.stem for p in HERE.glob("*.po")} - {ENGLISH}):
        made = translated(known, messages)
        write(known, made)
        left = [m.id for m in made if m.id and not m.string]
        print(f"{known}: {len(made)} messages, {len(left)} not translated")
