"""How long is left, and how sure."""

import json
from typing import Any

import polars as pl
import skops.io

from hdt_core.prognosis.card import from_parts, model_card, to_parts
from hdt_core.prognosis.lives import episodes
from hdt_core.prognosis.model import Prognosis, fit_base
from hdt_core.prognosis.service import serve
from pipelines.assets.stage import Shown, stage
from pipelines.pictures import night_pictures
from pipelines.resources import Home

# what a model file may hold besides what skops trusts by itself; a name beyond these refuses the file
TRUSTED = ["sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor"]


@stage("prognosis_base", group="prognosis")
def prognosis_base() -> pl.DataFrame:
    """What simulated lives teach, before any fleet has been seen: fitted once for a version of the code."""
    base = fit_base()
    return _kept(base, model_card(base))


@stage("prognosis_model", "prognoses", group="prognosis")
def prognosis(
    prognosis_base: pl.DataFrame,
    features: pl.DataFrame,
    raw_messages: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    home: Home,
) -> Shown:
    """Time to the failure message: the base corrected by the fleet's own lives, each tail judged by the others'.

    A base that does worse than the one in service is not promoted.
    """
    candidate, in_service = loaded(prognosis_base), home.store.read("prognosis_model")
    lives = episodes(features, raw_messages, raw_maintenance)
    served = serve(candidate, loaded(in_service) if in_service.height else None, features, lives)
    pictures = night_pictures(features, served.prognoses, raw_maintenance)
    return Shown((_kept(served.model, served.card), served.prognoses), pictures, on=1)


def loaded(table: pl.DataFrame) -> Prognosis:
    """Model of a table's only row; a file with types beyond `TRUSTED` is refused."""
    return from_parts(skops.io.loads(table["model"][0], trusted=TRUSTED))


def _kept(model: Prognosis, card: dict[str, Any]) -> pl.DataFrame:
    return pl.DataFrame(
        {"model_version": [model.version], "card": [json.dumps(card)], "model": [skops.io.dumps(to_parts(model))]}
    )
