"""The batched event log writes what stock Dagster writes, so that stock Dagster reads it."""

import gc
import json
import re
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import groupby
from pathlib import Path

import dagster as dg
import pytest
import sqlalchemy
from dagster._core.definitions.partitions.context import partition_loading_context
from databases import SERVER, new_database

from dagster_batched import report_partitions
from dagster_batched.event_log import BatchedSqliteEventLogStorage
from dagster_batched.partitions import valid_keys
from dagster_batched.runs import open_instance, range_tags

KEPT_IN = {
    "sqlite": ("base_dir: {base}/history", "sqlite:///{base}/history/index.db"),
    "postgresql": ("postgres_url: {url}", "{url}"),
}
STOCK = {
    "sqlite": ("dagster._core.storage.event_log", "SqliteEventLogStorage"),
    "postgresql": ("dagster_postgres.event_log", "PostgresEventLogStorage"),
}
OURS = {
    "sqlite": ("dagster_batched.event_log", "BatchedSqliteEventLogStorage"),
    "postgresql": ("dagster_batched.postgres", "BatchedPostgresEventLogStorage"),
}
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
        keys = list(context.asset_partition_keys)
        report_partitions(context, keys, [{"rows": 10 + i} for i, _ in enumerate(keys)])

    def load_input(self, context) -> None:
        """Nothing is stored."""


@dg.asset(partitions_def=both, deps=[first], io_manager_key="one", metadata={"unit": "K"}, code_version="7")
def third(context):
    """Cells that are stored and reported together."""
    context.add_output_metadata({"rows": 6})
    return 0


class Log:
    """Where one contestant's events are kept: the folder of an instance, and the address of its tables."""

    def __init__(self, base: Path, kept_in: str, url: str) -> None:
        base.mkdir()
        settings, tables = KEPT_IN[kept_in]
        self.base = base
        self.kept_in = kept_in
        self.settings = settings.format(base=base, url=url)
        self.tables = sqlalchemy.create_engine(tables.format(base=base, url=url), poolclass=sqlalchemy.NullPool)

    def instance(self, who: dict[str, tuple[str, str]]) -> dg.DagsterInstance:
        """Stock's or ours, over the same tables."""
        module, cls = who[self.kept_in]
        where = {"log": "event_log_storage", "module": module, "class": cls}
        head = "{log}:\n  module: {module}\n  class: {class}\n  config:\n    ".format(**where)
        (self.base / "dagster.yaml").write_text(f"{head}{self.settings}\n")
        instance = dg.DagsterInstance.from_config(str(self.base))
        assert type(instance.event_log_storage).__name__ == cls
        return instance


@pytest.fixture(params=KEPT_IN)
def new_log(request, tmp_path) -> Iterator[Callable[[str], Log]]:
    """Makes an empty log; of PostgreSQL where HDT_TEST_POSTGRES names a server."""
    if request.param == "postgresql" and not SERVER:
        pytest.skip("HDT_TEST_POSTGRES names no PostgreSQL server")
    with ExitStack() as databases:

        def make(name: str) -> Log:
            url = databases.enter_context(new_database()) if request.param == "postgresql" else ""
            return Log(tmp_path / name, request.param, url)

        yield make


def add_cells(instance: dg.DagsterInstance, flights: str = "12") -> None:
    instance.add_dynamic_partitions("aircraft", ["A", "B"])
    instance.add_dynamic_partitions("flight", [*flights])


def tables_after_run(log: Log, who, monkeypatch, batch: str):
    """Tables of the index after one run over 2 x 3 cells."""
    monkeypatch.setenv("DAGSTER_EVENT_BATCH_SIZE", batch)
    # stock plans one event an asset where it is asked to
    monkeypatch.setenv("DAGSTER_EMIT_PARTITION_SUBSET_IN_PLANNED_EVENTS", "1")
    instance = log.instance(who)
    add_cells(instance, "123")
    keeper = {"one": OneStandsForAll()}
    tags = range_tags("A|1", "B|3")
    assert dg.materialize([first, second, third], resources=keeper, instance=instance, tags=tags).success
    records = instance.fetch_materializations(dg.AssetKey("second"), limit=100).records
    instance.dispose()
    return shape(log), sorted(r.partition_key for r in records)


