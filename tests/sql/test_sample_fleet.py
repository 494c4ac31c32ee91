"""Views and checks over the sample fleet: each is a question with a grain, and each check finds its planted fault."""

import datetime as dt
import re
from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest
from answers import CHECKS, rows

from docs.dictionary import dictionary, view_columns
from hdt_core.tables import TABLES
from pipelines.storage.catalog import CATALOG
from pipelines.storage.catalog_views import list_diagnoses
from pipelines.storage.view_headers import read_header, views

ROOT = Path(__file__).parents[2]


# --- how the files are written -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", views())
def test_view_header_names_grain_sources(name):
    """And asks a question."""
    sql = views()[name]
    header = read_header(sql)
    assert header.question.endswith("?") or "? " in header.question
    assert header.grain
    assert f"create or replace view {name} as" in sql
    body = "\n".join(line for line in sql.splitlines() if not line.startswith("--"))
    read = set(re.findall(r"(?<!distinct )\b(?:from|join) (tables\.\w+|\w+)", body))
    assert read - set(re.findall(r"(\w+) as \(\n", body)) == set(header.sources)


@pytest.mark.parametrize("name", CHECKS)
def test_check_header_names_its_fault(name):
    header = [line for line in CHECKS[name].splitlines() if line.startswith("--")]
    assert header[0].endswith(("?", "is missing is NULL.", "twin)")) or "? " in header[0]
    assert any(line.startswith("-- A fault: ") for line in header)


def test_every_column_has_meaning():
    named = [(view, *column) for view, columns in view_columns().items() for column in columns]
    assert [f"{view}.{name}" for view, name, _, meaning in named if not meaning] == []


def test_dictionary_is_up_to_date():
    written = (ROOT / "docs/data-dictionary.md").read_text(encoding="utf-8")
    assert written == dictionary(), "run `python -m docs.dictionary docs/data-dictionary.md`"


@pytest.mark.parametrize(
    "silent",
    [
        "select view_name from duckdb_views() where not internal and schema_name = 'main' and comment is null",
        "select table_name, column_name from duckdb_columns() where not internal and coalesce(comment, '') = ''",
    ],
    ids=["views", "columns"],
)
def test_catalog_comments_everything(sample, silent):
    assert rows(sample, silent) == []


def test_features_are_stored_as_declared(sample):
    columns = {name for name, *_ in rows(sample, "describe tables.features")}
    assert columns == set(TABLES["features"].schema.columns())
    assert [c for c in columns if rows(sample, f"select count({c}) from features") == [(0,)]] == []


# --- the sample fleet ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sample(sample_home: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    with duckdb.connect(str(sample_home / CATALOG), read_only=True) as con:
        con.execute("set TimeZone = 'Pacific/Kiritimati'")  # 14 hours from UTC: no view may depend on where it is read
        yield con


@pytest.mark.parametrize("name", [v for v in views() if v != "quarantine"])  # a list of things refused: no key
def test_view_keeps_its_grain(sample, name):
    key = re.sub(r"\(.*?\)|, of .*", "", read_header(views()[name]).grain).split(", ")
    named = {"flight": "operator, tail, flight_id", "alert": "alert_id"}
    key = ", ".join(named.get(k.strip(), k.strip()) for k in key)
    if "pack" in key and "operator" not in key:
        key += ", operator, tail"
    assert rows(sample, f"select {key}, count(*) from {name} group by {key} having count(*) > 1") == []


@pytest.mark.parametrize("name", CHECKS)
def test_sample_fleet_has_no_fault(sample, name):
    assert rows(sample, CHECKS[name])[:5] == []


def test_as_of_knows_nothing_later(sample):
    """The view against the plain question, asked of every seventh day: nothing later, nothing older than the last."""
    as_of = rows(sample, "select on_date, tail, pack, departed_at, hx_fouling from as_of where day(on_date) % 7 = 0")
    assert len(as_of) > 50
    sample.execute("set TimeZone = 'UTC'")
    for on_date, tail, pack, departed_at, fouling in as_of[::5]:
        last = rows(
            sample,
            f"""select max(departed_at), arg_max(value, departed_at) from health_parameters
            where parameter = 'hx_fouling' and tail = '{tail}' and pack = {pack}
            and departed_at < '{on_date + dt.timedelta(days=1)} 00:00:00+00'""",
        )
        assert [(departed_at, fouling)] == last
    sample.execute("set TimeZone = 'Pacific/Kiritimati'")


def day_of(flight_id: str) -> str:
    """The day in a flight's name, as SQL."""
    return f"strptime(regexp_extract({flight_id}, '_(\\d{{8}})_', 1), '%Y%m%d')::date"


@pytest.mark.parametrize("view", ["flights", "legs", "features", "health_parameters", "prognoses"])
def test_departure_day_follows_flight_name(sample, view):
    """Wherever it is read: in this time zone the other day shifts."""
    named = day_of("flight_id")
    assert rows(sample, f"select count(*) > 0 from {view}") == [(True,)]
    assert rows(sample, f"select count(*) from {view} where departed_on is distinct from {named}") == [(0,)]
    assert rows(sample, f"select count(*) from {view} where departed_at::date is distinct from {named}") != [(0,)]


