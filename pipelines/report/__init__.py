"""The fleet's health as one offline HTML page."""

from pathlib import Path

from pipelines.report.facts import read_facts
from pipelines.report.page import page
from pipelines.storage.files import replacing


def write_report(home: Path, target: Path) -> None:
    """Write the page over the catalog in `home` to `target`: same catalog, same bytes."""
    with replacing(target.resolve()) as temporary:
        temporary.write_text(page(read_facts(home)), encoding="utf-8")
