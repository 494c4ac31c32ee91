"""Tables that sort, that the search sees, and that fold into cards on a phone."""

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

from pipelines.report.html import Html, tag

Cell = tuple[Any, Any]  # what is shown, what is sorted by
SHORT = 22  # characters that are not worth a line break: a pack by its name


def table(
    names: Sequence[str], rows: Iterable[Sequence[Cell]], *, sortable: bool = False, finds: Sequence[str] = ()
) -> Html:
    """A table; `finds` is what the search looks at, row by row."""
    head = [tag("th", tag("button", n, type="button") if sortable else n, scope="col") for n in names]
    body = []
    for i, row in enumerate(rows):
        cells = [_cell(name, *cell) for name, cell in zip(names, row, strict=True)]
        body.append(tag("tr", *cells, data_find=finds[i] if finds else None))
    kind = "sortable" if sortable else None
    return tag("table", tag("thead", tag("tr", *head)), tag("tbody", *body), class_=kind)


def _cell(name: str, shown: Any, sort_value: Any) -> Html:
    value = f"{sort_value:.6g}" if isinstance(sort_value, float) else sort_value
    short = len(re.sub(r"<[^>]*>", "", str(shown))) <= SHORT
    return tag("td", shown, data_label=name, data_v=value, class_="keep" if short else None)


def plain(*values: Any) -> list[Cell]:
    """A row whose cells are sorted by nothing."""
    return [(v, None) for v in values]


def number(value: float | None, digits: int = 4) -> str:
    """Some significant digits, without an exponent where the number is of common size."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"
