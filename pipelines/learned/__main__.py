"""Learn the base again and write it where it is shipped from."""

import json
from pathlib import Path

import skops.io

from hdt_core.prognosis.card import to_parts
from hdt_core.prognosis.model import fit_base
from hdt_core.prognosis.rows import INPUTS
from pipelines.learned import FILE

if __name__ == "__main__":
    base = fit_base()
    Path(__file__).with_name(FILE).write_bytes(skops.io.dumps(to_parts(base) | {"inputs": json.dumps(INPUTS)}))
    print(f"learned {base.version or 'base'}: {len(base.hazard)} models, levels {base.base_levels}")
