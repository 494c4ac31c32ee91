"""Pages of the documentation run as they stand."""

import contextlib
import io
import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def walk(name: str, section: str = "") -> dict[str, object]:
    """Run the Python of a page, or of a `##` section, from top to bottom; it must print the `text` block behind it.

    The working directory must be the repository's folder. Returns the names that the page leaves.
    """
    page = (DOCS / name).read_text(encoding="utf-8")
    if section:
        page = page.split(f"\n## {section}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"^```python\n(.*?)^```\n(?:\s*^```text\n(.*?)^```)?", page, flags=re.MULTILINE | re.DOTALL)
    assert blocks, f"{name} has no Python to run"
    namespace: dict[str, object] = {"__name__": name}
    for code, promised in blocks:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, name, "exec"), namespace)
        output = printed.getvalue()
        assert output.strip() == promised.strip(), f"{name} promises\n{promised}\nand prints\n{output}"
    return namespace
