"""What is stale: exactly the cells whose inputs changed, by content and never by time."""

import datetime as dt

import polars as pl
import pytest

from hdt_core.tables import TABLES
from pipelines.assets.stage import stage
from pipelines.definitions import build_defs
from pipelines.lineage import LINEAGE, MAKER, STAGE, Recipe, upstream_tables
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store
from pipelines.versions import CELL, expected_versions, stale_cells_of

A = ("AQX", "LX-AAA")
B = ("AQX", "LX-AAB")


def deliver(ledger: Ledger, aircraft, name: str, flights: list[str], digest: str, kind: str = "acms") -> None:
    path = f"{aircraft[0]}/{aircraft[1]}/{name}"
    ledger.register([(path, *aircraft, kind, 1, 1, digest)], {path: [(*aircraft, flight) for flight in flights]})


def make(ledger: Ledger, *tables: str, without_rows: str = "") -> None:
    for table in tables:
        ledger.mark(table, expected_versions(ledger, table))
        if table == "legs_samples":
            store_verdicts(ledger, without_rows)


def store_verdicts(ledger: Ledger, without_rows: str) -> None:
    """Store a row for each flight but the one without rows."""
    for aircraft, cells in ledger.cells("legs_samples").group_by("operator", "tail"):
        rows = cells.filter(pl.col("flight_id") != without_rows).select(*CELL[:3], pack=1)
        Store(ledger.home).merge("legs_verdicts", {aircraft: cells["flight_id"]}, TABLES["legs_verdicts"].conform(rows))


@pytest.fixture
def ledger(tmp_path) -> Ledger:
    ledger = Ledger(tmp_path)
    deliver(ledger, A, "history_2024-05.parquet", ["LX-AAA_20240501_01", "LX-AAA_20240502_01"], "h1", "history")
    deliver(ledger, B, "LX-AAB_20240501_01.csv", ["LX-AAB_20240501_01"], "b1")
    make(ledger, "raw_flights", "legs_samples", "calibration_dsm", "calibration_sisters", "twin_flights")
    return ledger


def flights(frame: pl.DataFrame) -> set[str]:
    return set(frame["flight_id"])


@pytest.mark.parametrize("table", ["raw_flights", "legs_samples", "calibration_dsm", "twin_flights"])
def test_made_cells_are_not_stale(ledger, table):
    assert stale_cells_of(ledger, [table]).is_empty()


def test_same_file_makes_nothing_stale(ledger):
    deliver(ledger, B, "LX-AAB_20240501_01.csv", ["LX-AAB_20240501_01"], "b1")
    assert stale_cells_of(ledger, ["raw_flights"]).is_empty()


def test_second_file_makes_flight_stale(ledger):
    deliver(ledger, A, "LX-AAA_20240502_01.csv", ["LX-AAA_20240502_01"], "c1")
    assert flights(stale_cells_of(ledger, ["raw_flights"])) == {"LX-AAA_20240502_01"}


def test_corrected_file_makes_flights_stale(ledger):
    deliver(ledger, A, "history_2024-05.parquet", ["LX-AAA_20240501_01", "LX-AAA_20240502_01"], "h2", "history")
    assert flights(stale_cells_of(ledger, ["raw_flights"])) == {"LX-AAA_20240501_01", "LX-AAA_20240502_01"}
    assert stale_cells_of(ledger, ["legs_samples"]).is_empty(), "what follows is stale once its parent was made anew"
    make(ledger, "raw_flights")
    assert flights(stale_cells_of(ledger, ["legs_samples"])) == {"LX-AAA_20240501_01", "LX-AAA_20240502_01"}


def test_new_code_makes_stage_stale(ledger, monkeypatch):
    """No other, until it was run."""
    monkeypatch.setitem(LINEAGE, "legs_samples", Recipe(("raw_flights",), code="another"))
    assert stale_cells_of(ledger, ["legs_samples"]).height == 3
    assert stale_cells_of(ledger, ["raw_flights"]).is_empty()


