"""The command as a tired engineer meets it: help everywhere, and one line that says what to do."""

import importlib.metadata
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from answers import query
from command import command_line, hdt
from typer.testing import CliRunner

from benchmarks.fault_points import fingerprint
from benchmarks.fleets import fly
from hdt_core.simulate.design import FleetSettings
from pipelines.cli import load_extensions
from pipelines.cli.base import ORDER, app
from pipelines.cli.make import DEMO
from pipelines.intake.scan import scan
from pipelines.orchestration.around_night import lock_home
from pipelines.storage.ledger import Ledger
from pipelines.words.evidence import WITH_COLUMNS, action_text, evidence_text

COMMANDS = ("nightly", "backfill", "status", "report", "query", "explain", "export", "ui", "simulate", "doctor", "tidy")


def hdt_json(*words: object) -> Any:
    """What a command answers as JSON."""
    return json.loads(hdt(*words, "--json").stdout)


def processor_s(*words: object) -> float:
    """User time of a command that runs as a process of its own."""
    before = os.times().children_user
    subprocess.run(command_line(*words), capture_output=True, check=False)
    return os.times().children_user - before


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command):
    done = hdt(command, "--help")
    assert done.returncode == 0
    assert "Usage" in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nightly",), "--landing DIR or set HDT_LANDING"),
        (("nightly", "--landing", "/no/such", "--home", "/tmp/x"), "no landing zone at /no/such"),
        (("nightly", "--nonsense"), "--help"),
        (("query", "select 1", "--home", "/no/such"), "run `hdt nightly"),
        (("report", "--home", "/no/such"), "run `hdt nightly"),
        (("backfill", "--landing", "data_samples", "--home", "/tmp/x", "--operator", "ZZZ"), "no operator ZZZ"),
        (("backfill", "--landing", "data_samples", "--home", "/tmp/x", "--tail", "../.."), "no aircraft ../.."),
        (("nigthly",), "nightly"),
        (("backfill", "--landing", "data_samples", "--since", "2024-07-01", "--until", "2024-06-01"), "exchange them"),
        (("case", "list", "--state", "opne"), "'acknowledged'"),
    ],
)
def test_wrong_argument_gets_one_line(words, message):
    done = hdt(*words)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert "Traceback" not in done.stderr


def _parent(zone: Path) -> str:
    (zone / "landing").mkdir(parents=True)
    (zone / "landing/fleet.csv").write_text("operator,tail\n")
    return f"give --landing {zone / 'landing'}"


def _empty(zone: Path) -> str:
    zone.mkdir()
    return "is empty; mount the landing zone there"


@pytest.fixture(scope="module")
def help_s() -> float:
    return processor_s("--help")


def _another_folder(zone: Path) -> str:
    (zone / "AQX" / "LX-AAB").mkdir(parents=True)
    return f"no fleet.csv in {zone}"


@pytest.mark.parametrize("make", [_parent, _empty, _another_folder])
@pytest.mark.parametrize("command", [("nightly",), ("nightly", "--dry-run"), ("backfill",), ("ui",)], ids=" ".join)
def test_missing_zone_ends_at_once(tmp_path, command, make, help_s):
    """For a home that knows files too: nothing is taken for a night without flights."""
    message = make(tmp_path / "zone")
    Ledger(tmp_path / "home").register(
        [("a", "AAA", "T1", "acms", 1, 1, "d")], {"a": [("AAA", "T1", "T1_20240101_01")]}
    )
    before = sorted((tmp_path / "home").iterdir())
    words = (*command, "--landing", tmp_path / "zone", "--home", tmp_path / "home")
    done = hdt(*words)
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    if make is _another_folder:  # of its own work: other tests run beside this one, and machines differ
        assert processor_s(*words) < 2.0 * help_s
    assert sorted((tmp_path / "home").iterdir()) == before


