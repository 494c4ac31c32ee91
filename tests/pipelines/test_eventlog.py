"""The batched event log writes what stock Dagster writes, so that stock Dagster reads it."""

import re
import sqlite3

import dagster as dg
from dagster._core.definitions.partitions.subset import DefaultPartitionsSubset

CONFIG = """
event_log_storage:
  module: {module}
  class: {cls}
  config:
    base_dir: {base}/history
"""
STOCK = ("dagster._core.storage.event_log", "SqliteEventLogStorage")
OURS = ("pipelines.eventlog", "BatchedSqliteEventLogStorage")
TABLES = ("event_logs", "asset_keys", "asset_event_tags", "asset_check_executions", "dynamic_partitions")
UNLIKE = re.compile(r'"(timestamp|pid)": [\d.]+|"run_id": "[^"]+"|event_pointer/\w+": "\d+"|_version[/\w]*": "\w{64}"')

aircraft = dg.DynamicPartitionsDefinition(name="aircraft")
flights = dg.DynamicPartitionsDefinition(name="flight")
both = dg.MultiPartitionsDefinition({"aircraft": aircraft, "flight": flights})


@dg.asset(partitions_def=both)
def first() -> None:
    """A cell."""


@dg.asset(partitions_def=both, deps=[first], check_specs=[dg.AssetCheckSpec("fine", asset="second")])
def second():
    """A cell that follows, with a check: planned checks come in the same batch as planned cells."""
    return dg.MaterializeResult(check_results=[dg.AssetCheckResult(passed=True, check_name="fine")])


class OneStandsForAll(dg.IOManager):
    """Reports one cell for all where the log can, as the pipeline's own IO manager does."""

    def handle_output(self, context, obj) -> None:
        log = context.step_context.instance.event_log_storage
        if hasattr(log, "stands_for"):
            keys = list(context.asset_partition_keys)
            log.stands_for(context.run_id, context.asset_key, keys)
            context._asset_partitions_subset = DefaultPartitionsSubset({keys[0]})

    def load_input(self, context) -> None:
        """Nothing is stored."""


@dg.asset(partitions_def=both, deps=[first], io_manager_key="one", metadata={"unit": "K"}, code_version="7")
def third(context):
    """Cells that are stored and reported together."""
    context.add_output_metadata({"rows": 6})
    return 0


def ran(base, module, cls, monkeypatch, batch: str):
    """Tables of the index shard after one run over 2 x 3 cells."""
    base.mkdir()
    (base / "dagster.yaml").write_text(CONFIG.format(module=module, cls=cls, base=base))
    monkeypatch.setenv("DAGSTER_EVENT_BATCH_SIZE", batch)
    # stock plans one event an asset where it is asked to
    monkeypatch.setenv("DAGSTER_EMIT_PARTITION_SUBSET_IN_PLANNED_EVENTS", "1")
    instance = dg.DagsterInstance.from_config(str(base))
    instance.add_dynamic_partitions("aircraft", ["A", "B"])
    instance.add_dynamic_partitions("flight", ["1", "2", "3"])
    tags = {"dagster/asset_partition_range_start": "A|1", "dagster/asset_partition_range_end": "B|3"}
    assets, keeper = [first, second, third], {"one": OneStandsForAll()}
    done = dg.materialize(assets, resources=keeper, instance=instance, tags=tags)
    assert done.success
    assert type(instance.event_log_storage).__name__ == cls
    records = instance.fetch_materializations(dg.AssetKey("second"), limit=100).records
    instance.dispose()
    return shape(base / "history/index.db"), sorted(r.partition_key for r in records)


