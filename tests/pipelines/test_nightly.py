"""One night after another: idle, one flight more, files late or twice or broken, an aircraft or a hook that fails."""

import shutil
from importlib.metadata import EntryPoint

import dagster as dg
import polars as pl
from answers import query
from nights import keep_base, run
from soundness import faults

from pipelines.assets import raw as raw_assets
from pipelines.orchestration import around_night
from pipelines.orchestration.runs import open_instance
from pipelines.storage.store import Store

COMPARED = (
    "raw_snapshots",
    "raw_flights",
    "legs_samples",
    "calibration_dsm",
    "twin_flights",
    "twin_health",
    "features",
    "prognoses",
)


def made_since(home, asset: str, since: float) -> set[str]:
    """Partitions of an asset materialised after `since`."""
    records = dg.AssetRecordsFilter(dg.AssetKey(asset), after_timestamp=since)
    with open_instance(home) as instance:
        return {r.partition_key for r in instance.fetch_materializations(records, limit=10_000).records}


def last_time(home) -> float:
    with open_instance(home) as instance:
        return max(r.timestamp for r in instance.fetch_materializations(dg.AssetKey("prognoses"), limit=1).records)


def tables(home) -> dict[str, pl.DataFrame]:
    frames = {t: Store(home).read_table(t) for t in COMPARED}
    return {t: f.sort([c for c in f.columns if f[c].dtype != pl.Binary]) for t, f in frames.items()}


def test_night_without_content_makes_nothing(own_home):
    landing, home = own_home
    before = last_time(home)
    first = run(landing, home)
    assert (first.idle, first.new_files) == (True, 0)
    next(landing.glob("*/*/acms/*.csv")).touch()
    assert run(landing, home).idle
    assert not made_since(home, "raw_flights", before)


def test_new_flight_makes_itself_alone(own_home):
    landing, home = own_home
    newest = max((landing / "AQX/LX-AAB/acms").glob("*.csv"))
    text = newest.read_text()
    flight = newest.stem[:-2] + "99"
    newest.with_name(f"{flight}.csv").write_text(text.replace(newest.stem, flight))
    before = last_time(home)
    night = run(landing, home)
    assert not night.failed
    cell = f"AQX:LX-AAB|{flight[-11:]}"
    for asset in ("raw_snapshots", "raw_flights", "legs_samples", "legs_verdicts", "twin_flights", "residuals"):
        assert made_since(home, asset, before) == {cell}, asset
    for asset in ("twin_health", "features", "features_alerts"):
        assert made_since(home, asset, before) == {"AQX:LX-AAB"}, asset
    assert not made_since(home, "calibration_dsm", before), "a flight after commissioning recalibrates no model"


def test_refused_file_changes_no_model(own_home):
    landing, home = own_home
    (landing / "AQX/LX-AAB/acms/LX-AAB_20230105_01.csv").write_text("no report of a flight\n")
    before = last_time(home)

    run(landing, home)

    assert not made_since(home, "calibration_dsm", before)


def test_disorderly_delivery_ends_clean(sample_landing, sample_home, tmp_path):
    """Three nights: first the newest files, then some of them again and the logs, at last the old history."""
    landing = tmp_path / "landing"
    home = tmp_path / "home"
    shutil.copytree(sample_landing, landing, ignore=shutil.ignore_patterns("history_*", "maintenance.csv", "cpl"))
    keep_base(sample_home, home)
    assert not run(landing, home).failed
    for csv in sorted(landing.glob("*/*/acms/*.csv"))[:20]:
        shutil.copy(csv, csv.with_name(csv.stem + " (1).csv"))
    for log in sample_landing.glob("*/*/maintenance.csv"):
        shutil.copy(log, landing / log.relative_to(sample_landing))
    assert not run(landing, home).failed
    for late in (*sample_landing.glob("*/*/cpl/*"), *sample_landing.glob("*/*/acms/history_*")):
        target = landing / late.relative_to(sample_landing)
        target.parent.mkdir(exist_ok=True)
        shutil.copy(late, target)
    assert not run(landing, home).failed
    clean = tables(sample_home)
    late_frames = tables(home)
    for name in COMPARED:
        ours = clean[name].drop("file", strict=False)
        theirs = late_frames[name].drop("file", strict=False)
        assert ours.equals(theirs), name


HISTORY = ("raw_messages", "raw_maintenance", "features_work", "features_alerts", "prognoses")


def test_logs_of_last_day_erase_no_history(own_home):
    """Every log cut to its last line."""
    landing, home = own_home
    before = {table: Store(home).read_table(table) for table in HISTORY}
    cut = set()
    for log in landing.glob("*/*/*.csv"):
        head, *lines = sorted(log.read_text().splitlines(keepends=True), reverse=True)
        log.write_text(head + "".join(lines[:1]))
        cut |= {str(log.relative_to(landing))} if len(lines) > 1 else set()

    assert not run(landing, home).failed

    assert [table for table in HISTORY if not Store(home).read_table(table).equals(before[table])] == []
    notes = query(home, "select file from quarantine where reason = 'fewer_lines'")
    assert {file for (file,) in notes} == cut != set()
    assert faults(home, landing) == []


def test_failed_aircraft_stops_no_other(own_home, monkeypatch):
    landing, home = own_home
    real = raw_assets.ingest_flights
    added = []
    for name in ("AQX/LX-AAB", "BZR/A9-BAC"):
        last = max((landing / name / "acms").glob("*.csv"))
        flight = last.stem[:-2] + "97"
        last.with_name(f"{flight}.csv").write_text(last.read_text().replace(last.stem, flight))
        added.append(flight)

    def sick(landing, store, ledger, aircraft, flights):
        if aircraft == ("AQX", "LX-AAB"):
            raise RuntimeError("disk on fire")
        return real(landing, store, ledger, aircraft, flights)

    monkeypatch.setattr(raw_assets, "ingest_flights", sick)
    night = run(landing, home)
    assert list(night.failed) == ["flights: AQX:LX-AAB"]
    assert "disk on fire" in next(iter(night.failed.values()))
    stored = f"select flight_id from tables.raw_flights where flight_id in {tuple(added)}"
    assert query(home, stored) == [(added[1],)]
    monkeypatch.undo()
    assert not run(landing, home).failed
    assert sorted(query(home, stored)) == sorted((flight,) for flight in added)


def test_failed_hook_stops_no_other(monkeypatch, tmp_path):
    values = {"c": "posixpath:exists_not", "b": "posixpath:islink", "a": "no_such_module:f", "d": ""}
    points = [EntryPoint(name, value, "hdt.after_night") for name, value in values.items()]
    monkeypatch.setattr(around_night, "entry_points", lambda group: points)
    load = EntryPoint.load
    monkeypatch.setattr(EntryPoint, "load", lambda p: (lambda home: {"home": home.name}) if p.name == "d" else load(p))
    result, failed = around_night.call_hooks(tmp_path)
    assert result == {"home": tmp_path.name}
    assert [line[:2] for line in failed] == ["a:", "b:", "c:"]
    assert "no_such_module" in failed[0]
