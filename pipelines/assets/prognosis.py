"""How long is left, and how sure."""

import hashlib
import json

import polars as pl

from hdt_core.margin.exchanger_demand import CRITICAL
from hdt_core.prognosis.feature_rows import ASKS, LOSSES
from hdt_core.prognosis.fleet_record import FleetRecord
from hdt_core.prognosis.model_card import fits_to_json, model_card, with_fits
from hdt_core.prognosis.service import ModelUpdate, MonthModel, update_model
from hdt_core.prognosis.training_digest import read_digest
from hdt_core.prognosis.unit_lives import told_lives
from hdt_core.records.keys import PACK
from pipelines.assets.stage import StageResult, stage
from pipelines.learned import loaded, shipped_base, shipped_bytes
from pipelines.lineage import FOLLOWED, LINEAGE
from pipelines.report.pictures import PICTURE_FEATURES, night_pictures
from pipelines.resources import Home
from pipelines.storage.store import Store


@stage
def prognosis_base() -> pl.DataFrame:
    """What simulated lives teach, before any fleet has been seen: learned once and shipped."""
    base = shipped_base()
    row = {"model_version": base.version, "card": json.dumps(model_card(base)), "model": shipped_bytes()}
    return pl.DataFrame([row])


@stage
def prognosis(
    prognosis_base: pl.DataFrame,
    raw_messages: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    calibration_dsm: pl.DataFrame,
    calibration_schedules: pl.DataFrame,
    home: Home,
) -> StageResult:
    """Time to the failure message: the base corrected by the lives of the months before, each tail judged by others'.

    A base that does worse than the one in service is not promoted.
    """
    described = home.store.scan("features").select(pl.selectors.by_name(*READ, require_all=False))
    asks = home.store.scan("features_margin").select(*PACK, "flight_id", *CRITICAL, *ASKS)
    # what a flight asked is kept beside the features, of which it would be a fifth
    features = described.join(asks, on=[*PACK, "flight_id"], how="left", validate="m:1").collect()
    stored = home.store.read_table("prognosis_model").sort("month")
    candidate, last = loaded(prognosis_base["model"][0]), _served(stored, home.store)
    record = FleetRecord(features, raw_messages, raw_maintenance)
    update = update_model(candidate, last, record, _design(calibration_dsm, calibration_schedules))
    pictures = night_pictures(features, update.prognoses, raw_maintenance)
    base = prognosis_base if not update.months or update.newest.model.hazard is candidate.hazard else stored
    lives = told_lives(features, record.lives())
    return StageResult((update.prognoses, _rows(update, base["model"][-1]), lives), pictures)


READ = tuple(dict.fromkeys((*PACK, "flight_id", "departed_at", *LOSSES, *PICTURE_FEATURES)))
"""Of 150 features what prognoses and pictures need: a fleet's memory follows from it."""


def _design(calibration_dsm: pl.DataFrame, calibration_schedules: pl.DataFrame) -> str:
    """Digest of what features and prognoses follow from beside the record: models, laws and the code of each stage."""
    codes = [(table, LINEAGE[table].code) for table in sorted({*FOLLOWED["prognosis"], "prognoses"})]
    content = [calibration_dsm["dsm_version"].to_list(), calibration_schedules.sort("name")["laws"].to_list(), codes]
    return hashlib.blake2b(json.dumps(content).encode(), digest_size=8).hexdigest()


def _served(stored: pl.DataFrame, store: Store) -> ModelUpdate | None:
    """What served until now; None where there is none, or one that had no months."""
    if not stored.height or stored["month"].has_nulls():
        return None
    base = loaded(stored["model"][-1])
    months = {
        row["month"]: MonthModel(
            with_fits(base, json.loads(row["fits"])),
            json.loads(row["card"]),
            read_digest(row["training_digest"]),
            json.loads(row["scored_flights"]),
            json.loads(row["service"]),
        )
        for row in stored.iter_rows(named=True)
    }
    return ModelUpdate(months, store.read_table("prognoses"))


def _rows(update: ModelUpdate, base: bytes) -> pl.DataFrame:
    """The models as rows: what each month's record taught, and with the newest the base as it came."""
    rows = [
        {
            "month": month, "model_version": own.model.version, "card": json.dumps(own.card),
            "service": json.dumps(own.service), "fits": json.dumps(fits_to_json(own.model)),
            "training_digest": own.digest.to_json(), "scored_flights": json.dumps(own.scored),
            "model": base if own is update.newest else None,
        }
        for month, own in sorted(update.months.items())
    ]  # fmt: skip
    return pl.DataFrame(rows, infer_schema_length=None)
