"""`python docs/dagster_pictures.py LANDING HOME`: pictures of Dagster's page, a group each, into docs/images."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pictures import IMAGES, WIDTH, small, started_browser
from PIL import Image
from playwright.sync_api import Page

GROUPS = ("raw", "legs", "calibration", "twin", "residuals", "features", "prognosis")
GROUP = "locations/__repository__@pipelines.definitions/asset-groups/{}/list"
WINDOW, SIDE = {"width": 1500, "height": 1700}, 240
ROW = "main a[href*='/assets/'], a[href^='/assets/']"


@contextmanager
def served(landing: str, home: str) -> Iterator[str]:
    """Address of Dagster's page of a home, for as long as it is looked at."""
    command = [Path(sys.executable).with_name("hdt"), "ui", "--port", "0"]
    command += ["--landing", landing, "--home", home]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as page:
        try:
            yield next(
                found[0] for line in page.stdout or () if (found := re.search(r"http://127\.0\.0\.1:\d+/", line))
            )
        finally:
            page.terminate()


def group(page: Page, address: str, name: str) -> Path:
    """The list of a group's assets, how far each is filled."""
    page.goto(address + GROUP.format(name))
    page.get_by_text("partitions").or_(page.get_by_text("Materialized")).first.wait_for()
    page.wait_for_timeout(4000)  # numbers come after names
    top = page.get_by_text("Asset name").bounding_box()["y"] - 6
    bottom = max(row.bounding_box()["y"] for row in page.locator(ROW).all() if row.is_visible()) + 52
    clip = {"x": SIDE, "y": top, "width": WINDOW["width"] - SIDE, "height": bottom - top}
    return _narrow(page, IMAGES / f"dagster-{name}.png", clip)


def check(page: Page, address: str) -> Path:
    """A check that passed, with what it tells."""
    page.set_viewport_size({"width": 1900, "height": 1000})
    page.goto(address + "assets/features?view=checks")
    page.get_by_text("Latest execution").wait_for()
    page.get_by_text("seconds").first.wait_for()
    return _narrow(page, IMAGES / "dagster-check.png", {"x": 575, "y": 110, "width": 720, "height": 550})


def _narrow(page: Page, target: Path, clip: dict[str, float]) -> Path:
    page.screenshot(path=target, clip=clip)
    picture = Image.open(target)
    picture.thumbnail((WIDTH, 4 * WIDTH), Image.Resampling.LANCZOS)
    picture.save(target)
    return small(target)


if __name__ == "__main__":
    with served(*sys.argv[1:3]) as address, started_browser() as shown:
        told = shown.new_page(viewport=WINDOW)
        for made in (*(group(told, address, name) for name in GROUPS), check(told, address)):
            print(made)
