"""The base that prognosis starts from, learned once from simulated lives and shipped: it knows no fleet.

`python -m pipelines.learned` learns it again and writes it, some minutes of one core. A change of the simulator, of the
features or of the learner calls for it; a test learns a part again and compares.
"""

import json
from functools import cache
from importlib.resources import files
from typing import Any

import skops.io

from hdt_core.prognosis.card import from_parts
from hdt_core.prognosis.model import Prognosis
from hdt_core.prognosis.rows import INPUTS

FILE = "base.skops"
# what a model file may hold besides what skops trusts by itself; a name beyond these refuses the file
TRUSTED = ["sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor"]


class StaleBaseError(Exception):
    """The shipped base was learned from other inputs than the code now reads."""


@cache
def shipped_base() -> Prognosis:
    """Base that came with this installation.

    Raises
    ------
    StaleBaseError
        It reads other inputs than the present code gives.
    """
    parts: dict[str, Any] = skops.io.loads(files(__name__).joinpath(FILE).read_bytes(), trusted=TRUSTED)
    if parts.pop("inputs") != json.dumps(INPUTS):
        raise StaleBaseError("the shipped base was learned from other inputs: run python -m pipelines.learned")
    return from_parts(parts)
