"""The catalog is that of the last night, whatever stops its publication or is put in its place."""

import os
import shutil
import signal
from pathlib import Path

import pytest
from command import hdt
from soundness import answers, state
from zones import drop_fleet, simulated

from pipelines.storage.catalog import CATALOG, open_catalog
from pipelines.storage.files import LOG
from pipelines.storage.publication import HASH

ZONE = simulated(5, 4, operator="QQX", tail="Z9")


@pytest.fixture(scope="module")
def two(children, tmp_path_factory) -> Path:
    """A landing zone, a home after two nights over it, and that home after the first. Read only."""
    root = tmp_path_factory.mktemp("two")
    landing = root / "landing"
    home = children.home(root / "home")
    drop_fleet(landing, [ZONE])
    ZONE.drop_papers(landing)
    ZONE.only(ZONE.flights[:3]).drop_csv(landing)
    children.complete_night(landing, home)
    shutil.copytree(home, root / "earlier")
    ZONE.drop_csv(landing)
    children.complete_night(landing, home)
    return root


@pytest.fixture
def own(two, tmp_path) -> Path:
    return Path(shutil.copytree(two, tmp_path / "own", copy_function=shutil.copy2))


@pytest.fixture(scope="module")
def third(two, children, tmp_path_factory) -> Path:
    """The same after a third night, over a flight that came again. Read only."""
    root = Path(shutil.copytree(two, tmp_path_factory.mktemp("third") / "root", copy_function=shutil.copy2))
    redeliver(root / "landing")
    children.complete_night(root / "landing", root / "home")
    return root


def doctor_code(home: Path) -> int:
    return hdt("doctor", "--home", home).returncode


def test_stopped_publication_is_completed(own, third, children):
    """The night is killed when all its tables are stored."""
    home = own / "home"
    children.complete_night(own / "landing", home)  # the catalog is of this place now
    assert children.night(third / "landing", home, fault="before_publish:1")[0] == signal.SIGKILL
    assert doctor_code(home) == 1
    children.complete_night(third / "landing", home)
    assert answers(home) == answers(third / "home")


def test_earlier_catalog_does_not_answer(own):
    shutil.copyfile(own / "earlier" / CATALOG, own / "home" / CATALOG)
    answer = hdt("query", "select count(*) from flights", "--home", own / "home")
    assert answer.returncode == 2
    assert "is not that of the last night; `hdt nightly` publishes it again" in answer.stderr


@pytest.mark.parametrize("names", [(CATALOG,), (CATALOG, HASH)], ids=["alone", "with its hash"])
def test_earlier_catalog_is_replaced(own, two, children, names):
    for name in names:
        shutil.copyfile(own / "earlier" / name, own / "home" / name)
    assert doctor_code(own / "home") == 1
    children.complete_night(own / "landing", own / "home")
    assert state(own / "home") == state(two / "home")


def test_idle_night_publishes_nothing(own, children):
    children.complete_night(own / "landing", own / "home")  # the catalog is of this place now
    before = (own / "home" / CATALOG).stat().st_ino
    children.complete_night(own / "landing", own / "home")
    assert (own / "home" / CATALOG).stat().st_ino == before


@pytest.mark.parametrize("name", ["features_witnesses", "twin_components"])
def test_former_tables_are_gone(own, name):
    answer = hdt("query", f"select count(*) from tables.{name}", "--home", own / "home")
    assert f"Table with name {name} does not exist" in answer.stderr


@pytest.mark.parametrize("table", ["tables.features", "query_table('tables.' || 'features')"])
def test_swapped_files_do_not_answer(own, table):
    with open_catalog(own / "home") as con:
        files = con.execute("select path from tables.files where path like 'features/%' order by path").fetchall()
    one, other = (own / "home/tables" / path for (path,) in files[:2])
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    answer = hdt("query", f"select count(*) from {table}", "--home", own / "home")
    assert "is not what was written" in answer.stderr


def test_doubled_shard_is_made_again(own, third, children):
    """A bit flips in the log, in the name of the file that a commit removes; size and time stay."""
    home = own / "home"
    commit = max(file for file in home.glob(f"tables/legs_samples/{LOG}/*.json") if '"remove"' in file.read_text())
    flip_removed(commit)
    ended, repairs = children.night(third / "landing", home)
    assert (ended, state(home)) == (0, state(third / "home"))
    assert "the log of legs_samples was damaged" in repairs


def flip_removed(commit: Path) -> None:
    """Change a letter of the hash in a removed file's name."""
    before = commit.stat()
    content = commit.read_text()
    start = content.index('"path":"', content.index('"remove"'))
    place = content.index(".parquet", start) - 1
    letter = "1" if content[place] == "0" else "0"
    commit.write_text(content[:place] + letter + content[place + 1 :])
    os.utime(commit, ns=(before.st_atime_ns, before.st_mtime_ns))


def redeliver(landing: Path) -> None:
    """Take a row from the newest flight."""
    file = max(ZONE.folder(landing).glob("acms/*.csv"))
    file.write_text("\n".join(file.read_text().splitlines()[:-1]) + "\n")
