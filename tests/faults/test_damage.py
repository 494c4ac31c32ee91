"""Files of a home deleted, cut, exchanged or with a bit flipped: never a wrong answer, told, and mended by a night.

A disk that rots changes a bit and keeps size and time.

`HDT_SOAK_DAMAGES` sets how many; `make soak` has far more than there is time for in CI.
"""

import os
import random
import shutil
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import duckdb
import pytest
from soundness import answers
from zones import drop_fleet, simulated

from benchmarks.fault_points import fingerprint
from pipelines.cli.doctor import examine
from pipelines.repair import replace_damaged_history
from pipelines.storage import seal
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.delta import DamageError
from pipelines.storage.files import LOG
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.publication import HASH, publish
from pipelines.storage.store import Store

DAMAGES = int(os.environ.get("HDT_SOAK_DAMAGES", "14"))
KINDS = ("data", "log", "all files of a table", "ledger", "catalog", "history", "seal")
WAYS = ("delete", "truncate", "swap", "flip", "rot")
SILENT = ("catalog", "history")
"""A bit of these may flip where nothing is read: DuckDB and SQLite leave room."""


@dataclass(frozen=True)
class Whole:
    """Two aircraft of four flights, a home after two nights over them, and what it answers. Read only.

    `later` is the landing zone with a fifth flight of each.
    """

    landing: Path
    later: Path
    home: Path
    stored: dict[str, str]
    answers: dict[str, int]


@pytest.fixture(scope="module")
def whole(children, tmp_path_factory) -> Whole:
    root = tmp_path_factory.mktemp("whole")
    landing = root / "landing"
    home = children.home(root / "home")
    zones = [simulated(seed, 5, operator="QQX", tail=tail) for seed, tail in ((5, "Z9"), (6, "Z8"))]
    drop_fleet(landing, zones)
    for zone in zones:
        zone.only(zone.flights[:3]).drop_csv(landing)
        zone.drop_papers(landing)
    children.complete_night(landing, home)
    for zone in zones:
        zone.only(zone.flights[3:4]).drop_csv(landing)
    children.complete_night(landing, home)
    later = Path(shutil.copytree(landing, root / "later", copy_function=shutil.copy2))
    for zone in zones:
        zone.only(zone.flights[4:]).drop_csv(later)
    return Whole(landing, later, home, fingerprint(home), answers(home))


def targets(home: Path, kind: str) -> list[Path]:
    """Files of one kind."""
    data = sorted(home.glob("tables/**/*.parquet"))
    return {
        "data": data,
        "all files of a table": data,
        "log": sorted(home.glob(f"tables/*/{LOG}/*.json")),
        "ledger": [home / "ledger.sqlite"],
        "catalog": [home / CATALOG],
        "history": sorted(home.glob("dagster/history/*.db")),
        "seal": [home / "seal.json"],
    }[kind]


def damage(chance: random.Random, home: Path, kind: str) -> tuple[str, str, str]:
    """Do one thing to a home; what, how, where."""
    way = chance.choice(WAYS)
    files = targets(home, kind)
    file = chance.choice(files)
    if kind == "all files of a table":
        shutil.rmtree(home / "tables" / file.relative_to(home / "tables").parts[0])
        way = "delete"
    elif way == "delete":
        file.unlink()
    elif way == "truncate":
        os.truncate(file, chance.randrange(file.stat().st_size))
    elif way == "swap" and len(files) > 1:
        other = chance.choice([f for f in files if f != file])
        one = file.read_bytes()
        two = other.read_bytes()
        file.write_bytes(two)
        other.write_bytes(one)
    else:
        way = "rot" if way == "rot" else "flip"
        flip(file, chance.randrange(file.stat().st_size), 1 << chance.randrange(8), as_disks_do=way == "rot")
    return kind, way, str(file.relative_to(home))


def flip(file: Path, at: int, bits: int = 1, *, as_disks_do: bool = True) -> None:
    """Change bits of a byte; disks keep the time."""
    before = file.stat()
    content = bytearray(file.read_bytes())
    content[at] ^= bits
    file.write_bytes(content)
    if as_disks_do:
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


def query_views(home: Path) -> dict[str, int] | str:
    """What a home answers, or the one line in which it says why it doesn't."""
    try:
        return answers(home)
    except (StoreError, FileNotFoundError, duckdb.Error) as error:
        return str(error)


def check_damage(whole: Whole, home: Path, trial: int) -> tuple[tuple[str, str, str], list[str]]:
    """What was done to a copy of the home, and the checks of `hdt doctor` that fail; no answer is wrong."""
    shutil.copytree(whole.home, home)
    done = damage(random.Random(trial), home, KINDS[trial % len(KINDS)])
    result = query_views(home)
    assert isinstance(result, str) or result == whole.answers, done
    wrong = [check.name for check in examine(None, home) if not check.well]
    assert wrong or done[0] in SILENT, done
    return done, wrong


