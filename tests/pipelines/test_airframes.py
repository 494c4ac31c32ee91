"""The history of an airframe goes on under another operator and tail, and begins anew under a tail used again."""

import shutil
from pathlib import Path

import duckdb
import polars as pl
import pytest
from nights import keep_base, run
from polars.testing import assert_frame_equal
from small_catalog import alert
from zones import Zone, simulated

from hdt_core.tables import TABLES
from pipelines.casework import change_case, find_case
from pipelines.report.explain import explain
from pipelines.sharing import access_scope, export
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.publication import publish
from pipelines.storage.store import Store

FIRST = ("AQX", "LX-AAC")
ANEW = ("AQX", "LX-ZZC")
LEASED = ("BZR", "LX-AAC")
LINES = "operator,tail,msn,valid_from,valid_to,delivered_on,packs\n"
COMPARED = ("raw_flights", "legs_verdicts", "twin_health", "features", "features_alerts", "raw_messages")
N_FLIGHTS = 30
N_FIRST = 18


def names(zone: Zone, operator: str, tail: str) -> Zone:
    """The same flights under another operator and tail."""
    rename = pl.col("flight_id").str.replace(f"^{zone.tail}_", f"{tail}_")
    messages = zone.messages if zone.messages is None else zone.messages.with_columns(rename)
    return Zone(operator, tail, zone.snapshots.with_columns(rename), {}, messages, zone.maintenance, zone.fleet)


def deliver(landing: Path, second: tuple[str, str] = FIRST) -> None:
    """One airframe's flights, the last of them under a second name."""
    zone = simulated(5, N_FLIGHTS, operator=FIRST[0], tail=FIRST[1])
    zone.maintenance = None
    first = zone.only(zone.flights[:N_FIRST])
    last = names(zone.only(zone.flights[N_FIRST:]), *second)
    first.messages = last.messages = None
    first.drop_csv(landing)
    last.drop_csv(landing)


def fleet(landing: Path, *lines: str) -> None:
    (landing / "fleet.csv").write_text(LINES + "\n".join(lines) + "\n")


def line(folder: tuple[str, str], msn: str = "40002", since: str = "", until: str = "") -> str:
    return f"{folder[0]},{folder[1]},{msn},{since},{until},2019-06-01,2"


def tables(home: Path) -> dict[str, pl.DataFrame]:
    """Rows by the airframe's key, without what names a flight by its registration."""
    frames = {name: Store(home).read_table(name) for name in COMPARED}
    ids = pl.col("^.*flight_id$").str.slice(-11)
    return {name: frame.drop("alert_id", "file", strict=False).with_columns(ids) for name, frame in frames.items()}


def assert_same(some: dict[str, pl.DataFrame], others: dict[str, pl.DataFrame]) -> None:
    for name, frame in some.items():
        assert_frame_equal(frame, others[name], check_row_order=False, abs_tol=1e-9)


def query(home: Path, sql: str) -> list[tuple]:
    with connect(home, as_delivered=True) as con:
        return con.execute(sql).fetchall()


@pytest.fixture(scope="module")
def under_one_name(sample_home, tmp_path_factory) -> dict[str, pl.DataFrame]:
    root = tmp_path_factory.mktemp("one")
    deliver(root / "landing")
    fleet(root / "landing", line(FIRST))
    keep_base(sample_home, root / "home")
    run(root / "landing", root / "home")
    return tables(root / "home")


def home_of(root: Path, sample_home: Path, second: tuple[str, str]) -> Path:
    deliver(root / "landing", second)
    fleet(root / "landing", line(FIRST), line(second))
    keep_base(sample_home, root / "home")
    run(root / "landing", root / "home")
    return root / "home"


@pytest.fixture(scope="module")
def leased_home(sample_home, tmp_path_factory) -> Path:
    return home_of(tmp_path_factory.mktemp("leased"), sample_home, LEASED)


@pytest.fixture(scope="module", params=[ANEW, LEASED], ids=["registered anew", "leased"])
def renamed(request, sample_home, tmp_path_factory) -> tuple[Path, tuple[str, str]]:
    if request.param == LEASED:
        return request.getfixturevalue("leased_home"), LEASED
    return home_of(tmp_path_factory.mktemp("renamed"), sample_home, request.param), request.param


def test_history_follows_airframe(renamed, under_one_name):
    assert_same(tables(renamed[0]), under_one_name)


def test_ranking_has_the_present_name(renamed):
    home, name = renamed

    rows = query(home, "select operator, tail, msn, pack from fleet_ranking order by pack")

    assert rows == [(*name, "40002", 1), (*name, "40002", 2)]


def test_flights_keep_delivered_names(renamed):
    home, name = renamed

    rows = query(home, "select operator, tail, count(*) from flights where msn = '40002' group by all order by 3 desc")

    delivered = list((home.parent / "landing").joinpath(*name, "acms").iterdir())
    assert rows == [(*FIRST, N_FIRST), (*name, len(delivered))]


def test_flight_ids_are_as_delivered(renamed):
    ((n,),) = query(renamed[0], "select count(*) from features where not starts_with(flight_id, tail || '_')")

    assert n == 0