def shape(log: Log):
    """What the tables hold, less what must differ between two runs: ids, times, hashes of the run."""
    queries = {
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
    with log.tables.connect() as con:
        rows = {name: sorted(map(str, con.exec_driver_sql(sql))) for name, sql in queries.items()}
        third = "select event from event_logs where asset_key = '[\"third\"]' and partition is not null"
        events = con.exec_driver_sql(third)
        rows["events"] = sorted(UNLIKE.sub("", bare(text)) for (text,) in events)
    return rows


def bare(event: str) -> str:
    """An event, less what ours tell once a run, and what is null or empty, which ours leave out."""
    record = json.loads(event)
    once = ("logging_tags", "step_handle", "solid_handle", "message", "pid", "step_kind_value")
    record["dagster_event"] = {k: v for k, v in record["dagster_event"].items() if k not in once}
    data = record["dagster_event"]["event_specific_data"]
    data["materialization"]["metadata_entries"] = []
    data["materialization"] = {k: v for k, v in data["materialization"].items() if v}
    record["dagster_event"]["event_specific_data"] = {k: v for k, v in data.items() if v}
    return json.dumps(record)


def test_tables_equal_those_of_stock(new_log, monkeypatch):
    stock, stock_cells = tables_after_run(new_log("stock"), STOCK, monkeypatch, "0")
    log = new_log("ours")
    ours, cells = tables_after_run(log, OURS, monkeypatch, "1000")
    assert ours == stock
    assert cells == stock_cells == sorted(f"{a}|{f}" for a in "AB" for f in "123")
    instance = log.instance(STOCK)  # which reads what the batch wrote
    for name in ("first", "third"):
        assert len(instance.get_materialized_partitions(dg.AssetKey(name))) == 6
    newest = {r.partition_key: r for r in instance.fetch_materializations(dg.AssetKey("third"), limit=100).records}
    flights = {p: r.asset_materialization.tags["dagster/partition/flight"] for p, r in newest.items()}
    assert flights == {f"{a}|{f}": f for a in "AB" for f in "123"}
    values = [r.asset_materialization.metadata["rows"].value for r in newest.values()]
    assert sorted(values) == [10, 11, 12, 13, 14, 15]  # each its own, the first too
    assert len({round(1000 * r.timestamp) for r in newest.values()}) == 6, "a page tells events by their milliseconds"
    instance.dispose()


def test_valid_keys_equal_stocks():
    """Of cells that are there, of others, and of texts that are no cells; each key tells its parts by dimension."""
    stock_filter = dg.MultiPartitionsDefinition.filter_valid_partition_keys
    stock_keys = getattr(stock_filter, "__wrapped__", stock_filter)  # another test may have opened an instance of ours
    candidates = {"A|1", "B|2", "C|1", "A|9", "A", "A|1|2", ""}
    with dg.DagsterInstance.ephemeral() as instance, partition_loading_context(dynamic_partitions_store=instance):
        add_cells(instance)
        for some in (candidates, {"C|1"}, {"A"}, set()):
            ours = valid_keys(both, some)
            stock = stock_keys(both, some)
            parts = {key: both.get_partition_key_from_str(key).keys_by_dimension for key in stock}  # 1.12 finds texts
            assert {key: key.keys_by_dimension for key in ours} == parts
            assert {type(key) for key in ours} <= {dg.MultiPartitionKey}
        assert valid_keys(both, candidates) == {"A|1", "B|2"}


@dg.asset(partitions_def=both)
def sound() -> None:
    """Cells that are made before the run fails."""


@dg.asset(partitions_def=both, deps=[sound])
def broken() -> None:
    """Cells that are not."""
    raise ValueError("no")


@pytest.fixture
def large_batches(monkeypatch) -> None:
    monkeypatch.setenv("DAGSTER_EVENT_BATCH_SIZE", "1000")


@pytest.mark.usefixtures("large_batches")
def test_failed_cells_show_like_stocks(new_log):
    """Stock plans cell by cell; ours only where the run failed, and then what was not made."""
    cells = [dg.MultiPartitionKey({"aircraft": a, "flight": f}) for a in "AB" for f in "12"]
    attempts = []
    tags = range_tags("A|1", "B|2")
    for who in (STOCK, OURS):
        with new_log(f"log{len(attempts)}").instance(who) as instance:
            add_cells(instance)
            done = dg.materialize([sound, broken], instance=instance, tags=tags, raise_on_error=False)
            log = instance.event_log_storage
            if who is OURS:
                log.mark_failed_partitions(done.run_id, cells)
            in_vain = log.get_latest_asset_partition_materialization_attempts_without_materializations
            vain = [in_vain(dg.AssetKey(name)).items() for name in ("sound", "broken")]
            attempts.append([{cell: run_id == done.run_id for cell, (run_id, _) in cells_of} for cells_of in vain])
    stock, ours = attempts
    assert ours == stock == [{}, dict.fromkeys(cells, True)]


@dg.asset(partitions_def=both)
def fickle(context) -> None:
    """Cells of aircraft A, and none of others."""
    if not context.partition_key.startswith("A"):
        raise ValueError("no")


@pytest.mark.parametrize("named", [1, 2, 30_000])
def test_vain_cells_equal_stocks(new_log, monkeypatch, named):
    """After any event: cells that failed, were made, made and then failed, failed and then made, or wiped."""
    monkeypatch.setattr("dagster_batched.event_log._MAX_VALUES", named)
    log = new_log("log")
    in_vain = "get_latest_asset_partition_materialization_attempts_without_materializations"
    with log.instance(STOCK) as instance:
        add_cells(instance)
        for cell in ("A|1", "B|1", "B|2", "B|1"):
            for assets in ([fickle], [sound]):
                dg.materialize(assets, instance=instance, tags=range_tags(cell, cell), raise_on_error=False)
        instance.report_runless_asset_event(dg.AssetMaterialization("fickle", partition="B|2"))
        with log.tables.connect() as con:
            newest = int(con.exec_driver_sql("select max(id) from event_logs").scalar())
    attempts = []
    for who in (STOCK, OURS):
        with log.instance(who) as instance:
            ask = getattr(instance.event_log_storage, in_vain)
            calls = ((dg.AssetKey(name), after) for name in ("fickle", "sound") for after in (None, *range(newest + 1)))
            attempts.append([ask(key, after) for key, after in calls])
            if who is OURS:
                instance.wipe_assets([dg.AssetKey("fickle")])
                assert ask(dg.AssetKey("fickle")) == {}
    stock, ours = attempts
    assert ours == stock
    assert set(stock[0]) == {"B|1"}


@pytest.mark.parametrize("assets", [[first, second, third], [sound, broken]])
@pytest.mark.usefixtures("large_batches")
def test_run_page_equals_stocks(new_log, assets, monkeypatch):
    """In stock's order, where events that only tell how far a step is are written with the next; a line an asset."""
    monkeypatch.setenv("DAGSTER_EMIT_PARTITION_SUBSET_IN_PLANNED_EVENTS", "1")
    tags = range_tags("A|1", "B|2")
    pages = []
    for who in (STOCK, OURS):
        with new_log(f"log{len(pages)}").instance(who) as instance:
            add_cells(instance)
            keeper = {"one": OneStandsForAll()}
            done = dg.materialize(assets, resources=keeper, instance=instance, tags=tags, raise_on_error=False)
            lines = [(e.dagster_event_type, e.step_key) for e in instance.all_logs(done.run_id) if e.is_dagster_event]
            pages.append([line for line, _ in groupby(lines)])
    stock, ours = pages
    assert ours == stock
    assert len(ours) > 10


@pytest.mark.usefixtures("large_batches")
def test_every_shard_equals_stocks(tmp_path):
    """The first makes its own, those after it are copies: same schema and journal, and nothing of another run."""

    def shards(name: str, who) -> list[tuple]:
        log = Log(tmp_path / name, "sqlite", "")
        with log.instance(who) as instance:
            runs = [dg.materialize([plain], instance=instance).run_id for _ in range(3)]
        history = log.base / "history"
        assert {f.stem for f in history.glob("*.db")} >= {*runs, "index"}
        assert not list(history.glob(".*"))
        return [read_shard(history / f"{run_id}.db", run_id) for run_id in runs]

    def read_shard(shard: Path, run_id: str) -> tuple:
        with closing(sqlite3.connect(shard)) as con:
            assert con.execute("select distinct run_id from event_logs").fetchall() == [(run_id,)]
            queries = ("select name, sql from sqlite_master order by 1", "select * from alembic_version")
            return *(con.execute(sql).fetchall() for sql in queries), con.execute("pragma journal_mode").fetchone()

    ours = shards("ours", OURS)
    stock = shards("stock", STOCK)
    assert ours == stock
    assert len(set(map(str, ours))) == 1


@dg.asset(check_specs=[dg.AssetCheckSpec("fine", asset="shared")])
def shared(context):
    """An asset that another run makes meanwhile."""
    if not context.run.tags.get("meanwhile"):
        assert dg.materialize([shared], instance=context.instance, tags={"meanwhile": "yes"}).success
    return dg.MaterializeResult(check_results=[dg.AssetCheckResult(passed=True, check_name="fine")])


@pytest.mark.usefixtures("large_batches")
def test_parallel_runs_keep_last_check(new_log):
    """Or else a page says that nothing was checked: it takes the last that was planned."""
    with new_log("ours").instance(OURS) as instance:
        done = dg.materialize([shared], instance=instance)
        key = dg.AssetCheckKey(dg.AssetKey("shared"), "fine")
        records = instance.event_log_storage.get_asset_check_execution_history(key, limit=9)
        assert instance.get_latest_materialization_event(key.asset_key).run_id == done.run_id
    assert [r.run_id == done.run_id for r in records] == [True, False]
    assert {r.status.value for r in records} == {"SUCCEEDED"}


@dg.asset
def plain() -> None:
    """No partition."""


@pytest.mark.parametrize("present", [(), ("event_logs", "secondary_indexes")])
def test_half_made_index_is_completed(tmp_path, present):
    log = Log(tmp_path / "log", "sqlite", "")
    log.instance(OURS).dispose()
    with closing(sqlite3.connect(log.base / "history/index.db")) as con:
        tables = [name for (name,) in con.execute("select name from sqlite_master where type = 'table'")]
        assert {*present, "dynamic_partitions", "alembic_version"} <= {*tables}
        for name in {*tables} - {*present}:
            con.execute(f"drop table {name}")
        if present:
            con.execute("delete from secondary_indexes")
        con.commit()
    with log.instance(OURS) as instance:
        instance.add_dynamic_partitions("aircraft", ["A"])
        assert instance.get_dynamic_partitions("aircraft") == ["A"]
        assert dg.materialize([plain], instance=instance).success
        assert instance.get_latest_materialization_event(dg.AssetKey("plain"))


@pytest.fixture
def settings(tmp_path) -> Path:
    return tmp_path / "dagster.yaml"


@pytest.mark.parametrize("before", ["", "# ours: of a home that was moved"])
def test_settings_are_never_half_written(settings, before):
    """Worker processes open the instance side by side; one that read an empty file had stock's event log, and a night
    that takes seconds took an hour."""
    settings.write_text(before)
    with settings.open() as other_process, open_instance(settings.parent, "# ours", "made here") as instance:
        assert type(instance.event_log_storage).__name__ == "BatchedSqliteEventLogStorage"
        assert other_process.read() == before  # replaced, never emptied


def test_settings_are_written_once(settings):
    open_instance(settings.parent, "# ours", "made here").dispose()
    written = settings.stat()
    open_instance(settings.parent, "# ours", "made here").dispose()
    assert (settings.stat().st_ino, settings.stat().st_mtime_ns) == (written.st_ino, written.st_mtime_ns)


def test_settings_by_others_stay(settings):
    settings.write_text("telemetry: {enabled: false}")
    open_instance(settings.parent, "# ours", "made here").dispose()
    assert settings.read_text() == "telemetry: {enabled: false}"
    assert [p.name for p in settings.parent.glob("*dagster.yaml*")] == ["dagster.yaml"]


def test_forgotten_log_closes_its_files(tmp_path):
    """From Python 3.13 on a connection that the collector finds open is a warning."""
    log = BatchedSqliteEventLogStorage(str(tmp_path))
    engine = log._engine("index")
    with engine.connect():
        pass
    assert engine.pool.checkedin() > 0
    del log
    gc.collect()
    assert engine.pool.checkedin() == 0
