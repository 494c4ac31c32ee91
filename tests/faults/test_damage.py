"""Files of a home deleted, cut, exchanged or with a bit flipped: never a wrong answer, told, and mended by a night.

`HDT_SOAK_DAMAGES` sets how many; `make soak` has far more than there is time for in CI.
"""

import os
import random
import shutil
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import duckdb
import polars as pl
import pytest
from soundness import PROMISED
from zones import drop_fleet, simulated

from benchmarks.fingerprint import fingerprint
from pipelines.cli.doctor import examine
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.files import LOG
from pipelines.storage.history import set_aside
from pipelines.storage.objects import StoreError

DAMAGES = int(os.environ.get("HDT_SOAK_DAMAGES", "14"))
KINDS = ("data", "log", "all files of a table", "ledger", "catalog", "history", "seal")
WAYS = ("delete", "truncate", "swap", "flip")
SILENT = ("catalog", "history")
"""A bit of these may flip where nothing is read: DuckDB and SQLite leave room."""


@dataclass(frozen=True)
class Whole:
    """Two aircraft of four flights, a home after two nights over them, and what it answers. Read only."""

    landing: Path
    home: Path
    stored: dict[str, str]
    answers: dict[str, int]


@pytest.fixture(scope="module")
def whole(children, tmp_path_factory) -> Whole:
    root = tmp_path_factory.mktemp("whole")
    landing, home = root / "landing", children.home(root / "home")
    zones = [simulated(seed, 4, operator="QQX", tail=tail) for seed, tail in ((5, "Z9"), (6, "Z8"))]
    drop_fleet(landing, zones)
    for zone in zones:
        zone.only(zone.flights[:3]).drop_csv(landing)
        zone.drop_papers(landing)
    assert children.night(landing, home) == (0, "")
    for zone in zones:
        zone.only(zone.flights[3:]).drop_csv(landing)
    assert children.night(landing, home) == (0, "")
    return Whole(landing, home, fingerprint(home), answers(home))


def answers(home: Path) -> dict[str, int]:
    """What each promised view answers, as a sum over its rows."""
    found = {}
    with connect(home) as con:
        for view in PROMISED:
            frame = con.sql(f"from {view}").pl().select(pl.exclude("received_at").cast(pl.String, strict=False))
            found[view] = frame.hash_rows().sum()
    return found


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
        one, two = file.read_bytes(), other.read_bytes()
        file.write_bytes(two)
        other.write_bytes(one)
    else:
        way, content = "flip", bytearray(file.read_bytes())
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        file.write_bytes(content)
    return kind, way, str(file.relative_to(home))


def asked(home: Path) -> dict[str, int] | str:
    """What a home answers, or the one line in which it says why it doesn't."""
    try:
        return answers(home)
    except (StoreError, FileNotFoundError, duckdb.Error) as error:
        return str(error)


def noticed(whole: Whole, home: Path, trial: int) -> tuple[tuple[str, str, str], list[str]]:
    """What was done to a copy of the home, and the checks of `hdt doctor` that fail; no answer is wrong."""
    shutil.copytree(whole.home, home)
    done = damage(random.Random(trial), home, KINDS[trial % len(KINDS)])
    said = asked(home)
    assert isinstance(said, str) or said == whole.answers, done
    wrong = [check.name for check in examine(None, home) if not check.well]
    assert wrong or done[0] in SILENT, done
    return done, wrong


def test_no_damage_gives_a_wrong_answer_or_none_without_a_word(whole, tmp_path):
    tally = Counter[tuple[str, ...]]()
    for trial in range(DAMAGES):
        done, wrong = noticed(whole, tmp_path / "home", trial)
        tally[(*done[:2], "told" if wrong else "of no effect")] += 1
        shutil.rmtree(tmp_path / "home")
    print(dict(sorted(tally.items())))


@pytest.mark.parametrize("first", range(0, DAMAGES // 2, len(KINDS)))
def test_the_next_night_repairs_it(whole, children, tmp_path, first):
    for trial in range(first, first + len(KINDS)):
        home = tmp_path / f"home{trial}"
        done, wrong = noticed(whole, home, trial)
        ended, told = children.night(whole.landing, home)
        assert ended == 0, (done, told)
        assert "Traceback" not in told
        assert told or not wrong or done[0] in ("catalog", "history"), done
        if done[0] == "history" and wrong:  # a night without a run needs none; the line names `hdt tidy`
            assert set_aside(home)
        assert fingerprint(home) == whole.stored, (done, told)
        assert asked(home) == whole.answers, (done, told)
        assert children.night(whole.landing, home) == (0, ""), done
        assert all(check.well for check in examine(None, home)), done
        shutil.rmtree(home)
