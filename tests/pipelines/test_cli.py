"""The command as a tired engineer meets it: help everywhere, and one line that says what to do."""

import json
import subprocess
import sys

import pytest

from benchmarks.fingerprint import fingerprint

COMMANDS = ("nightly", "backfill", "status", "report", "query", "explain", "export", "ui", "simulate", "doctor", "tidy")


def hdt(*words: str, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from pipelines.cli import main; main()", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=env)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command):
    done = hdt(command, "--help")
    assert done.returncode == 0
    assert "Usage" in done.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("nightly",), "--landing DIR or set HDT_LANDING"),
        (("nightly", "--landing", "/no/such", "--home", "/tmp/x"), "no landing zone at /no/such"),
        (("nightly", "--nonsense"), "--help"),
        (("query", "select 1", "--home", "/no/such"), "run `hdt nightly"),
        (("report", "--home", "/no/such"), "run `hdt nightly"),
        (("backfill", "--landing", "data_samples", "--home", "/tmp/x", "--operator", "ZZZ"), "no operator ZZZ"),
        (("backfill", "--landing", "data_samples", "--home", "/tmp/x", "--tail", "../.."), "no aircraft ../.."),
        (("nigthly",), "nightly"),
    ],
)
def test_a_wrong_argument_gives_one_line_that_says_what_to_do(words, says):
    done = hdt(*words)
    assert done.returncode == 2
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert "Traceback" not in done.stderr


def test_an_idle_night_says_so_in_a_line(own_home):
    landing, home = own_home
    done = hdt("nightly", "--landing", str(landing), "--home", str(home))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Nothing new")
    told = json.loads(hdt("nightly", "--landing", str(landing), "--home", str(home), "--json").stdout)
    assert told["idle"]
    assert told["seconds"] < 5


def test_a_second_night_at_the_same_time_stops_with_a_clear_line(own_home):
    from pipelines.nightly import holding

    landing, home = own_home
    with holding(home):
        done = hdt("nightly", "--landing", str(landing), "--home", str(home))
    assert done.returncode == 2
    assert "another run" in done.stderr


def test_query_answers_and_says_what_is_wrong(sample_home):
    assert "LX-AAB" in hdt("query", "--home", str(sample_home), "select distinct tail from flights").stdout
    wrong = hdt("query", "--home", str(sample_home), "select nothing_such from flights")
    assert wrong.returncode == 2
    assert "nothing_such" in wrong.stderr


def test_a_dry_run_names_the_new_files_and_takes_nothing_in(sample_landing, tmp_path):
    home = tmp_path / "home"
    done = hdt("nightly", "--landing", str(sample_landing), "--home", str(home), "--dry-run", "--json")
    told = json.loads(done.stdout)
    assert len(told["new_files"]) == told["files"] > 100
    assert not (home / "tables").exists()
    again = hdt("nightly", "--landing", str(sample_landing), "--home", str(home), "--dry-run", "--json")
    assert json.loads(again.stdout) == told


def test_status_counts_what_waits(own_home):
    landing, home = own_home
    told = json.loads(hdt("status", "--home", str(home), "--json").stdout)
    assert all(a["waiting"] == 0 and a["cells"] == a["up_to_date"] for a in told["assets"].values())
    assert told["last_good_run"] == told["last_run"] is not None
    assert told["last_run_failed"] is None
    from pipelines.landing import scan
    from pipelines.ledger import Ledger

    changed = landing / "AQX" / "LX-AAB" / "maintenance.csv"
    changed.write_text(changed.read_text() + "2024-06-30,1,HX,INSPECTED,,WO1\n")
    scan(landing, Ledger(home))
    waiting = json.loads(hdt("status", "--home", str(home), "--json").stdout)["assets"]
    assert waiting["raw_maintenance"]["waiting"] == 1
    assert waiting["raw_flights"]["waiting"] == 0


def test_an_alert_is_explained_with_its_evidence_and_what_to_do(sample_home):
    from pipelines.catalog import connect
    from pipelines.report.words import finding, tidy

    columns = "alert_id, evidence, evidence_now, recommended_action"
    with connect(sample_home) as con:
        found = con.execute(f"select {columns} from alerts order by evidence = evidence_now limit 1").fetchone()
    assert found is not None
    said = " ".join(hdt("explain", found[0][:8], "--home", str(sample_home)).stdout.split())
    assert finding(found[1]) in said
    assert tidy(found[2]) in said
    assert found[3] in said
    none = hdt("explain", "nosuchalert", "--home", str(sample_home))
    assert none.returncode == 2
    assert "lists them" in none.stderr


def test_history_may_be_forgotten_and_nothing_is_made_again(own_home):
    landing, home = own_home
    before = fingerprint(home)
    shards = {f.name for f in (home / "dagster" / "history").glob("*.db")}
    assert len(shards) > 5
    assert hdt("tidy", "--home", str(home)).stdout == "0 runs forgotten\n"
    done = hdt("tidy", "--home", str(home), "--keep-days", "0")
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[0]) > 5
    left = {f.name.split(".")[0] for f in (home / "dagster" / "history").glob("*.db*")}
    assert left == {"index", "runs"}
    idle = hdt("nightly", "--landing", str(landing), "--home", str(home), "--json")
    assert json.loads(idle.stdout)["runs"] == 0
    assert fingerprint(home) == before


def test_a_simulated_fleet_passes_the_doctor(tmp_path):
    fleet = tmp_path / "fleet"
    done = hdt("simulate", "--out", str(fleet), "--operators", "1", "--tails", "1", "--flights", "5")
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (fleet / "truth").iterdir()} == {"design.parquet", "events.parquet", "health.parquet"}
    well = hdt("doctor", "--landing", str(fleet / "landing"), "--home", str(tmp_path / "home"))
    assert well.returncode == 0, well.stdout
    ill = hdt("doctor", "--landing", str(fleet / "nothing"), "--json")
    assert ill.returncode == 1
    assert [c["check"] for c in json.loads(ill.stdout) if not c["well"]] == ["landing zone"]


def test_a_backfill_by_date_takes_in_those_flights_and_no_other(sample_landing, tmp_path):
    home = tmp_path / "home"
    where = ("--landing", str(sample_landing), "--home", str(home))
    done = hdt("backfill", *where, "--tail", "LX-AAB", "--since", "2024-03-10", "--until", "2024-03-12", "--json")
    assert done.returncode == 0, done.stderr + done.stdout
    asked = "select distinct tail, substr(flight_id, 8, 8) as day from flights order by day"
    from pipelines.catalog import connect

    with connect(home) as con:
        found = con.execute(asked).fetchall()
    assert found == [("LX-AAB", f"202403{d}") for d in (10, 11, 12)]
