"""How long is left, and how sure."""

import json
from typing import Any

import polars as pl
import skops.io

from hdt_core.health.asks import CRITICAL
from hdt_core.prognosis.card import from_parts, model_card, to_parts
from hdt_core.prognosis.model import Prognosis
from hdt_core.prognosis.record import Heard, Record
from hdt_core.prognosis.rows import ASKS, LOSSES
from hdt_core.prognosis.service import Served, serve
from hdt_core.records.unit_index import PACK
from pipelines.assets.stage import StageResult, stage
from pipelines.learned import TRUSTED, shipped_base
from pipelines.report.pictures import DRAWN, night_pictures
from pipelines.resources import Home
from pipelines.storage.store import Store


@stage
def prognosis_base() -> pl.DataFrame:
    """What simulated lives teach, before any fleet has been seen: learned once and shipped."""
    base = shipped_base()
    return _kept(base, model_card(base))


@stage
def prognosis(
    prognosis_base: pl.DataFrame, raw_messages: pl.DataFrame, raw_maintenance: pl.DataFrame, home: Home
) -> StageResult:
    """Time to the failure message: the base corrected by the fleet's own lives, each tail judged by the others'.

    A base that does worse than the one in service is not promoted.
    """
    described = home.store.scan("features").select(pl.selectors.by_name(*READ, require_all=False))
    asks = home.store.scan("features_margin").select(*PACK, "flight_id", *CRITICAL, *ASKS)
    # what a flight asked is kept beside the features, of which it would be a fifth
    features = described.join(asks, on=[*PACK, "flight_id"], how="left").collect()
    served = serve(loaded(prognosis_base), _last(home.store), Record(features, raw_messages, raw_maintenance))
    pictures = night_pictures(features, served.prognoses, raw_maintenance)
    return StageResult((served.prognoses, _kept(served.model, served.card, served.lesson, served.heard)), pictures)


READ = tuple(dict.fromkeys((*PACK, "flight_id", "departed_at", *LOSSES, *DRAWN)))
"""Of 150 features what prognoses and pictures need: a fleet's memory follows from it."""


def _last(store: Store) -> Served | None:
    """What served until now; None where there is none, or none that says what it has spoken about."""
    table = store.read("prognosis_model")
    if not table.height or table["heard"][0] is None:
        return None
    row = table.row(0, named=True)
    card, told = json.loads(row["card"]), json.loads(row["heard"])
    return Served(loaded(table), store.read("prognoses"), card, row["lesson"], told)


def loaded(table: pl.DataFrame) -> Prognosis:
    """Model of a table's only row; a file with types beyond `TRUSTED` is refused."""
    return from_parts(skops.io.loads(table["model"][0], trusted=TRUSTED))


def _kept(
    model: Prognosis, card: dict[str, Any], lesson: str | None = None, heard: dict[str, Heard] | None = None
) -> pl.DataFrame:
    row = {"model_version": model.version, "card": json.dumps(card), "model": skops.io.dumps(to_parts(model))}
    return pl.DataFrame([row | {"lesson": lesson, "heard": None if heard is None else json.dumps(heard)}])
