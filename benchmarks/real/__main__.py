"""Every recipe whose folder is there: `python -m benchmarks.real --data DIR [--only NAME ...] [--write]`.

DIR (else HDT_REFERENCE) holds a folder a data set; what is absent is told, with where to get it. `--write` puts table
and plots into docs/real.md.
"""

import os
import time
from pathlib import Path

from benchmarks.harness import DOCS, add_write, arguments, origin, put
from benchmarks.real import cmapss, filters, hydraulic, lives, skab
from benchmarks.real.recipe import PAGE, described, plotted

RECIPES = (filters.RECIPE, hydraulic.RECIPE, cmapss.RECIPE, skab.RECIPE, lives.RECIPE)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, default=os.environ.get("HDT_REFERENCE"))
    parser.add_argument("--only", nargs="*", choices=[r.name for r in RECIPES])
    add_write(parser)
    options = parser.parse_args()
    written_by = origin()
    if options.data is None or not Path(options.data).is_dir():
        parser.error(
            "name the folder that holds the data sets with --data DIR or HDT_REFERENCE; docs/real.md says which"
        )
    for recipe in RECIPES:
        if options.only and recipe.name not in options.only:
            continue
        began = time.monotonic()
        folder = recipe.find_folder(Path(options.data))
        result = recipe.run(folder) if folder else None
        text = described(recipe, result)
        print(f"{text}\n\n({time.monotonic() - began:.0f} s)\n", flush=True)
        if options.write:
            plot = plotted(recipe, result, DOCS / "plots") if result else None
            put(recipe.name, f"{described(recipe, result, plot)}\n\n{written_by}", PAGE)


if __name__ == "__main__":
    main()
