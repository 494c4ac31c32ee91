"""What CONTRIBUTING.md says of adding things, done in a copy of the tree; the suite's own tests judge it.

A component is added by tests/pipelines/test_own_component.py, from outside the tree.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest
from packages import install

ROOT = Path(__file__).parents[1]
CODE = ("hdt_core", "pipelines", "dagster_batched", "sql", "tests", "docs", "benchmarks", "extensions")
ESTIMATOR = '''"""Least squares that takes more steps."""

from dataclasses import dataclass

from hdt_core.estimation.optimisers import NonlinearLeastSquares


@dataclass(frozen=True, slots=True)
class PatientLeastSquares(NonlinearLeastSquares):
    """Nonlinear least squares with five times the steps."""

    name: str = "patient"
    max_steps: int = 1000
'''
FEATURE = """\
    hx_fouling_squared = feature("hx_fouling times itself", value=pl.col("hx_fouling") ** 2)
    hx_fouling_smooth = feature(
        "mean of three flights of the unit", value=pl.col("hx_fouling").rolling_mean(3).over(*PACK, "hx_life")
    )
"""
STAGE = '''"""How many flights each aircraft has flown."""

import polars as pl

from pipelines.assets.stage import stage


@stage
def flight_counts(raw_flights: pl.DataFrame) -> pl.DataFrame:
    """Flights of each aircraft on record."""
    return raw_flights.group_by("operator", "tail").agg(pl.len().cast(pl.Int64).alias("n_flights"))
'''
TABLE = '''

class FlightCounts(Table):
    """One aircraft: how many flights are on record."""

    operator = operator_key()
    tail = tail_key()
    n_flights = count("flights on record")
'''
DIAGNOSIS = '''"""A pack that has flown three times."""

from dataclasses import dataclass

from hdt_core.alerts.cases import Case
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.evidence import Evidence
from hdt_core.alerts.facts import Facts
from hdt_core.alerts.text import Figures, Phrase, Text

FLOWN = Phrase("{flights} flights since {since}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownFacts(Facts):
    """Of a pack that flies."""

    flights: int


def find_flown(grid, maintenance, limits, disturbances):
    """Find packs with three flights."""
    units = range(grid.units.height)
    return [Case(unit, "HX", "HX_FLOWN", 2, None, {"since": 0, "flights": 3}) for unit in units]


def evidence(facts, since):
    """Return how often it has flown."""
    return Evidence((Text(FLOWN, flights=Figures(str(facts.flights)), since=since),), (), "a miscount", "Nothing")


DIAGNOSES = (
    Diagnosis(
        code="HX_FLOWN",
        component="HX",
        name="flown",
        action="Admire it",
        ended_by=("REPLACED",),
        record=FlownFacts,
        severity=lambda facts: "low",
        evidence=evidence,
        rule=find_flown,
    ),
)
'''
VIEW = """-- Which aircraft have flown most?
-- Grain: operator, tail. Reads: tables.flight_counts.
create or replace view busiest as
select *
from tables.flight_counts;
"""


def replaced(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert text.count(before) == 1, f"{path.name}: {before}"
    path.write_text(text.replace(before, after))


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    """A copy with one more estimator, diagnosis, feature, stage and view, by the table of CONTRIBUTING.md."""
    top = tmp_path_factory.mktemp("tree")
    for folder in CODE:
        shutil.copytree(ROOT / folder, top / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "CONTRIBUTING.md"):
        shutil.copy(ROOT / file, top / file)
    (top / "data_samples").symlink_to(ROOT / "data_samples")
    (top / "hdt_core/alerts/diagnoses/flown.py").write_text(DIAGNOSIS)
    install(top, "patient", ESTIMATOR, "patient = patient:PatientLeastSquares", "hdt.estimators")
    replaced(top / "hdt_core/tables/features.py", "    usage_hours = feature(", FEATURE + "    usage_hours = feature(")
    with (top / "hdt_core/tables/raw.py").open("a") as tables:
        tables.write(TABLE)
    anchor = '    "raw_fleet": StoredTable('
    replaced(top / "hdt_core/tables/__init__.py", anchor, (
        '    "flight_counts": StoredTable(raw.FlightCounts, "fleet", ("operator", "tail")),\n' + anchor
    ))  # fmt: skip
    replaced(top / "pipelines/lineage.py", '    declare_stage("prognosis_base",', (
        '    declare_stage("flight_counts", "raw", "flight_counts", parents=("raw_flights",)),\n'
        '    declare_stage("prognosis_base",'
    ))  # fmt: skip
    (top / "pipelines/assets/flight_counts.py").write_text(STAGE)
    (top / "sql/views/busiest.sql").write_text(VIEW)
    done = python(top, "-m", "docs.dictionary", "docs/data-dictionary.md")
    assert done.returncode == 0, done.stderr
    return top


def python(tree: Path, *words: str) -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST")}
    env |= {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=tree, env=env, capture_output=True, text=True, timeout=500, check=False)


def test_suite_takes_additions(tree):
    """Contract of estimators, declared features, order of stages, views and their meanings."""
    of_views = (
        "test_view_header_names_grain_sources",
        "test_every_column_has_meaning",
        "test_dictionary_is_up_to_date",
        "test_catalog_comments_everything",
        "test_features_are_stored_as_declared",
    )
    relevant = (
        "tests/hdt_core/estimation/test_estimators.py",
        "tests/pipelines/test_order.py",
        *(f"tests/sql/test_sample_fleet.py::{test}" for test in of_views),
    )
    done = python(tree, "-m", "pytest", "-vv", "-p", "no:cacheprovider", "-k", "patient or not estimator", *relevant)
    assert done.returncode == 0, done.stdout[-3000:]
    for added in ("[patient] PASSED", "sources[busiest] PASSED"):
        assert added in done.stdout


def test_night_makes_additions(tree, tmp_path):
    landing = tmp_path / "landing"
    aircraft = "AQX/LX-AAB"
    acms = ROOT / "data_samples" / aircraft / "acms"
    (landing / aircraft / "acms").mkdir(parents=True)
    for file in sorted(acms.glob("*.csv"))[-6:]:
        shutil.copy(file, landing / aircraft / "acms")
    lines = (ROOT / "data_samples/fleet.csv").read_text().splitlines()
    (landing / "fleet.csv").write_text("\n".join([lines[0], *(x for x in lines if ",LX-AAB," in x)]) + "\n")
    night = "from pipelines.cli import main; main()"
    done = python(tree, "-c", night, "nightly", "--landing", str(landing), "--home", str(tmp_path / "home"))
    assert done.returncode == 0, done.stdout + done.stderr
    with duckdb.connect(str(tmp_path / "home/catalog.duckdb"), read_only=True) as con:
        alerts = con.sql("select pack, recommended_action from alerts where diagnosis = 'HX_FLOWN' order by pack")
        assert alerts.fetchall() == [(1, "Admire it"), (2, "Admire it")]
        assert con.sql("select tail, n_flights from busiest").fetchall() == [("LX-AAB", 6)]
        assert con.sql("select count(*) from features where hx_fouling_squared = hx_fouling ** 2").fetchall()[0][0] > 0
        smooth = con.sql("select count(hx_fouling_smooth) from features group by pack")
        assert smooth.fetchall() == [(4,), (4,)]
