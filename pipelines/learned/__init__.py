"""The base that prognosis starts from, learned once from simulated lives and shipped: it knows no fleet.

`python -m pipelines.learned` learns it again and writes it, some minutes of one core. A change of the simulator, of the
features or of the learner calls for it. `recipe.json` says what it reads, and of which sources it was learned or found
to be the same: a test learns a part again and compares where they are others.
"""

import json
from functools import lru_cache
from importlib.resources import files
from typing import Any

from hdt_core.prognosis.feature_rows import INPUTS
from hdt_core.prognosis.model import Prognosis
from hdt_core.prognosis.model_card import from_parts

FILE, RECIPE = "base.skops", "recipe.json"
# what a model file may hold besides what skops trusts by itself; a name beyond these refuses the file
TRUSTED = ["sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor"]


class StaleBaseError(Exception):
    """The shipped base was learned from other inputs than the code now reads."""


def shipped_base() -> Prognosis:
    """Base that came with this installation. Raises `StaleBaseError`."""
    return loaded(shipped_bytes())


def shipped_bytes() -> bytes:
    """The same, as it is stored.

    Raises
    ------
    StaleBaseError
        It reads other inputs than the present code gives.
    """
    if shipped_recipe()["inputs"] != list(INPUTS):
        raise StaleBaseError("the shipped base was learned from other inputs: run python -m pipelines.learned")
    return files(__name__).joinpath(FILE).read_bytes()


def shipped_recipe() -> dict[str, Any]:
    """`inputs` that the base reads and a digest of the `sources` that it was learned from."""
    return dict(json.loads(files(__name__).joinpath(RECIPE).read_text()))


@lru_cache(maxsize=2)
def loaded(stored: bytes) -> Prognosis:
    """A base from skops bytes, read once a process; those that name a type beyond `TRUSTED` are refused."""
    import skops.io  # a second to load, and most processes of a night read no model

    return from_parts(skops.io.loads(stored, trusted=TRUSTED))
