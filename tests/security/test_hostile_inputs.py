"""Nobody in: hostile files, names, questions and models. Nothing is executed, nothing is written outside the home."""

import pickle
from pathlib import Path

import duckdb
import polars as pl
import pytest
import skops.io
import yaml
from command import hdt
from hostile import CANARY, FILES, LINKS, PIPE, SCRIPT, Bomb
from skops.io.exceptions import UntrustedTypesFoundException

from pipelines.learned import TRUSTED_TYPES
from pipelines.orchestration.runs import open_instance
from pipelines.storage.catalog import connect, run_select
from pipelines.storage.store import shard_of

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", [*FILES, *LINKS, "a pipe"])
def test_hostile_file_is_quarantined(watched, name):
    planted = {n: (path, reason) for n, (path, _, reason) in (FILES | LINKS).items()} | {"a pipe": (PIPE, "not_a_file")}
    path, reason = planted[name]
    printable = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in path)
    entries = watched.quarantine.filter(pl.lit(printable).str.starts_with(pl.col("file")))
    assert reason in entries["reason"].to_list()


def test_good_aircraft_is_taken_in(watched):
    assert watched.failed == {}
    balance = "select bool_and(delivered = loaded + quarantined + duplicate) from deliveries"
    with connect(watched.home) as con:
        assert con.execute("select count(*) from flights where tail = 'Z9'").fetchone()[0] >= 3
        assert con.execute(balance).fetchone()[0]


def test_night_executes_nothing_hostile(watched):
    # Dagster follows the log of each step, joblib counts the cores
    harmless = ("('tail', ['tail', '-F'", "watch_orphans", "('lscpu', ")
    started = [e for e in watched.events if e[0] not in ("write", "pickle.find_class")]
    assert [e for e in started if not any(h in e[1] for h in harmless)] == []
    assert not list(watched.root.rglob("pwned*"))


def test_night_unpickles_nothing_hostile(watched):
    assert [e for e in watched.events if e[0] == "pickle.find_class" and "polars" not in e[1]] == []


def test_night_writes_only_into_home(watched):
    allowed = (str(watched.home), "/dev/null", "/proc/", "/sys/")
    assert [p for kind, p in watched.events if kind == "write" and not p.startswith(allowed)] == []
    assert {p.name for p in watched.root.iterdir()} == {"landing", "home", "outside", "told.json"}
    assert [p.name for p in (watched.root / "outside").iterdir()] == ["secret.csv"]


def test_report_runs_no_markup(watched):
    page = (watched.home / "report.html").read_text()
    assert [markup for markup in (SCRIPT, "<script>alert", "<img src=x") if markup in page] == []


def test_secret_of_environment_stays_secret(watched):
    holders = [f for f in watched.home.rglob("*") if f.is_file() and CANARY.encode() in f.read_bytes()]
    assert CANARY not in watched.output
    assert holders == []


@pytest.mark.parametrize(
    "aircraft",
    [
        ("..", "Z9"), ("QQX", ".."), ("QQX", "../../etc"), ("/tm", "Z9"), ("QQX", "Z9/../.."), ("QQX", "Z9\n"),
        ("QQX\n", "Z9"), ("QQX", "Z9\0"), ("qqx", "Z9"), ("QQX", "\uff3a\uff19"), ("", "Z9"), ("QQX", "~"), ("QQX", ""),
    ],
    ids=repr,
)  # fmt: skip
def test_hostile_name_becomes_no_path(aircraft):
    with pytest.raises(ValueError, match="not an operator and tail"):
        shard_of(aircraft)