def test_early_flight_makes_tracks_stale(ledger):
    make(ledger, "twin_health")
    deliver(ledger, B, "LX-AAB_20240501_01.csv", ["LX-AAB_20240501_01"], "b2")
    make(ledger, "raw_flights", "legs_samples", "calibration_dsm", "twin_flights")
    stale = stale_cells_of(ledger, ["twin_health"])
    # both aircraft are within the commissioning window, so the model itself has changed with the flight
    assert set(stale["tail"]) == {"LX-AAA", "LX-AAB"}


def test_late_flight_spares_the_model(tmp_path):
    ledger = Ledger(tmp_path)
    ids = [f"LX-AAA_2024{m:02d}{d:02d}_{leg:02d}" for m in range(1, 4) for d in range(1, 29) for leg in (1, 2)]
    deliver(ledger, A, "history.parquet", ids[:161], "h", "history")
    make(ledger, "raw_flights", "legs_samples", "calibration_dsm", "calibration_sisters", "twin_flights", "twin_health")
    deliver(ledger, A, f"{ids[165]}.csv", [ids[165]], "new")
    make(ledger, "raw_flights", "legs_samples")
    assert stale_cells_of(ledger, ["calibration_dsm"]).is_empty()
    assert flights(stale_cells_of(ledger, ["twin_flights"])) == {ids[165]}


def test_flight_without_rows_spares_model(ledger):
    before = expected_versions(ledger, "calibration_dsm")
    refused = "LX-AAB_20230105_01"
    deliver(ledger, B, f"{refused}.csv", [refused], "refused")

    make(ledger, "raw_flights", "legs_samples", without_rows=refused)

    assert expected_versions(ledger, "calibration_dsm").equals(before)


def test_baseline_counts_records_within_window(tmp_path):
    ledger = Ledger(tmp_path)
    store = Store(tmp_path)
    deliver(ledger, A, "x.csv", ["LX-AAA_20240501_01"], "d")
    make(ledger, "raw_flights", "legs_samples")
    before = set(expected_versions(ledger, "calibration_dsm")["version"])
    versions = []
    for day in (dt.date(2024, 5, 2), dt.date(2024, 5, 1)):
        row = {"operator": "AQX", "tail": "LX-AAA", "done_on": day, "pack": 1, "component": "HX", "action": "REPLACED"}
        store.replace("raw_maintenance", [A], TABLES["raw_maintenance"].conform(pl.DataFrame([row])))
        versions.append(set(expected_versions(ledger, "calibration_dsm")["version"]))
    assert versions[0] == before
    assert versions[1] != before


@pytest.mark.parametrize("table", LINEAGE)
def test_every_table_has_a_version(ledger, table):
    frame = expected_versions(ledger, table)
    assert frame.columns == [*CELL, "version"]
    assert frame.select(pl.all().is_not_null().all()).row(0) == (True,) * 4 or frame.is_empty()


def test_delivery_order_changes_no_version(tmp_path):
    one = Ledger(tmp_path / "1")
    two = Ledger(tmp_path / "2")
    files = [("x.csv", "d1"), ("y.csv", "d2")]
    for ledger, order in ((one, files), (two, files[::-1])):
        for name, digest in order:
            deliver(ledger, A, name, ["LX-AAA_20240501_01"], digest)
    assert expected_versions(one, "raw_flights").equals(expected_versions(two, "raw_flights"))


ASSETS = [asset for asset in build_defs(landing=".", home=".").assets if asset.op.name in STAGE]
"""Those that the ledger follows: what is published is read off them after a night."""


@pytest.fixture
def folded_ledger(ledger) -> Ledger:
    """Finer versions are folded for an aircraft, or for the fleet."""
    tables = "calibration_schedules", "legs_indicators", "features_margin", "features", "prognosis_base", "raw_messages"
    make(ledger, *tables, "raw_maintenance")
    assert ledger.cells("features_margin").height == 3
    return ledger