def test_former_name_finds_airframe(renamed):
    home, name = renamed

    assert f"{name[0]} {name[1]}" in (explain(home, FIRST[1]) or "")


@pytest.fixture(scope="module")
def leased_exports(leased_home) -> dict[str, Path]:
    """What each operator gets of an airframe that was leased."""
    root = leased_home.parent
    for operator, _ in (FIRST, LEASED):
        export(leased_home, root / operator, access_scope(leased_home, operator, None), "duckdb")
    return {operator: root / operator / CATALOG for operator, _ in (FIRST, LEASED)}


@pytest.mark.parametrize("name", [FIRST, LEASED])
def test_export_has_operators_own_flights(leased_exports, name):
    delivered = leased_exports[name[0]].parents[1].joinpath("landing", *name, "acms").iterdir()

    with duckdb.connect(str(leased_exports[name[0]]), read_only=True) as con:
        rows = con.execute("select operator, tail, count(*) from flights group by all").fetchall()

    assert rows == [(*name, len(list(delivered)))]


def test_new_operator_gets_state_at_handover(leased_exports):
    last = "select max(departed_at) from health_parameters"
    first = "select min(departed_at) from health_parameters"
    with (
        duckdb.connect(str(leased_exports[FIRST[0]]), read_only=True) as former,
        duckdb.connect(str(leased_exports[LEASED[0]]), read_only=True) as present,
    ):
        assert present.execute(first).fetchall() == former.execute(last).fetchall()


def test_former_operator_gets_nothing_later(leased_exports):
    with duckdb.connect(str(leased_exports[FIRST[0]]), read_only=True) as con:
        ((last,),) = con.execute("select max(landed_at) from flights").fetchall()
        tables = con.execute(
            """select table_name from duckdb_columns()
            where schema_name = 'tables' and column_name = 'departed_at' and not internal"""
        ).fetchall()
        later = [t for (t,) in tables if con.execute(f"from tables.{t} where departed_at > ?", [last]).fetchone()]

    assert later == []


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ((line(FIRST, until="2024-03-09"), line(ANEW, since="2024-03-09")), "lines_contradict"),
        ((line(FIRST, until="2024-03-08"), line(ANEW, since="2024-03-09")), "flights_outside_line"),
        ((line(FIRST, msn="49999").replace("2019-06-01", "2024-03-08"),), "flights_before_delivery"),
    ],
)
def test_odd_line_is_noted(sample_home, tmp_path, lines, reason):
    keep_base(sample_home, tmp_path / "home")
    deliver(tmp_path / "landing")
    fleet(tmp_path / "landing", *lines)

    run(tmp_path / "landing", tmp_path / "home")

    assert query(tmp_path / "home", f"select scope from quarantine where reason = '{reason}'") == [("note",)]


def test_wrong_line_corrected_loses_nothing(sample_home, tmp_path, under_one_name):
    landing = tmp_path / "landing"
    home = tmp_path / "home"
    keep_base(sample_home, home)
    deliver(landing, ANEW)
    fleet(landing, line(FIRST), line(ANEW))
    run(landing, home)
    fleet(landing, line(FIRST), line(ANEW, msn="49999"))
    run(landing, home)
    assert tables(home)["raw_flights"]["tail"].n_unique() == 2

    fleet(landing, line(FIRST), line(ANEW))
    run(landing, home)

    assert_same(tables(home), under_one_name)


def test_tail_used_again_begins_anew(sample_home, tmp_path):
    landing = tmp_path / "landing"
    home = tmp_path / "home"
    keep_base(sample_home, home)
    deliver(landing)
    day = sorted((landing / "AQX/LX-AAC/acms").iterdir())[N_FIRST].stem[-11:-3]
    since = f"{day[:4]}-{day[4:6]}-{day[6:]}"
    fleet(landing, line(FIRST), line(FIRST, msn="49999", since=since))

    run(landing, home)

    rows = query(
        home, "select tail, msn, max(flights_seen_of_unit) from features where pack = 1 group by all order by 2"
    )
    assert [row[:2] for row in rows] == [("LX-AAC", "40002"), ("LX-AAC", "49999")]
    assert rows[1][2] < N_FLIGHTS - N_FIRST + 1


def test_closing_reaches_renamed_airframe_at_once(renamed, tmp_path):
    home = shutil.copytree(renamed[0], tmp_path / "home")
    flown = Store(home).read_table("raw_flights").sort("departed_at").filter(operator=FIRST[0], tail=FIRST[1])
    last = {"operator": FIRST[0], "tail": FIRST[1], "now_flight_id": flown["flight_id"][-1]}
    raised = (
        alert("wear", 30) | last | {"raised_flight_id": flown["flight_id"][3], "raised_at": flown["departed_at"][3]}
    )
    schema = TABLES["features_alerts"].schema
    Store(home).replace("features_alerts", [FIRST], schema.conform(pl.DataFrame([raised])))
    publish(home)

    change_case(home, find_case(home, "wear"), "close", "Ada", finding="clean")

    closed = query(home, "select operator, tail, closed_reason from alerts where alert_id = 'wear'")
    assert closed == [(*renamed[1], "found_clean")]
