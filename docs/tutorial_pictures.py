"""`python docs/tutorial_pictures.py HOME [FOLDER]`: pictures of the tutorial's steps, into docs/images.

HOME is one after a night over `data_samples/`. Rich renders the terminal's output, each notebook its lesson's figure.
"""

import importlib.util
import io
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from pictures import IMAGES, small, started_browser
from rich.console import Console

from pipelines.cli import night

COURSE = Path(__file__).parents[1] / "notebooks/course"
LESSONS = {
    "one_flight": lambda module, values: module.drawn(values["samples"]),
    "one_packs_life": lambda module, values: module.drawn(values["fouling"], values["told"]),
    "what_an_alert_rests_on": lambda module, values: module.drawn(values["witnesses"], values["alert"]["raised_at"]),
}


def terminals(home: Path) -> dict[str, str]:
    """Render what the night prints as pages."""
    night.out = Console(record=True, width=104, file=io.StringIO())
    night.print_ranking(home)
    return {"night": night.out.export_html(inline_styles=True)}


def photographed(pages: dict[str, str], folder: Path) -> list[Path]:
    """Photograph each page's text."""
    pictures = []
    with TemporaryDirectory() as scratch, started_browser() as browser:
        page = browser.new_page()
        page.set_viewport_size({"width": 1100, "height": 900})
        for name, text in pages.items():
            file = Path(scratch) / f"{name}.html"
            file.write_text(text, encoding="utf-8")
            page.goto(file.as_uri())
            pictures.append(folder / f"tutorial-{name}.png")
            page.locator("pre").screenshot(path=pictures[-1])
    return pictures


def lessons(home: Path, folder: Path) -> list[Path]:
    """Draw the figure of each lesson that has one."""
    os.environ["HDT_HOME"] = str(home)
    pictures = []
    for lesson, figure in LESSONS.items():
        spec = importlib.util.spec_from_file_location(lesson, COURSE / f"{lesson}.py")
        module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
        spec.loader.exec_module(module)  # type: ignore[union-attr]
        _, values = module.app.run()
        pictures.append(folder / f"tutorial-{lesson.replace('_', '-')}.png")
        figure(module, values).savefig(pictures[-1], dpi=100)
        values["con"].close()
    return pictures


if __name__ == "__main__":
    where, target = Path(sys.argv[1]), Path(*sys.argv[2:]) if sys.argv[2:] else IMAGES
    for picture in [*photographed(terminals(where), target), *lessons(where, target)]:
        print(small(picture))