REFUSED = {
    "folder": lambda path: (path / "kept").mkdir(parents=True),
    "pipe": os.mkfifo,
    "link to a folder": lambda path: path.symlink_to(path.parent),
    "link to a device": lambda path: path.symlink_to("/dev/null"),
    "link to a link to a pipe": lambda path: (os.mkfifo(path.parent / "pipe"), path.symlink_to(path.parent / "pipe")),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_report_replaces_files_only(sample_home, tmp_path, kind):
    target = tmp_path / "report.html"
    REFUSED[kind](target)
    before = sorted((p, p.lstat().st_mode, p.lstat().st_ino) for p in tmp_path.rglob("*"))
    done = hdt("report", "--home", sample_home, "--out", target)
    assert done.returncode == 2
    assert "no regular file; name another" in done.stderr
    assert sorted((p, p.lstat().st_mode, p.lstat().st_ino) for p in tmp_path.rglob("*")) == before


def test_report_follows_a_link(sample_home, tmp_path):
    (tmp_path / "old.html").touch()
    (tmp_path / "report.html").symlink_to("old.html")
    assert hdt("report", "--home", sample_home, "--out", tmp_path / "report.html").returncode == 0
    assert (tmp_path / "report.html").is_symlink()
    assert "<html" in (tmp_path / "old.html").read_text()


def test_idle_night_has_nothing_new(own_home):
    landing, home = own_home
    done = hdt("nightly", "--landing", landing, "--home", home)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Nothing new")
    summary = hdt_json("nightly", "--landing", landing, "--home", home)
    assert summary["idle"]
    assert summary["seconds"] < 5


def test_second_night_is_refused(sample_landing, tmp_path):
    """While one is at work."""
    with lock_home(tmp_path / "home"):
        done = hdt("nightly", "--landing", sample_landing, "--home", tmp_path / "home")
    assert done.returncode == 2
    assert "another run" in done.stderr


def test_idle_night_mends_the_catalog(own_home):
    landing, home = own_home
    (home / "catalog.duckdb").write_bytes(b"no database")
    broken = hdt("query", "--home", home, "select 1")
    assert broken.returncode == 2
    assert "`hdt nightly` makes it anew" in broken.stderr
    assert len(broken.stderr.splitlines()) == 1
    ill = hdt_json("doctor", "--home", home)
    assert [c["check"] for c in ill if not c["well"]] == ["catalog"]
    done = hdt("nightly", "--landing", landing, "--home", home)
    assert "Catalog written again, for it could not be read" in done.stdout
    assert hdt("query", "--home", home, "select count(*) from flights").returncode == 0
    assert hdt_json("nightly", "--landing", landing, "--home", home)["catalog_fault"] is None


def test_query_answers(sample_home):
    assert "LX-AAB" in hdt("query", "--home", sample_home, "select distinct tail from flights").stdout


def test_wrong_query_gets_one_line(sample_home):
    wrong = hdt("query", "--home", sample_home, "select operatr from flights")
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)
    assert "operatr" in wrong.stderr
    assert '"operator"' in wrong.stderr


def test_explain_shows_an_alert(sample_home):
    columns = "alert_id, evidence_phrases, evidence_now_phrases, action_phrases"
    alert = f"select {columns} from alerts order by evidence = evidence_now limit 1"
    ((name, then, now, action),) = query(sample_home, alert)
    text = " ".join(hdt("explain", name[:8], "--home", sample_home).stdout.split())
    first = evidence_text(then, WITH_COLUMNS, has_alternatives=False)
    parts = (first, evidence_text(now, WITH_COLUMNS), action_text(action))
    assert [part for part in parts if part not in text] == []


def test_unknown_alert_is_refused(sample_home):
    none = hdt("explain", "nosuchalert", "--home", sample_home)
    assert none.returncode == 2
    assert "lists them" in none.stderr


def test_dry_run_takes_nothing_in(sample_landing, tmp_path):
    home = tmp_path / "home"
    words = ("nightly", "--landing", sample_landing, "--home", home, "--dry-run")
    plan = hdt_json(*words)
    assert len(plan["new_files"]) == plan["files"] > 100
    assert not home.exists()
    assert hdt_json(*words) == plan


def test_status_counts_waiting_cells(own_home):
    landing, home = own_home
    status = hdt_json("status", "--home", home)
    assert all(a["waiting"] == 0 and a["cells"] == a["up_to_date"] for a in status["assets"].values())
    assert status["last_good_run"] == status["last_run"] is not None
    assert status["last_run_failed"] is None
    changed = landing / "AQX" / "LX-AAB" / "maintenance.csv"
    changed.write_text(changed.read_text() + "2024-06-30,1,HX,INSPECTED,,WO1\n")
    scan(landing, Ledger(home))
    assets = hdt_json("status", "--home", home)["assets"]
    assert [assets[name]["waiting"] for name in ("raw_maintenance", "raw_flights")] == [1, 0]


