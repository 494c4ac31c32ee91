"""The page in headless Chromium: no error, no sideways scroll on a phone, search, sort and links work."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from pipelines.report import write_report

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")

# runs in the page and leaves what it saw in a <pre>; a throw is caught by the first script
_WATCH = "<script>window.faults = []; window.addEventListener('error', (e) => faults.push(e.message))</script>"
_LOOK = """<script>
const seen = {};
const wide = () => document.documentElement.scrollWidth - document.documentElement.clientWidth;
seen.sideways = wide();
const shown = () => [...document.querySelectorAll('#ranking tbody tr')].filter((r) => !r.hidden);
seen.packs = shown().length;
const find = document.getElementById('find');
find.value = 'a9-bac 2'; find.dispatchEvent(new Event('input'));
seen.found = shown().map((r) => r.cells[2].textContent);
seen.cards = [...document.querySelectorAll('#tracks article')].filter((r) => !r.hidden).length;
// the fold of closed alerts; within a card another one holds what was said when it was raised
const lists = [...document.querySelectorAll('details')].filter((d) => d.querySelector('[data-find]'));
const folds = () => lists.map((d) => d.open);
seen.unfolded = folds();
find.value = ''; find.dispatchEvent(new Event('input'));
seen.folded = folds();
const sort = (name) => {
  [...document.querySelectorAll('#ranking th button')].find((b) => b.textContent === name).click();
  return shown().map((r) => Number(r.cells[4].dataset.v));
};
seen.up = sort('UA lost'); seen.down = sort('UA lost');
seen.links = [...document.querySelectorAll('a')].every((a) => document.querySelector(a.getAttribute('href')));
seen.hidden_text = [...document.querySelectorAll('svg')].filter((s) => s.getBoundingClientRect().width < 250).length;
seen.faults = faults;
document.body.innerHTML = '<pre>' + JSON.stringify(seen) + '</pre>';
</script>"""


def look(page: Path, width: int) -> tuple[dict, str]:
    """What the page looks like from inside, and the browser's console."""
    html = page.read_text(encoding="utf-8")
    html = html.replace("<head>", f"<head>{_WATCH}", 1).replace("</body>", f"{_LOOK}</body>", 1)
    watched = page.with_name(f"watched_{width}.html")
    # a headless window has a least width; a frame has none
    watched.write_text(html, encoding="utf-8")
    options = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        f"--window-size={width},900",
    ]
    home = f"--user-data-dir={page.with_name(f'profile_{width}')}"
    done = subprocess.run(
        [str(CHROMIUM), *options, home, "--dump-dom", watched.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    found = re.search(r"<pre>(.*)</pre>", done.stdout, re.DOTALL)
    assert found, done.stderr
    console = "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)
    return json.loads(found.group(1).replace("&gt;", ">").replace("&lt;", "<").replace("&amp;", "&")), console


@pytest.mark.parametrize("width", [390, 800, 1280])
def test_the_page_works_in_a_browser(sample_home, tmp_path, width):
    page = tmp_path / "report.html"
    write_report(sample_home, page)
    seen, console = look(page, width)
    assert console == ""
    assert seen["faults"] == []
    assert seen["sideways"] <= 0
    assert seen["packs"] == 4
    assert seen["found"] == ["A9-BAC pack 2 (right)"]
    assert seen["cards"] == 1
    # closed alerts lie folded, on paper too, until something among them is looked for
    assert (seen["folded"], seen["unfolded"]) == ([False], [True])
    assert seen["up"] == sorted(seen["up"])
    assert seen["down"] == sorted(seen["up"], reverse=True)
    assert seen["links"]
    assert seen["hidden_text"] == 0
