"""Pages of the documentation run as they stand."""

import contextlib
import io
import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def walk(name: str) -> dict[str, object]:
    """Run the Python of a page from top to bottom; what it prints must be the `text` block behind it.

    The working directory must be the repository's folder. Returns the names that the page leaves.
    """
    page = (DOCS / name).read_text(encoding="utf-8")
    found = re.findall(r"^```python\n(.*?)^```\n(?:\s*^```text\n(.*?)^```)?", page, flags=re.MULTILINE | re.DOTALL)
    assert found, f"{name} has no Python to run"
    held: dict[str, object] = {"__name__": name}
    for code, promised in found:
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(compile(code, name, "exec"), held)
        assert said.getvalue().strip() == promised.strip(), (
            f"{name} promises\n{promised}\nand prints\n{said.getvalue()}"
        )
    return held
