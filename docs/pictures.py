"""`python docs/pictures.py HOME [FOLDER]`: pictures of the report of a home, into docs/images."""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from pipelines.report.page import write_report

IMAGES = Path(__file__).parent / "images"
WIDTH, COLOURS = 960, 200
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


@contextmanager
def started_browser() -> Iterator[Browser]:
    """Start a headless Chromium.

    Raises
    ------
    FileNotFoundError
        There is none.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise FileNotFoundError(f"none of {', '.join(BROWSERS)} is installed")
    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])


def take(home: Path, folder: Path) -> list[Path]:
    """Photograph the page's head and the first card."""
    with TemporaryDirectory() as scratch, started_browser() as browser:
        file = Path(scratch) / "report.html"
        write_report(home, file)
        page = browser.new_page(viewport={"width": WIDTH, "height": 900})
        page.goto(file.as_uri())
        return [small(_head(page, folder / "report.png")), small(_alert(page, folder / "alert.png"))]


def small(picture: Path) -> Path:
    """Reduce a picture's colours and file size."""
    few = Image.open(picture).convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(picture, optimize=True)
    return picture


def _head(page: Page, target: Path) -> Path:
    page.screenshot(path=target, clip={"x": 0, "y": 0, "width": WIDTH, "height": 640})
    return target


def _alert(page: Page, target: Path) -> Path:
    """Photograph the first card: chart with forecast, alert, choices."""
    page.locator("#tracks article").first.screenshot(path=target)
    return target


if __name__ == "__main__":
    for picture in take(Path(sys.argv[1]), Path(*sys.argv[2:]) if sys.argv[2:] else IMAGES):
        print(picture)
