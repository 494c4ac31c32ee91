"""What a night does around its runs: it is repeated after damage, settles, publishes; what it must not do in others."""

from pathlib import Path

import dagster as dg
import polars as pl
import pytest
from nights import Silent

from pipelines.orchestration import nightly
from pipelines.orchestration.around_night import find_landing_fault, notify_failure
from pipelines.orchestration.local_executor import LocalExecutor, sends_out
from pipelines.orchestration.nightly import Night, complete_night, run_night
from pipelines.orchestration.runs import EngineError, open_instance
from pipelines.resources import NIGHT
from pipelines.storage.delta import DamageError
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import notify_file
from pipelines.storage.store import Store

FIRST = Night(9, 2, 3, 40, {"legs": "damaged"}, ("one",), new_paths=frozenset({"a.csv"}))
SECOND = Night(9, 1, 2, 30, {}, ("two",), new_paths=frozenset({"b.csv"}))


def test_attempts_add_up_to_one_night():
    night = FIRST.combine(SECOND)

    assert (night.files, night.new_files, night.runs, night.cells) == (9, 3, 5, 70)
    assert (night.repairs, night.new_paths) == (("one", "two"), {"a.csv", "b.csv"})


def test_last_attempt_decides_what_failed():
    assert FIRST.combine(SECOND).failed == {}


@pytest.mark.parametrize(("runs", "failed", "idle"), [(0, {}, True), (1, {}, False), (0, {"legs": "no"}, False)])
def test_idle_night_neither_runs_nor_fails(runs, failed, idle):
    assert Night(9, 0, runs, 0, failed).idle is idle


@pytest.fixture
def attempts(monkeypatch):
    """Let nights end as given, one after the other; the list of those that are left."""
    left: list[Night | Exception] = []

    def attempt(*_: object) -> Night:
        end = left.pop(0)
        if isinstance(end, Exception):
            raise end
        return end

    monkeypatch.setattr(nightly, "run_night", attempt)
    monkeypatch.setattr(nightly, "_publish", lambda *_: None)
    return left


@pytest.mark.parametrize(
    ("end", "is_suspect", "n_left"),
    [(FIRST, True, 0), (FIRST, False, 1), (SECOND, True, 1), (DamageError("a.parquet"), False, 0)],
    ids=["failed over damage", "failed otherwise", "nothing failed", "damage met"],
)
def test_only_damage_repeats_a_night(tmp_path, attempts, end, is_suspect, n_left):
    attempts += [end, SECOND]
    if is_suspect:
        place = Store(tmp_path).place
        place.root.mkdir()
        place.mark_suspect()

    complete_night(tmp_path, tmp_path, Silent())

    assert len(attempts) == n_left


def test_damage_repeats_a_night_once(tmp_path, attempts):
    attempts += [DamageError("a.parquet")] * 3

    with pytest.raises(DamageError):
        complete_night(tmp_path, tmp_path, Silent())

    assert len(attempts) == 1


@pytest.mark.parametrize(
    ("repairs", "fault", "reason"),
    [
        ((), None, None),
        (("one",), None, "tables were damaged"),
        ((), "it is of another version", "it is of another version"),
    ],
    ids=["whole", "repaired", "old catalog"],
)
def test_idle_night_publishes_for_a_reason(tmp_path, monkeypatch, repairs, fault, reason):
    published = []
    monkeypatch.setattr(nightly, "run_night", lambda *_: Night(9, 0, 0, 0, {}, repairs))
    monkeypatch.setattr(nightly, "find_catalog_fault", lambda home: fault)
    monkeypatch.setattr(nightly, "publish", published.append)

    _, given = complete_night(tmp_path, tmp_path, Silent())

    assert (given, bool(published)) == (reason, reason is not None)


@pytest.fixture
def landing(tmp_path) -> Path:
    """A landing zone without a flight."""
    folder = tmp_path / "landing"
    folder.mkdir()
    (folder / "fleet.csv").write_text("operator,tail\n")
    return folder


@pytest.mark.parametrize(("only", "is_settled"), [(None, True), (pl.lit(True), False)], ids=["whole", "part"])
def test_night_of_a_part_settles_nothing(landing, tmp_path, monkeypatch, only, is_settled):
    monkeypatch.setattr(nightly, "STAGES", [])

    run_night(landing, tmp_path / "home", Silent(), only)

    assert (Ledger(tmp_path / "home").settled_version() is not None) is is_settled


def chain(home: Path, parent_run: object = None) -> nightly._Chain:
    """The steps of a night in `home`."""
    return nightly._Chain(home, home, Ledger(home), Silent(), None, parent_run, LocalExecutor(home, home, 1))


@dg.job
def no_work():
    """A job without a step."""


@pytest.mark.parametrize(("elsewhere", "is_failed"), [(True, False), (False, True)])
def test_runs_of_other_machines_are_not_failed(tmp_path, monkeypatch, elsewhere, is_failed):
    monkeypatch.setattr(nightly, "sends_out", lambda home: elsewhere)
    run = open_instance(tmp_path).create_run_for_job(no_work, tags=NIGHT)

    instance = chain(tmp_path).runner.instance

    assert instance.get_run_by_id(run.run_id).is_failure is is_failed


def test_night_that_is_a_run_sends_none_out(tmp_path):
    with pytest.raises(EngineError, match="use cron"):
        chain(tmp_path, parent_run=object()).send_out()


@pytest.mark.parametrize(
    ("text", "is_sent"), [("run_launcher:\n", True), ("# run_launcher:\n", False), ("own:\n  run_launcher:\n", False)]
)
def test_run_launcher_sends_runs_out(tmp_path, text, is_sent):
    (tmp_path / "dagster").mkdir()
    (tmp_path / "dagster/dagster.yaml").write_text(text)

    assert sends_out(tmp_path) is is_sent


def test_folder_is_no_fleet_list(tmp_path):
    (tmp_path / "fleet.csv").mkdir()

    assert find_landing_fault(tmp_path).startswith("no fleet.csv in")


@pytest.mark.parametrize("is_cause", [True, False])
def test_wrong_receivers_are_named_once(tmp_path, is_cause):
    """That nobody was reached is news unless the night failed for it."""
    notify_file(tmp_path).write_text("no TOML")
    (fault,) = notify_failure(tmp_path, ["disk full"])
    cause = fault.removeprefix("no message of the failed night was sent: ")

    assert notify_failure(tmp_path, [cause if is_cause else "disk full"]) == ([] if is_cause else [fault])
