"""Predict remaining flights to the failure message, with intervals."""

import hashlib
import json
from dataclasses import asdict

import polars as pl

from hdt_core.components.declaration import CLEANED
from hdt_core.components.pack import HX
from hdt_core.margin.exchanger_demand import CRITICAL
from hdt_core.prognosis.choices import NO_WASHES, Washes, learn_washes
from hdt_core.prognosis.component_life import component_choices, component_life_table, component_prognoses
from hdt_core.prognosis.feature_rows import LOSSES, MARGIN_FEATURES
from hdt_core.prognosis.fleet_record import FleetRecord, TrainingDigest
from hdt_core.prognosis.service import ModelUpdate, MonthModel, fits_to_json, model_card, update_model, with_fits
from hdt_core.prognosis.unit_lives import life_table
from hdt_core.records.keys import PACK
from pipelines.assets.components import conform_all, of_pack, recorded_in
from pipelines.assets.stage import stage
from pipelines.learned import load_base, shipped_base, shipped_bytes
from pipelines.lineage import DECLARED, LINEAGE, UPSTREAM
from pipelines.resources import Home
from pipelines.storage.store import Store


@stage
def prognosis_base() -> pl.DataFrame:
    """Load the shipped base model, fitted to simulated lives."""
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
    features_components: pl.DataFrame,
    features_work: pl.DataFrame,
    home: Home,
) -> tuple[pl.DataFrame, ...]:
    """Predict time to the failure message by the base corrected by lives of earlier months, each tail's by other tails.

    A base that scores worse than the one in service is not promoted. Losses of declared components are extrapolated to
    that at which others failed, or to the declared limit.
    """
    health = home.store.scan("features").select(pl.selectors.by_name(*FEATURE_COLUMNS, require_all=False))
    margins = home.store.scan("features_margin").select(*PACK, "flight_id", *CRITICAL, *MARGIN_FEATURES)
    # margins have a table of their own, for they would be a fifth of the features
    features = health.join(margins, on=[*PACK, "flight_id"], how="left", validate="m:1").collect()
    stored = home.store.read_table("prognosis_model").sort("month")
    candidate = load_base(prognosis_base["model"][0])
    in_service = _model_in_service(stored, home.store)
    washes = _washes_on_record(features, features_components, features_work, raw_maintenance)
    record = FleetRecord(features, raw_messages, raw_maintenance, washes)
    update = update_model(candidate, in_service, record, _design(calibration_dsm, calibration_schedules))
    base = prognosis_base if not update.months or update.newest.model.hazard is candidate.hazard else stored
    lives = life_table(features, record.lives())
    inputs = (features_components, raw_messages, raw_maintenance)
    declared = recorded_in(features_components)
    prognoses = conform_all("prognoses", [update.prognoses, *(component_prognoses(*inputs, c) for c in declared)])
    lives = conform_all("prognosis_lives", [lives, *(component_life_table(*inputs, c) for c in declared)])
    after_work = [component_choices(*inputs, c, washes.get(c.code, NO_WASHES)) for c in declared]
    choices = conform_all("prognosis_choices", [update.choices, *after_work])
    return prognoses, _rows(update, base["model"][-1]), lives, choices


FEATURE_COLUMNS = (*PACK, "flight_id", "departed_at", *LOSSES)
"""Features that prognoses need, of 150; more would take memory on a large fleet."""


def _washes_on_record(
    features: pl.DataFrame,
    features_components: pl.DataFrame,
    features_work: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
) -> dict[str, Washes]:
    """Measure the washes of each component."""
    exchangers = features.select(
        *PACK, "departed_at", component=pl.lit(HX.code), loss="hx_fouling", loss_sd="hx_fouling_sd"
    )
    losses = pl.concat([exchangers, features_components.select(exchangers.columns)])
    washed = features_work.filter(action=CLEANED)["component"].unique()
    return {
        code: learn_washes(
            losses.filter(component=code), features_work.filter(component=code), raw_maintenance.filter(component=code)
        )
        for code in washed
    }


def _design(calibration_dsm: pl.DataFrame, calibration_schedules: pl.DataFrame) -> str:
    """Digest what the pack's prognoses depend on besides the record: models, laws, the code version of each stage."""
    tables = sorted({*UPSTREAM["prognosis"], "prognoses"})
    codes = [(table, LINEAGE[table].code) for table in tables if DECLARED not in LINEAGE[table].code]
    content = [calibration_dsm["dsm_version"].to_list(), calibration_schedules.sort("name")["laws"].to_list(), codes]
    return hashlib.blake2b(json.dumps(content).encode(), digest_size=8).hexdigest()


def _model_in_service(stored: pl.DataFrame, store: Store) -> ModelUpdate | None:
    """Read the model in service; None without one, or with one that has no months."""
    if not stored.height or stored["month"].has_nulls():
        return None
    base = load_base(stored["model"][-1])
    months = {
        row["month"]: MonthModel(
            with_fits(base, json.loads(row["fits"])),
            json.loads(row["card"]),
            TrainingDigest(**json.loads(row["training_digest"])),
            json.loads(row["scored_flights"]),
            json.loads(row["service"]),
        )
        for row in stored.iter_rows(named=True)
    }
    return ModelUpdate(months, of_pack(store.read_table("prognoses")))


def _rows(update: ModelUpdate, base: bytes) -> pl.DataFrame:
    """Return the models as rows: each month's fits, and with the newest month the base."""
    rows = [
        {
            "month": month, "model_version": month_model.model.version, "card": json.dumps(month_model.card),
            "service": json.dumps(month_model.service), "fits": json.dumps(fits_to_json(month_model.model)),
            "training_digest": json.dumps(asdict(month_model.digest), separators=(",", ":")),
            "scored_flights": json.dumps(month_model.scored_flights),
            "model": base if month_model is update.newest else None,
        }
        for month, month_model in sorted(update.months.items())
    ]  # fmt: skip
    return pl.DataFrame(rows, infer_schema_length=None)
