"""How long is left, and how sure."""

import json

import polars as pl

from hdt_core.margin.exchanger_demand import CRITICAL
from hdt_core.prognosis.feature_rows import ASKS, LOSSES
from hdt_core.prognosis.fleet_record import FleetRecord
from hdt_core.prognosis.model_card import fits_to_json, model_card, with_fits
from hdt_core.prognosis.service import ModelUpdate, update_model
from hdt_core.prognosis.unit_lives import told_lives
from hdt_core.records.keys import PACK
from pipelines.assets.stage import StageResult, stage
from pipelines.learned import loaded, shipped_base, shipped_bytes
from pipelines.report.pictures import DRAWN, night_pictures
from pipelines.resources import Home
from pipelines.storage.store import Store


@stage
def prognosis_base() -> pl.DataFrame:
    """What simulated lives teach, before any fleet has been seen: learned once and shipped."""
    base = shipped_base()
    row = {"model_version": base.version, "card": json.dumps(model_card(base)), "model": shipped_bytes()}
    return pl.DataFrame([row | dict.fromkeys(("fits", "lesson", "heard"))])


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
    features = described.join(asks, on=[*PACK, "flight_id"], how="left", validate="m:1").collect()
    stored = home.store.read("prognosis_model")
    candidate, last = loaded(prognosis_base["model"][0]), _served(stored, home.store)
    record = FleetRecord(features, raw_messages, raw_maintenance)
    served = update_model(candidate, last, record)
    pictures = night_pictures(features, served.prognoses, raw_maintenance)
    base = prognosis_base if served.model.hazard is candidate.hazard else stored
    lives = told_lives(features, record.lives())
    return StageResult((served.prognoses, _kept(served, base["model"][0]), lives), pictures)


READ = tuple(dict.fromkeys((*PACK, "flight_id", "departed_at", *LOSSES, *DRAWN)))
"""Of 150 features what prognoses and pictures need: a fleet's memory follows from it."""


def _served(stored: pl.DataFrame, store: Store) -> ModelUpdate | None:
    """What served until now; None where there is none, or none that says what it has spoken about."""
    if not stored.height or stored["heard"][0] is None or stored["fits"][0] is None:
        return None
    row = stored.row(0, named=True)
    model = with_fits(loaded(row["model"]), json.loads(row["fits"]))
    return ModelUpdate(model, store.read("prognoses"), json.loads(row["card"]), row["lesson"], json.loads(row["heard"]))


def _kept(served: ModelUpdate, base: bytes) -> pl.DataFrame:
    """The model in service as a row: its base as it came, what the fleet taught beside it."""
    row = {"model_version": served.model.version, "card": json.dumps(served.card), "model": base}
    row |= {"fits": json.dumps(fits_to_json(served.model)), "lesson": served.digest, "heard": json.dumps(served.scored)}
    return pl.DataFrame([row])