def test_tidy_changes_no_table(own_home):
    landing, home = own_home
    log = landing / "AQX" / "LX-AAB" / "maintenance.csv"
    log.write_text(log.read_text() + "2024-06-30,1,HX,INSPECTED,,WO1\n")
    assert hdt_json("nightly", "--landing", landing, "--home", home)["runs"] > 0, "of some tables the last run is newer"
    before = fingerprint(home)
    shards = {f.name for f in (home / "dagster" / "history").glob("*.db")}
    assert len(shards) > 5
    assert hdt("tidy", "--home", home).stdout == "0 runs deleted\n"
    done = hdt("tidy", "--home", home, "--keep-days", "0")
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[0]) > 0
    left = {f.name.split(".")[0] for f in (home / "dagster" / "history").glob("*.db*")}
    assert left > {"index", "runs"}
    assert len(left) < len(shards), "only the last run of each table is left"
    assert hdt_json("nightly", "--landing", landing, "--home", home)["runs"] == 0
    assert fingerprint(home) == before


def test_simulated_fleet_passes_the_doctor(tmp_path):
    fleet = tmp_path / "fleet"
    done = hdt("simulate", "--out", fleet, "--operators", "1", "--tails", "1", "--flights", "5")
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (fleet / "truth").iterdir()} == {"design.parquet", "events.parquet", "health.parquet"}
    well = hdt("doctor", "--landing", fleet / "landing", "--home", tmp_path / "home")
    assert well.returncode == 0, well.stdout


def test_doctor_names_a_missing_zone(tmp_path):
    ill = hdt("doctor", "--landing", tmp_path / "nothing", "--json")
    assert ill.returncode == 1
    assert [c["check"] for c in json.loads(ill.stdout) if not c["well"]] == ["landing zone"]


def test_backfill_takes_its_dates_only(sample_landing, tmp_path):
    home = tmp_path / "home"
    where = ("--landing", sample_landing, "--home", home)
    done = hdt("backfill", *where, "--tail", "LX-AAB", "--since", "2024-03-10", "--until", "2024-03-12", "--json")
    assert done.returncode == 0, done.stderr + done.stdout
    sql = "select distinct tail, substr(flight_id, 8, 8) as day from flights order by day"
    assert query(home, sql) == [("LX-AAB", f"202403{d}") for d in (10, 11, 12)]


def test_library_warnings_stay_silent():
    """As a process of its own, whose warnings nobody catches, with a command that warns."""
    script = (
        "import sys, warnings\n"
        "from pipelines.cli import base, main\n"
        "base.app.command('warn')(lambda: warnings.warn('overflow encountered', RuntimeWarning))\n"
        "base.ORDER = (*base.ORDER, 'warn')\n"
        "sys.argv = ['hdt', 'warn']\n"
        "main()\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (ended.stdout, ended.stderr) == ("", "")


def output_of(*words: str, **env: str) -> str:
    done = CliRunner().invoke(app, list(words), env=env, prog_name="hdt")
    assert done.exit_code == 0, done.output
    return done.output


def test_help_lists_commands_in_order():
    load_extensions()
    listed = output_of("--help", COLUMNS="80").partition("Commands:")[2]
    names = [line.split()[0] for line in listed.strip().splitlines()]
    assert names == [*ORDER, *sorted(set(names) - set(ORDER))]
    groups = {g.name for g in app.registered_groups}
    assert {c.name or c.callback.__name__ for c in app.registered_commands} | groups == set(names)
    assert "..." not in listed, "no sentence is cut"


def test_version_is_that_of_package():
    assert output_of("--version").strip() == importlib.metadata.version("hybrid-digital-twin")


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("hdt ni", ["nightly"]), ("hdt b", ["backfill", "benchmark"]), ("hdt nightly --dry", ["--dry-run"]),
        ("hdt report --o", ["--out"]),
    ],
)  # fmt: skip
def test_shell_completes_words(typed, offered):
    place = str(len(typed.split()) - 1)
    assert output_of(_HDT_COMPLETE="complete_bash", COMP_WORDS=typed, COMP_CWORD=place).split() == offered


@pytest.mark.parametrize(
    ("shell", "script"), [("bash", "complete -o default"), ("zsh", "compdef"), ("fish", "complete")]
)
def test_each_shell_gets_its_script(shell, script):
    assert script in output_of(_HDT_COMPLETE=f"source_{shell}")


def test_demo_ends_with_open_alerts():
    size = {name: value for name, value in DEMO.items() if name != "seed"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # samples of a pack that is off, as in every night
        frames = fly(DEMO["seed"], FleetSettings(**size))
    still = frames["alerts"].filter(pl.col("closed_at").is_null(), component="HX")
    assert still.filter(severity="high").height >= 1
    assert still["tail"].n_unique() >= 1
    assert frames["lives"].filter("failed").height >= 1, "a message that a replacement answered"
    loss = frames["features"].sort("departed_at").group_by("tail", "pack").last().get_column("hx_fouling")
    assert loss.max() > 0.3
