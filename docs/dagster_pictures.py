"""`python docs/dagster_pictures.py LANDING HOME`: picture of recorder files in Dagster, to docs/images."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pictures import IMAGES, WIDTH, small, started_browser
from PIL import Image
from playwright.sync_api import Page

GROUP = "locations/__repository__@pipelines.definitions/asset-groups/1_recorder_files/list"
WINDOW, SIDE = {"width": 1500, "height": 1700}, 240
ROW = "main a[href*='/assets/'], a[href^='/assets/']"


@contextmanager
def served(landing: str, home: str) -> Iterator[str]:
    """Serve Dagster's page of a home within the block; yield its address."""
    command = [Path(sys.executable).with_name("hdt"), "ui", "--port", "0"]
    command += ["--landing", landing, "--home", home]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as page:
        try:
            yield next(
                match[0] for line in page.stdout or () if (match := re.search(r"http://127\.0\.0\.1:\d+/", line))
            )
        finally:
            page.terminate()


def group(page: Page, address: str) -> Path:
    """Photograph the list of the group's assets with their progress."""
    page.goto(address + GROUP)
    page.get_by_text("partitions").or_(page.get_by_text("Materialized")).first.wait_for()
    page.wait_for_timeout(4000)  # numbers come after names
    top = page.get_by_text("Asset name").bounding_box()["y"] - 6
    bottom = max(row.bounding_box()["y"] for row in page.locator(ROW).all() if row.is_visible()) + 52
    clip = {"x": SIDE, "y": top, "width": WINDOW["width"] - SIDE, "height": bottom - top}
    target = IMAGES / "dagster-raw.png"
    page.screenshot(path=target, clip=clip)
    picture = Image.open(target)
    picture.thumbnail((WIDTH, 4 * WIDTH), Image.Resampling.LANCZOS)
    picture.save(target)
    return small(target)


if __name__ == "__main__":
    with served(*sys.argv[1:3]) as address, started_browser() as browser:
        print(group(browser.new_page(viewport=WINDOW), address))