def shape(path):
    """What the tables hold, less what must differ between two runs: ids, times, hashes of the run."""
    con = sqlite3.connect(path)
    asked = {
        "event_logs": "select dagster_event_type, step_key, asset_key, partition, count(*) from event_logs"
        " group by 1, 2, 3, 4",
        "asset_keys": "select asset_key, last_materialization is not null, last_run_id is not null, wipe_timestamp"
        " from asset_keys",
        "asset_event_tags": "select asset_key, key, count(*), count(distinct event_id) from asset_event_tags"
        " group by 1, 2",
        "asset_check_executions": "select asset_key, check_name, partition, execution_status, count(*)"
        " from asset_check_executions group by 1, 2, 3, 4",
        "dynamic_partitions": "select partitions_def_name, partition from dynamic_partitions",
    }
    found = {name: sorted(map(str, con.execute(sql).fetchall())) for name, sql in asked.items()}
    events = con.execute("select event from event_logs where asset_key = '[\"third\"]' and partition is not null")
    found["events"] = sorted(UNLIKE.sub("", text) for (text,) in events)
    con.close()
    return found


def test_tables_equal_those_of_stock_dagster(tmp_path, monkeypatch):
    stock, said_by_stock = ran(tmp_path / "stock", *STOCK, monkeypatch, "0")
    ours, said_by_ours = ran(tmp_path / "ours", *OURS, monkeypatch, "1000")
    assert ours == stock
    assert said_by_ours == said_by_stock == sorted(f"{a}|{f}" for a in "AB" for f in "123")


def test_stock_dagster_reads_what_the_batch_wrote(tmp_path, monkeypatch):
    ran(tmp_path / "ours", *OURS, monkeypatch, "1000")
    (tmp_path / "ours/dagster.yaml").write_text(CONFIG.format(module=STOCK[0], cls=STOCK[1], base=tmp_path / "ours"))
    instance = dg.DagsterInstance.from_config(str(tmp_path / "ours"))
    for name in ("first", "third"):
        assert len(instance.get_materialized_partitions(dg.AssetKey(name))) == 6
    newest = {r.partition_key: r for r in instance.fetch_materializations(dg.AssetKey("third"), limit=100).records}
    assert {p: r.asset_materialization.tags["dagster/partition/flight"] for p, r in newest.items()} == {
        f"{a}|{f}": f for a in "AB" for f in "123"
    }
    assert {r.asset_materialization.metadata["rows"].value for r in newest.values()} == {6}
    instance.dispose()


@dg.asset(partitions_def=both)
def sound() -> None:
    """Cells that are made before the run fails."""


@dg.asset(partitions_def=both, deps=[sound])
def broken() -> None:
    """Cells that are not."""
    raise ValueError("no")


def test_cells_of_a_failed_run_show_as_stock_shows_them(tmp_path, monkeypatch):
    """Stock plans cell by cell; ours only where the run failed, and then what was not made."""
    monkeypatch.setenv("DAGSTER_EVENT_BATCH_SIZE", "1000")
    cells, found = [dg.MultiPartitionKey({"aircraft": a, "flight": f}) for a in "AB" for f in "12"], {}
    tags = {"dagster/asset_partition_range_start": "A|1", "dagster/asset_partition_range_end": "B|2"}
    for module, cls in (STOCK, OURS):
        base = tmp_path / cls
        base.mkdir()
        (base / "dagster.yaml").write_text(CONFIG.format(module=module, cls=cls, base=base))
        with dg.DagsterInstance.from_config(str(base)) as instance:
            instance.add_dynamic_partitions("aircraft", ["A", "B"])
            instance.add_dynamic_partitions("flight", ["1", "2"])
            done = dg.materialize([sound, broken], instance=instance, tags=tags, raise_on_error=False)
            log = instance.event_log_storage
            if cls == OURS[1]:
                log.planned_in_vain(done.run_id, cells)
            in_vain = log.get_latest_asset_partition_materialization_attempts_without_materializations
            found[cls] = {
                name: {cell: run_id == done.run_id for cell, (run_id, _) in in_vain(dg.AssetKey(name)).items()}
                for name in ("sound", "broken")
            }
    assert found[OURS[1]] == found[STOCK[1]] == {"sound": {}, "broken": dict.fromkeys(cells, True)}
