"""The base model that prognosis starts from, learned once from simulated lives and shipped, without any fleet's data.

`python -m pipelines.learned` learns and writes it again, some minutes of one core, after a change of the simulator, the
features or the learner. `recipe.json` holds its inputs and the digest of the sources it was learned from, or compared
with: where the sources differ, a test learns a part again and compares.
"""

import json
from functools import lru_cache
from importlib.resources import files
from typing import Any

from hdt_core.prognosis.feature_rows import INPUTS
from hdt_core.prognosis.model import Prognosis
from hdt_core.prognosis.service import from_parts

FILE, RECIPE = "base.skops", "recipe.json"
TRUSTED_TYPES = ["sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor"]
"""Types that a model file may hold beyond those skops trusts; any other refuses the file."""


class StaleBaseError(Exception):
    """The shipped base was learned from other inputs than the code now reads."""


def shipped_base() -> Prognosis:
    """Load the base of this installation. Raises `StaleBaseError`."""
    return load_base(shipped_bytes())


def shipped_bytes() -> bytes:
    """Read the stored bytes of the base.

    Raises
    ------
    StaleBaseError
        It reads other inputs than the present code provides.
    """
    if shipped_recipe()["inputs"] != list(INPUTS):
        raise StaleBaseError("the shipped base was learned from other inputs: run python -m pipelines.learned")
    return files(__name__).joinpath(FILE).read_bytes()


def shipped_recipe() -> dict[str, Any]:
    """Read `inputs` of the base and the digest of the `sources` it was learned from."""
    return dict(json.loads(files(__name__).joinpath(RECIPE).read_text()))


@lru_cache(maxsize=2)
def load_base(content: bytes) -> Prognosis:
    """Load a base from skops bytes, once a process; a type beyond `TRUSTED_TYPES` is refused."""
    import skops.io  # takes a second, and most processes of a night read no model

    return from_parts(skops.io.loads(content, trusted=TRUSTED_TYPES))