def test_damage_gives_no_wrong_answer(whole, tmp_path):
    tally = Counter[tuple[str, ...]]()
    for trial in range(DAMAGES):
        done, wrong = check_damage(whole, tmp_path / "home", trial)
        tally[(*done[:2], "told" if wrong else "of no effect")] += 1
        shutil.rmtree(tmp_path / "home")
    print(dict(sorted(tally.items())))


@pytest.mark.parametrize("first", range(0, DAMAGES // 2, len(KINDS)))
def test_next_night_repairs_damage(whole, children, tmp_path, first):
    for trial in range(first, first + len(KINDS)):
        home = tmp_path / f"home{trial}"
        done, wrong = check_damage(whole, home, trial)
        ended, message = children.night(whole.landing, home)
        assert ended == 0, (done, message)
        assert "Traceback" not in message
        assert message or not wrong or done[0] in ("catalog", "history"), done
        if done[0] == "history" and wrong:  # a night without a run needs none; the line names `hdt tidy`
            assert replace_damaged_history(home)
        assert fingerprint(home) == whole.stored, (done, message)
        assert query_views(home) == whole.answers, (done, message)
        assert children.night(whole.landing, home) == (0, ""), done
        assert all(check.well for check in examine(None, home)), done
        shutil.rmtree(home)


def rot_copy(whole: Whole, home: Path, *tables: str) -> list[Path]:
    """A copy of the home with a bit flipped in the middle of a file of each table; these files."""
    shutil.copytree(whole.home, home)
    shards = {table: Store(home).tables.shards(table) for table in tables}
    files = [home / "tables" / t / max(f for s, f in shards[t].items() if s.startswith("QQX/Z8/")) for t in tables]
    for file in files:
        flip(file, file.stat().st_size // 3)
    return files


def test_night_repairs_file_doctor_names(whole, children, tmp_path):
    home = tmp_path / "home"
    rot_copy(whole, home, "features")
    (message,) = [check.message for check in examine(None, home) if not check.well]
    assert message.startswith("features/QQX/Z8/")
    assert message.endswith("`hdt nightly` writes it again")
    ended, report = children.night(whole.landing, home)
    assert (ended, report) == (0, "1 of 3 files of features were missing or changed: made again")
    assert fingerprint(home) == whole.stored
    assert answers(home) == whole.answers
    children.complete_night(whole.landing, home)


def test_idle_nights_notice_rot_in_turn(whole, children, tmp_path):
    home = tmp_path / "home"
    (file,) = rot_copy(whole, home, "residuals")  # read by no stored view: those are checked when a home has moved
    name = str(file.relative_to(home / "tables"))
    ledger = Ledger(home)
    while not seal.files_to_read([name], ledger.nights().height + 1):
        ledger.note_night(ledger.nights().row(-1))
    children.complete_night(whole.landing, home)
    ended, message = children.night(whole.landing, home)
    assert (ended, message) == (0, "1 of 3 files of residuals were missing or changed: made again")
    assert fingerprint(home) == whole.stored


def test_cycle_checks_each_file_once():
    names = [f"features/QQX/Z{n:03}/all.parquet" for n in range(1000)]
    turns = [seal.files_to_read(names, night) for night in range(7, 7 + seal.CYCLE)]
    assert sorted(name for turn in turns for name in turn) == names
    assert max(map(len, turns)) < 3 * len(names) / seal.CYCLE


def test_working_night_mends_rotten_tables(whole, children, tmp_path):
    """Of a raw table, of one whose rows others are made of, and of one that is made last."""
    clean = Path(shutil.copytree(whole.home, tmp_path / "clean"))
    home = tmp_path / "home"
    rot_copy(whole, home, "raw_snapshots", "twin_health", "features_margin")
    (home / "tables/raw_flights" / LOG / "_last_checkpoint").write_text('{"version": 7, "size": 3}')  # was 1
    children.complete_night(whole.later, clean)
    ended, message = children.night(whole.later, home)
    assert ended == 0, message
    for table in ("raw_snapshots", "twin_health", "features_margin"):
        assert f"of {table} were missing or changed: made again" in message
    assert fingerprint(home) == fingerprint(clean)
    assert answers(home) == answers(clean)


def test_rotten_file_gives_no_answer(whole, tmp_path):
    home = tmp_path / "home"
    rot_copy(whole, home, "features")
    with connect(home) as con:
        assert con.sql("select count(*) from flights").fetchall() == [(8,)]
        for what in ("* from features", "* from (select * from routes)", 'count(*) from tables."features"'):
            with pytest.raises(StoreError, match="is not what was written; `hdt nightly` makes it again"):
                con.execute(f"select {what}")


def test_unreadable_file_is_named(whole, tmp_path):
    home = tmp_path / "home"
    (file,) = rot_copy(whole, home, "raw_flights")
    flip(file, file.stat().st_size - 6)  # of the length of its footer
    (home / HASH).unlink()
    with pytest.raises(DamageError, match=r"raw_flights/QQX/Z8/.* is not what was written"):
        publish(home)
    assert Store(home).place.suspect