def test_alert_day_follows_flight_name(sample):
    named = day_of("raised_flight_id")
    assert rows(sample, f"select count(*) from alerts where raised_on is distinct from {named}") == [(0,)]


@pytest.mark.parametrize(
    ("counted", "of"),
    [
        (
            "sum(n_legs)::int, sum(n_admitted)::int from filter_yield",
            "count(*)::int, count_if(admitted)::int from legs",
        ),
        ("sum(n_fouled)::int from filter_yield", "count(*)::int from legs where reason = 'HX_WORN'"),
        (
            "sum(n_flights)::int from exchanger_lives",
            "count(*)::int from health_parameters where parameter = 'hx_fouling' and value is not null",
        ),
    ],
    ids=["legs", "worn legs", "flights of lives"],
)
def test_every_row_is_counted_once(sample, counted, of):
    answer = rows(sample, f"select {of}")
    assert rows(sample, f"select {counted}") == answer
    assert answer[0][0] > 0


# --- planted faults ------------------------------------------------------------------------------------------------

FAULTS = {
    "alerts_in_disorder": [
        "update alerts set closed_at = raised_at - interval 1 day",
        "update alerts set raised_flight_id = 'ZZ_20240101_01'",
        "update alerts set evidence = ''",
        "update alerts set diagnosis = 'GREMLINS'",
    ],
    "design_without_value": ["update design_parameters set value = null", "update design_parameters set sd = -1"],
    "estimates_without_doubt": [
        "update health_parameters set sd = null where value is not null",
        "update health_parameters set status = ''",
        "update health_parameters set value = 1, sd = 1 where status = 'not_identifiable'",
    ],
    "flights_out_of_time": [
        "update flights set landed_at = departed_at - interval 1 hour",
        "update flights set departed_at = departed_at + interval 3 day, landed_at = landed_at + interval 4 day",
        "update flights set tail = 'XX'",
    ],
    "flights_without_legs": [
        "delete from legs where flight_id = (select min(flight_id) from legs)",
        "delete from flights where flight_id = (select min(flight_id) from flights)",
    ],
    "grain_not_kept": [
        f"insert into {v} select * from {v} limit 1"
        for v in (
            "flights",
            "legs",
            "health_parameters",
            "residuals",
            "features",
            "prognoses",
            "alerts",
            "deliveries",
            "design_parameters",
        )
    ],
    "keys_without_value": [
        "update flights set tail = null", "update legs set reason = null", "update prognoses set split = null",
        "update alerts set alert_id = null", "update features set departed_at = null",
    ],
    "legs_without_health": [
        "delete from features where flight_id = (select min(flight_id) from features)",
        "delete from prognoses where flight_id = (select max(flight_id) from prognoses)",
        "insert into residuals select * replace ('ZZ_20240101_01' as flight_id) from residuals limit 1",
    ],
    "legs_without_reason": [
        "update legs set reason = '' where not admitted",
        "update legs set n_nominal = n_samples + 1",
        "update legs set admitted = true",
    ],
    "not_a_number": [
        "update health_parameters set value = 'nan'",
        "update features set hx_fouling = 'nan'",
        "update residuals set rms = 'inf'",
        "update prognoses set rul_high = '-inf'",
    ],
    "prognoses_out_of_order": [
        "update prognoses set rul_low = rul_high + 1",
        "update prognoses set p_event_50 = 1.5",
        "update prognoses set rul_high = null",
        "update prognoses set split = 'in_sample'",
    ],
    "quarantine_not_counted": [
        "insert into quarantine (file, reason, n_rows) values ('a.csv', 'bad_row', 1)",
        "insert into deliveries values ('a.csv', 1, 0, 1, 0)",
    ],
    "residuals_that_do_not_close": ["update residuals set mean = mean + 1 where kind = 'dsm_minus_twin'"],
    "rows_lost": ["update deliveries set loaded = loaded - 1", "update deliveries set duplicate = duplicate + 1"],
}  # fmt: skip


@pytest.fixture(scope="module")
def copied(sample) -> Iterator[duckdb.DuckDBPyConnection]:
    """One aircraft's catalog as tables that can be spoilt."""
    con = duckdb.connect()
    for view in (*("flights", "legs", "health_parameters", "residuals", "features", "prognoses", "alerts"),
                 *("component_legs", "deliveries", "quarantine", "design_parameters")):  # fmt: skip
        tail = "" if view in {"deliveries", "quarantine", "design_parameters"} else " where tail = 'A9-BAC'"
        frame = sample.sql(f"select * from {view}{tail}").to_arrow_table()
        con.execute(f"create table {view} as select * from frame")
    frame = sample.sql("select * from tables.components").to_arrow_table()  # noqa: F841
    con.execute("create schema tables")
    con.execute("create table tables.components as select * from frame")
    list_diagnoses(con)
    yield con
    con.close()


def test_every_check_has_planted_faults():
    assert set(FAULTS) == set(CHECKS)


@pytest.mark.parametrize(("name", "fault"), [(n, f) for n, faults in FAULTS.items() for f in faults])
def test_planted_fault_is_detected(copied, name, fault):
    copied.execute("begin")
    try:
        assert rows(copied, CHECKS[name]) == []
        copied.execute(fault)
        assert rows(copied, CHECKS[name]) != []
    finally:
        copied.execute("rollback")