@pytest.mark.parametrize("table", ["twin_health", "prognoses"])
def test_query_order_changes_no_version(folded_ledger, monkeypatch, table):
    """No database promises one."""
    answers = Ledger.lines
    as_asked = expected_versions(folded_ledger, table)

    def turned(self: Ledger, asset: str) -> pl.DataFrame:
        backwards = pl.col("lines").str.split("|").list.reverse().list.join("|")
        return answers(self, asset).with_columns(backwards).reverse()

    monkeypatch.setattr(Ledger, "lines", turned)
    assert expected_versions(folded_ledger, table).sort(CELL).equals(as_asked.sort(CELL))


@pytest.mark.parametrize("table", ["twin_health", "prognoses"])
def test_finer_version_changes_the_coarser(folded_ledger, table):
    before = expected_versions(folded_ledger, table)
    for finer in ("features_margin", "twin_flights"):
        folded_ledger.mark(finer, folded_ledger.cells(finer)[:1].with_columns(version=pl.lit("other")))
    assert not expected_versions(folded_ledger, table).sort(CELL).equals(before.sort(CELL))


@pytest.mark.parametrize("asset", ASSETS, ids=lambda asset: asset.op.name)
def test_version_covers_what_asset_reads(asset):
    """Dagster's graph holds no arrow from a table whose changes the ledger does not follow, and none is missing."""
    stage = STAGE[asset.op.name]
    for key in asset.keys:
        read = {k.path[-1] for k in asset.asset_deps[key]} - set(stage.tables)
        assert read <= upstream_tables(stage)
        assert {MAKER[t].name for t in stage.parents} <= {MAKER[t].name for t in read}


def test_untracked_reading_is_refused():
    def residuals(raw_fleet: pl.DataFrame) -> pl.DataFrame:
        return raw_fleet

    with pytest.raises(ValueError, match="residuals reads raw_fleet"):
        stage(residuals)


@pytest.mark.parametrize(("name", "is_followed"), [("twin_flights", False), ("twin_health", True)])
def test_later_work_renews_tracks_alone(name, is_followed):
    """A shop visit after commissioning leaves flights as they are, and makes the track of its aircraft stale."""
    assert ("raw_maintenance" in upstream_tables(STAGE[name])) is is_followed


def test_limits_make_alerts_stale(ledger):
    deliver(ledger, A, "maintenance.csv", [], "m1", "maintenance")
    parents = "raw_maintenance", "twin_health", "residuals", "calibration_schedules", "features_cross_checks"
    make(ledger, *parents, "features_margin", "features")
    tables = "features", "features_alerts", "twin_health", "prognoses"
    before = {t: expected_versions(ledger, t) for t in tables}
    (ledger.home / "alerts.toml").write_text("fouling = 0.12")
    assert [t for t in tables if not expected_versions(ledger, t).equals(before[t])] == ["features_alerts"]
    (ledger.home / "alerts.toml").write_text("fouling = 0.15")  # the default
    assert all(expected_versions(ledger, t).equals(before[t]) for t in tables)


METHOD_LINES = {
    'HX = { health = "ekf" }': ["twin_flights"],
    'CC = { health = "ekf" }': ["twin_flights"],
    'HX = { design = "ekf" }': ["calibration_dsm"],
    'CAC = { design = "ekf" }': ["calibration_components"],
    'CAC = { health = "ekf" }': ["twin_health"],
    'HX = "nls"': [],
}
"""Line of estimators.toml, and the tables that it makes stale by itself."""


@pytest.mark.parametrize(("line", "stale"), METHOD_LINES.items())
def test_method_makes_stale_what_it_makes(ledger, line, stale):
    tables = ["legs_samples", "calibration_dsm", "twin_flights", "residuals", "calibration_components", "twin_health"]
    deliver(ledger, A, "cac/one.csv", [], "k1", "component")
    make(ledger, "raw_components")
    before = {t: expected_versions(ledger, t) for t in tables}

    (ledger.home / "estimators.toml").write_text(line)

    assert [t for t in tables if not expected_versions(ledger, t).equals(before[t])] == stale