@pytest.mark.parametrize(
    "arguments",
    [
        ["backfill", "--operator", "../.."], ["backfill", "--tail", "../../../etc"],
        ["backfill", "--tail", "Z9'; drop table done; --"], ["explain", "' or 1=1 --"], ["explain", "%"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_hostile_argument_takes_one_line(watched, monkeypatch, arguments):
    monkeypatch.setenv("HDT_HOME", str(watched.home))
    monkeypatch.setenv("HDT_LANDING", str(watched.landing))
    before = listing(watched.home)
    done = hdt(*arguments)
    assert (done.returncode, done.stderr[:5]) == (2, "hdt: ")
    assert listing(watched.home) == before


def listing(home: Path) -> set[Path]:
    return {p for p in home.rglob("*") if "dagster" not in p.parts}


QUESTIONS = (
    "select * from read_text('/etc/hostname')",
    "select * from read_csv('/etc/hostname')",
    "select * from read_blob('{home}/ledger.sqlite')",
    "select * from read_text('{home}/tables/../dagster/dagster.yaml')",
    "select * from glob('/etc/*')",
    "select * from '/etc/hostname'",
    "select * from 'https://example.com/x.parquet'",
    "copy (select 1) to '{home}/../pwned.csv'",
    "copy (select 1) to '{home}/tables/raw_flights/pwned.parquet'",
    "explain analyze copy (select 1) to '{home}/tables/pwned.csv'",
    "copy flights from '/etc/hostname'",
    "export database '{home}/pwned'",
    "attach '{home}/pwned.duckdb' as pwned",
    "attach '{home}/ledger.sqlite' (type sqlite)",
    "install httpfs",
    "load '{home}/pwned.duckdb_extension'",
    "set enable_external_access = true",
    "set lock_configuration = false",
    "set allowed_directories = ['/']",
    "pragma enable_profiling",
    "create table pwned (a integer)",
    "create secret pwned (type s3, key_id 'x', secret 'y')",
    "drop view flights",
    "select 1; drop view flights",
    "select 1; copy (select 1) to '{home}/pwned.csv'",
    "call enable_logging()",
    "",
)


@pytest.mark.parametrize("question", QUESTIONS)
def test_hostile_question_gets_no_answer(watched, question):
    before = listing(watched.root)
    done = hdt("query", "--home", watched.home, question.format(home=watched.home))
    assert (done.returncode, done.stderr[:5]) == (2, "hdt: ")
    assert listing(watched.root) == before


@pytest.mark.parametrize("question", [*QUESTIONS[:7], *QUESTIONS[14:19], QUESTIONS[20]])
def test_locked_catalog_refuses_hostile_question(watched, question):
    """Who has a connection, the report for one, can't reach a file or the network either, nor take the lock off."""
    with connect(watched.home) as con, pytest.raises(duckdb.Error):
        con.execute(question.format(home=watched.home)).fetchall()


def test_locked_catalog_answers_honest_question(watched):
    with connect(watched.home) as con:
        assert run_select(con, "with f as (from flights) select count(*) from f").fetchall()[0][0] > 0
        assert run_select(con, "describe flights").fetchall()


def test_every_connection_is_locked(watched):
    with connect(watched.home) as first, connect(watched.home) as second:
        for con in (first, second):
            assert con.execute("select current_setting('enable_external_access')").fetchone() == (False,)


def test_pickle_is_no_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Exception, match="not a zip file"):
        skops.io.loads(pickle.dumps(Bomb()), trusted=TRUSTED_TYPES)
    assert not (tmp_path / "pwned").exists()


def test_untrusted_type_is_no_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UntrustedTypesFoundException):
        skops.io.loads(skops.io.dumps({"model": Bomb()}), trusted=TRUSTED_TYPES)
    assert not (tmp_path / "pwned").exists()


def test_no_module_unpickles():
    wrong = ("pickle.load", "joblib.load", "import pickle", "import joblib", "import dill", "eval(", "os.system(")
    sources = [f for folder in ("hdt_core", "pipelines") for f in (ROOT / folder).rglob("*.py")]
    assert [(f.name, w) for f in sources for w in wrong if w in f.read_text().replace("literal_eval(", "")] == []


def test_telemetry_is_off(tmp_path):
    open_instance(tmp_path).dispose()
    for file in (ROOT / "dagster.yaml", tmp_path / "dagster/dagster.yaml"):
        settings = yaml.safe_load(file.read_text())
        assert (settings["telemetry"], settings["nux"]) == ({"enabled": False}, {"enabled": False}), file
