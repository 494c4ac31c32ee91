"""The catalog keeps the contract: views, columns, keys, an exact account, and it is readable while a run writes."""

import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import duckdb
import pytest
from answers import query, rows

from hdt_core.alerts.diagnoses import DIAGNOSES
from pipelines.storage import catalog
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.catalog_checks import find_catalog_fault
from pipelines.storage.objects import StoreError
from pipelines.storage.publication import HASH, publish
from pipelines.storage.store import Store

CONTRACT = (Path(__file__).parents[2] / "docs/catalog.md").read_text()


def contract() -> dict[str, list[str]]:
    """Columns each view must have, read from the contract's own table."""
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| (.+) \|$", CONTRACT, flags=re.MULTILINE)
    columns = {}
    for view, text in rows:
        listed = re.sub(r"\([^)]*\)", "", text)
        columns[view] = re.findall(r"\b[a-z][a-z_0-9]*\b", " ".join(re.findall(r"`([^`]*)`", listed)))
    return columns


@pytest.fixture(scope="module")
def con(sample_home):
    with connect(sample_home) as con:
        yield con


@pytest.mark.parametrize("view", contract())
def test_view_has_contract_columns(con, view):
    assert set(contract()[view]) <= {column for column, *_ in rows(con, f"describe {view}")}


# a sound fleet has none of the last two
@pytest.mark.parametrize("view", sorted(contract().keys() - {"alerts", "quarantine", "silent_columns"}))
def test_view_has_rows(con, view):
    assert rows(con, f"select count(*) from {view}")[0][0] > 0


@pytest.mark.parametrize("view", contract())
def test_missing_value_is_never_nan(con, view):
    numbers = [column for column, kind, *_ in rows(con, f"describe {view}") if kind in {"DOUBLE", "FLOAT"}]
    counts = [f'count(*) filter (isnan("{column}"))' for column in numbers]
    (n_nan,) = rows(con, f"select {', '.join(counts) or 'count(*)'} from {view}")
    assert [column for column, n in zip(numbers, n_nan, strict=False) if n] == []


def test_catalog_lists_declared_diagnoses(sample_home):
    with connect(sample_home) as con:
        ((codes,),) = con.execute("select tables.diagnoses()").fetchall()

    assert codes == list(DIAGNOSES)


def test_health_has_contract_parameters(con):
    parameters = {p for (p,) in rows(con, "select distinct parameter from health_parameters")}
    expected = {"hx_fouling", "hx_h_hot_w_k", "hx_h_cold_w_k", "cc_effective_diameter_m", "cc_efficiency_loss"}
    assert expected <= parameters


def test_missing_health_has_a_reason(con):
    silent = "select count(*) from health_parameters where value is null and status in ('', 'ok', 'converged')"
    assert rows(con, silent) == [(0,)]


def test_answered_message_names_its_line(con):
    keys = "select distinct operator, tail, answered_by from {} where answered_by is not null"
    named, lines = (set(rows(con, keys.format(view))) for view in ("messages", "maintenance"))

    assert set() < named <= lines


COUNT = "select count(*) from flights"


@pytest.fixture(scope="module")
def home(sample_home, tmp_path_factory) -> Path:
    """A copy of the sample home with a catalog of its own place."""
    home = Path(shutil.copytree(sample_home, tmp_path_factory.mktemp("published") / "home"))
    publish(home)
    return home


def test_publishing_leaves_readers_alone(home):
    reader = connect(home)
    before = reader.execute(COUNT).fetchone()
    publish(home)
    assert reader.execute(COUNT).fetchone() == before
    reader.close()
    assert opened(home / CATALOG, home) == str(before[0])


@pytest.mark.parametrize("meets", ["the new one's end", "a mixture of both"])
def test_replaced_catalog_is_opened_anew(own_home, monkeypatch, meets):
    """DuckDB opens a database by name three times: where another is renamed into its place, it mixes them."""
    _, home = own_home
    new = Path(shutil.copyfile(home / CATALOG, home / "new"))
    with duckdb.connect(str(new)) as con:
        con.execute("comment on view flights is 'new'")
    stock = duckdb.connect
    opened = []

    def connect_slowly(path, **options):
        opened.append(path)
        con = stock(path, **options)
        if new.exists():
            new.replace(path)
            if meets == "a mixture of both":
                con.close()
                raise duckdb.IOException("could not read enough bytes")
        return con

    monkeypatch.setattr(duckdb, "connect", connect_slowly)
    comment = "select comment from duckdb_views() where view_name = 'flights' and schema_name = 'main'"
    assert query(home, comment) == [("new",)]
    assert len(opened) == 2


def test_copied_home_reads_own_tables(sample_home, own_home):
    _, home = own_home
    assert "another place" in str(find_catalog_fault(home))
    for file in (home / "tables/raw_flights").rglob("*.parquet"):
        file.unlink()
    with connect(home) as con, pytest.raises(StoreError, match=r"raw_flights/.* can't be read .*; `hdt nightly`"):
        con.execute(COUNT)
    assert query(sample_home, COUNT)[0][0] > 0


