"""`python docs/tutorial_pictures.py HOME [FOLDER]`: pictures of the tutorial's steps, into docs/images.

HOME is one after a night over `data_samples/`. What a terminal shows is set by Rich, a lesson's figure by its notebook.
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
    "one_flight": lambda module, held: module.drawn(held["samples"]),
    "one_packs_life": lambda module, held: module.drawn(held["fouling"], held["told"]),
    "what_an_alert_rests_on": lambda module, held: module.drawn(held["witnesses"], held["alert"]["raised_at"]),
}


def terminals(home: Path) -> dict[str, str]:
    """What the night prints, as a page."""
    night.out = Console(record=True, width=104, file=io.StringIO())
    night.print_ranking(home)
    return {"night": night.out.export_html(inline_styles=True)}


def photographed(pages: dict[str, str], folder: Path) -> list[Path]:
    """A picture of each page's text."""
    made = []
    with TemporaryDirectory() as scratch, started_browser() as browser:
        shown = browser.new_page()
        shown.set_viewport_size({"width": 1100, "height": 900})
        for name, text in pages.items():
            page = Path(scratch) / f"{name}.html"
            page.write_text(text, encoding="utf-8")
            shown.goto(page.as_uri())
            made.append(folder / f"tutorial-{name}.png")
            shown.locator("pre").screenshot(path=made[-1])
    return made


def lessons(home: Path, folder: Path) -> list[Path]:
    """The figure of each lesson that has one."""
    os.environ["HDT_HOME"] = str(home)
    made = []
    for lesson, figure in LESSONS.items():
        spec = importlib.util.spec_from_file_location(lesson, COURSE / f"{lesson}.py")
        module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
        spec.loader.exec_module(module)  # type: ignore[union-attr]
        _, held = module.app.run()
        made.append(folder / f"tutorial-{lesson.replace('_', '-')}.png")
        figure(module, held).savefig(made[-1], dpi=100)
        held["con"].close()
    return made


if __name__ == "__main__":
    where, target = Path(sys.argv[1]), Path(*sys.argv[2:]) if sys.argv[2:] else IMAGES
    for picture in [*photographed(terminals(where), target), *lessons(where, target)]:
        print(small(picture))
