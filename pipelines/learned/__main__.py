"""Learn the base again and write it where it is shipped from; `--check`: only if the sources learn another."""

import argparse
import json
from pathlib import Path

import skops.io

from hdt_core.prognosis.base import fit_base
from hdt_core.prognosis.feature_rows import INPUTS
from hdt_core.prognosis.service import to_parts
from pipelines.learned import FILE, RECIPE
from pipelines.learned.recipe import learns_the_same, sources

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m pipelines.learned", description=__doc__)
    parser.add_argument("--check", action="store_true", help="learn a third and keep the base if it predicts the same")
    place = Path(__file__).parent
    if parser.parse_args().check and learns_the_same():
        print("the present sources learn the same base")
    else:
        base = fit_base()
        (place / FILE).write_bytes(skops.io.dumps(to_parts(base)))
        print(f"learned {len(base.hazard)} models, levels {base.base_levels}")
    recipe = {"inputs": list(INPUTS), "sources": sources()}
    (place / RECIPE).write_text(json.dumps(recipe, indent=1) + "\n")
