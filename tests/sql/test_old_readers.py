"""DuckDB from 1.1 on reads every view: business tools, R and command lines lag by years."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest
from command import hdt
from small_catalog import catalog

from pipelines.storage.catalog import CATALOG, open_database
from pipelines.storage.view_headers import views

OLD_RELEASES = ("1.1.3", "1.4.1", "1.5.5")
FUNCTIONS_OF_1_1 = """
abs any_value arg_max arg_min avg bool_and bool_or ceil coalesce concat_ws count count_if date_diff date_part
date_trunc dense_rank ends_with epoch exp extract first floor generate_series greatest lag last lead least left
length list list_contains list_filter list_position list_sort list_transform ln lower ltrim max median min mode
month now nullif product quantile_cont range rank regexp_extract regexp_matches regexp_replace regr_slope
replace right round row_number rtrim sign split_part sqrt starts_with stddev_samp strftime string_agg sum
to_days trim try_cast unnest upper var_samp year
"""
"""Functions that DuckDB 1.1 binds, as the long test shows or a try by hand did. It has no `if`."""
READER = """
import json, sys
sys.path.insert(0, sys.argv[1])
import duckdb
with duckdb.connect(sys.argv[2], read_only=True) as con:
    con.execute("set enable_progress_bar = false")
    names = "select view_name from duckdb_views() where schema_name = 'main' and not internal"
    views = [name for (name,) in con.execute(names).fetchall()]
    rows = {name: len(con.execute(f"select columns(*)::varchar from {name}").fetchall()) for name in views}
print(json.dumps({"version": duckdb.__version__, "rows": rows}))
"""


def without_comments(sql: str) -> str:
    return re.sub(r"--.*", "", sql)


@pytest.mark.parametrize("view", views())
def test_view_needs_no_newer_duckdb(view):
    sql = without_comments(views()[view])
    own = set(re.findall(r"macro (\w+)\(", " ".join(views().values())))

    called = set(re.findall(r"\b(?!exclude)([a-z]\w*)\(", sql)) - own

    assert called - set(FUNCTIONS_OF_1_1.split()) == set()


@pytest.mark.parametrize("view", views())
def test_lag_has_one_argument(view):
    sql = without_comments(views()[view])  # with an offset it is stored so that no DuckDB binds it again

    assert re.findall(r"\b(?:lag|lead|nth_value|ntile)\([^()]*,", sql) == []


@pytest.mark.parametrize("view", views())
def test_no_column_is_wider_than_bigint(view):
    columns = catalog().execute(f"describe {view}").fetchall()

    assert [name for name, kind, *_ in columns if kind.startswith(("HUGEINT", "UHUGEINT", "DECIMAL"))] == []


def test_published_catalog_has_oldest_format(sample_home):
    with duckdb.connect(str(sample_home / CATALOG), read_only=True) as con:
        ((tags,),) = con.execute("select tags from duckdb_databases() where not internal").fetchall()

    assert tags["storage_version"].startswith("v1.0.0")


def test_written_database_has_oldest_format(tmp_path):
    with open_database(tmp_path / CATALOG) as con:
        ((tags,),) = con.execute("select tags from duckdb_databases() where not internal").fetchall()

    assert tags["storage_version"].startswith("v1.0.0")


@pytest.fixture(scope="module", params=OLD_RELEASES)
def old_duckdb(request, tmp_path_factory) -> Path:
    """Folder with an old release of DuckDB."""
    folder = tmp_path_factory.mktemp("duckdb")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--only-binary", ":all:", "--target", str(folder)]
    installed = subprocess.run([*pip, f"duckdb=={request.param}"], capture_output=True, text=True, check=False)
    if installed.returncode:
        pytest.skip(f"pip can't install duckdb {request.param} here: {installed.stderr.strip().splitlines()[-1]}")
    return folder


@pytest.fixture(scope="module")
def exported(sample_home, tmp_path_factory) -> Path:
    """Folder of an export as one DuckDB file."""
    folder = tmp_path_factory.mktemp("exported") / "out"
    done = hdt("export", "--home", sample_home, "--out", folder, "--format", "duckdb")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("published", [True, False], ids=["catalog", "export"])
def test_old_release_reads_every_view(old_duckdb, sample_home, exported, published):
    file = (sample_home if published else exported) / CATALOG
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    read = [sys.executable, "-c", READER, str(old_duckdb), str(file)]

    answer = subprocess.run(read, capture_output=True, text=True, check=False, env=clean)

    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout)["rows"].keys() == views().keys()