def opened(path: Path | str, cwd: Path) -> str:
    """What DuckDB by itself counts in a catalog that is opened from some folder, or why it can't."""
    code = f"import duckdb; print(duckdb.connect({str(path)!r}, read_only=True).execute({COUNT!r}).fetchone()[0])"
    done = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False)
    return done.stdout.strip() or done.stderr


@pytest.mark.parametrize("how", ["copied", "moved", "linked", "below a name with a quote"])
def test_moved_home_needs_no_writing(own_home, tmp_path, how):
    """Also opened by DuckDB itself, by any path from any folder: copied homes, other mounts."""
    _, home = own_home
    ((flights,),) = query(home, COUNT)
    there = tmp_path / ("o'clock" if "quote" in how else "there") / "home"
    there.parent.mkdir()
    if how == "linked":
        home.rename(tmp_path / "mounted")
        there.symlink_to(tmp_path / "mounted")
    elif how == "copied":
        shutil.copytree(home, there)
        shutil.rmtree(home / "tables")
    else:
        home.rename(there)
    before = (there / CATALOG).read_bytes()
    with connect(there) as con:
        assert con.execute(COUNT).fetchone() == (flights,)
        with connect(there) as second:
            assert second.execute(COUNT).fetchone() == (flights,)
    for path, cwd in ((there / CATALOG, Path("/")), (CATALOG, there), (f"../{CATALOG}", there / "tables")):
        assert opened(path, cwd) == str(flights)
    assert (there / CATALOG).read_bytes() == before


def test_catalog_can_be_attached(home):
    with duckdb.connect() as con:
        con.execute(f"attach '{home / CATALOG}' as other (read_only)")
        assert con.execute("select count(*) from other.flights").fetchone()[0] > 0


def test_moved_catalog_can_be_attached(home, tmp_path):
    elsewhere = home.rename(tmp_path / "elsewhere")
    with duckdb.connect() as con:
        con.execute(f"attach '{elsewhere / CATALOG}' as other (read_only)")
        con.execute(f"set variable tables_folder = '{elsewhere / 'tables'}/'")
        assert con.execute("select count(*) from other.flights").fetchone()[0] > 0
    elsewhere.rename(home)


def run_sql(sql: str, path: Path) -> None:
    with duckdb.connect(str(path)) as con:
        con.execute(sql)


DAMAGE = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "torn": lambda path: path.write_bytes(path.read_bytes()[:8192] + bytes(path.stat().st_size - 8192)),
    "text": lambda path: path.write_text("no database\n" * 1000),
    "without a view": partial(run_sql, "drop view alerts"),
    "of an earlier version": lambda path: path.unlink() or run_sql("create view flights as select 1 as operator", path),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_next_night_mends_broken_catalog(home, damage):
    assert find_catalog_fault(home) is None
    DAMAGE[damage](home / CATALOG)
    assert find_catalog_fault(home)
    if damage not in {"missing", "without a view"}:
        with pytest.raises(StoreError, match="`hdt nightly` makes it anew"):
            connect(home)
    publish(home)
    assert find_catalog_fault(home) is None


def test_simultaneous_first_readers_all_answer(home, monkeypatch):
    """Of two that find the configuration open, one locks it before the other has changed it."""
    lock = catalog.restrict

    def lock_late(*arguments):
        time.sleep(0.05)
        return lock(*arguments)

    monkeypatch.setattr(catalog, "restrict", lock_late)
    with ThreadPoolExecutor(8) as pool:
        (flights,) = set(pool.map(lambda _: query(home, COUNT)[0][0], range(16)))
    assert flights > 0


def view_texts(home: Path) -> list[str]:
    """Every view with its text, and every comment."""
    with connect(home) as con:
        views = con.execute("select schema_name, view_name, sql, comment from duckdb_views() where not internal")
        columns = con.execute("select table_name, column_name, data_type, comment from duckdb_columns()")
        return sorted(map(str, [*views.fetchall(), *columns.fetchall()]))


@pytest.mark.parametrize("spoiled", [None, "catalog", "hash"])
def test_continued_catalog_equals_new_one(home, spoiled):
    store = Store(home)
    aircraft = ("BZR", "A9-BAC")
    alerts = store.read_table("features_alerts", [aircraft])
    store.replace("features_alerts", [aircraft], alerts.head(-1))
    if spoiled == "catalog":
        content = bytearray((home / CATALOG).read_bytes())
        content[len(content) // 2] ^= 1
        (home / CATALOG).write_bytes(content)
    elif spoiled:
        (home / HASH).write_text("another")
    publish(home)
    expected = view_texts(home)
    stored = query(home, "select count(*) from tables.features_alerts where tail = 'A9-BAC'")
    assert stored == [(alerts.height - 1,)]
    (home / HASH).unlink()
    publish(home)
    assert view_texts(home) == expected
