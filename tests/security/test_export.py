"""What leaves the home: no other operator's tail, under pseudonyms no tail at all, no key, no formula; whole or not."""

import csv
import io
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import duckdb
import polars as pl
import pytest
from command import hdt
from hostile import FORMULA
from hypothesis import given
from hypothesis import strategies as st
from nights import empty_home, once

from hdt_core.tables import TABLES
from pipelines.sharing import FORMATS, MANIFEST, AccessScope, access_scope, export, safe
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.publication import publish
from pipelines.storage.store import FLEET, Store
from pipelines.storage.view_headers import tables_read, views

KEY = b"canary-key-5e0d-tell-nobody"
OWN = ("AQX", "LX-AAB")
OTHER = ("BZR", "A9-BAC")
EVERYTHING = AccessScope(None, None, frozenset(), frozenset(), frozenset())
NUMBER = re.compile(r"-?\d+(\.\d+)?(e[+-]?\d+)?")


@pytest.fixture(scope="session")
def home(sample_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first flights of the sample home, in which both aircraft are named wherever text can name them."""
    return once(tmp_path_factory, "named", lambda home: _name_both(sample_home, home))


def _name_both(sample_home: Path, home: Path) -> None:
    store = empty_home(home)
    for table in tables_read():
        _take_first(Store(sample_home), store, table)
    for own, other in ((OWN, OTHER), (OTHER, OWN)):
        mention = f"{own[1]}, {own[1].replace('-', '').lower()} and {other[1]}X, not {other[1].lower()} of {other[0]}"
        _change(store, "features_alerts", own, pl.col("evidence") + mention)
        _change(store, "raw_messages", own, pl.lit(mention).alias("text"))
        _change(store, "raw_maintenance", own, pl.concat_str("reference", pl.lit(f"/{own[1]}")))
        entry = _refused(f"{own[0]}/{own[1]}/acms/{other[1]}_20240401_01.csv", mention).with_columns(
            operator=pl.lit(own[0]), tail=pl.lit(own[1]), flight_id=pl.lit(f"{own[1]}_20240401_01")
        )
        store.replace("raw_records_quarantine", [own], entry)
    files = ("fleet.csv", "AQX/lx_aab.csv", "BZR/a9_bac.csv", "AQX/Q9-ZZZ.csv")
    store.replace("raw_files_quarantine", [FLEET], pl.concat([_refused(f, f"{OWN} {OTHER}") for f in files]))
    publish(home)


def _take_first(source: Store, target: Store, table: str) -> None:
    whole = source.read_table(table)
    first = whole
    if "flight_id" in whole.columns and table not in ("raw_messages", "raw_quarantine"):
        first = whole.filter(pl.col("flight_id").is_null() | (pl.col("flight_id").str.slice(-11, 8) < "20240309"))
    if TABLES[table].grain == "fleet":
        target.replace(table, [FLEET], first)
        return
    for (operator, tail), rows in first.partition_by("operator", "tail", as_dict=True).items():
        target.replace(table, [(operator, tail)], rows)


def _change(store: Store, table: str, aircraft: tuple[str, str], change: pl.Expr) -> None:
    frame = store.read_table(table, [aircraft])
    assert frame.height
    store.replace(table, [aircraft], frame.with_columns(change))


def _refused(file: str, text: str) -> pl.DataFrame:
    noted = {"file": file, "row": 2, "column_name": text, "reason": "bad_key", "detail": text, "scope": "row"}
    return pl.DataFrame(noted | {"received_at": datetime(2024, 4, 1, tzinfo=UTC), "n_rows": 0, "content": text})


@dataclass(frozen=True)
class Export:
    """An export and all it says, in plain text and as it lies on the disk."""

    folder: Path

    @property
    def rows(self) -> dict[str, int]:
        return json.loads((self.folder / MANIFEST).read_text())["rows"]

    def read_all(self) -> bytes:
        """All its bytes and all its text, in small letters without hyphens."""
        raw = b"\n".join(f.read_bytes() for f in self.folder.iterdir())
        names = [*views(), *(f"tables.{t}" for t in tables_read() if (self.folder / CATALOG).exists())]
        texts = (frame.select(pl.selectors.string()).write_csv().encode() for frame in self.frames(*names))
        return (raw + b"\n".join(texts)).lower().replace(b"-", b"")

    def frames(self, *names: str) -> Iterator[pl.DataFrame]:
        if (self.folder / CATALOG).exists():
            with duckdb.connect(str(self.folder / CATALOG), read_only=True) as con:
                yield from (con.sql(f"select * from {view}").pl() for view in names)
            return
        for file in (next(self.folder.glob(f"{view}.*")) for view in names):
            yield pl.read_parquet(file) if file.suffix == ".parquet" else pl.read_csv(file, infer_schema=False)

    def frame(self, view: str) -> pl.DataFrame:
        return next(self.frames(view))


@pytest.fixture(scope="session")
def given_away(home, tmp_path_factory):
    """An export, made once."""

    def give(operator: str | None, key: bytes | None, form: str) -> Export:
        name = f"given-{operator}-{key is not None}-{form}"
        scope = access_scope(home, operator, key)
        return Export(once(tmp_path_factory, name, lambda folder: export(home, folder, scope, form)))

    return give


def spelt(name: str) -> bytes:
    return name.lower().replace("-", "").encode()


@pytest.mark.parametrize("form", FORMATS)
def test_operator_gets_only_own_rows(given_away, form):
    own_export = given_away("AQX", None, form)
    content = own_export.read_all()
    assert spelt(OTHER[1]) not in content
    assert re.findall(rb".{0,40}\bbzr\b.{0,20}", content) == []
    assert spelt(OWN[1]) in content
    for view in ("flights", "legs", "health_parameters", "prognoses", "alerts", "fleet_ranking", "design_parameters"):
        assert set(own_export.frame(view)["operator"]) == {"AQX"}, view
    assert "AQX/lx_aab.csv" in own_export.frame("quarantine")["file"]


@pytest.mark.parametrize(("operator", "form"), [(None, "parquet"), (None, "duckdb"), ("AQX", "csv")])
def test_pseudonymised_export_identifies_nobody(given_away, home, operator, form):
    content = given_away(operator, KEY, form).read_all()
    assert [t for t in ("LX-AAB", "LX_AAB", "A9-BAC", "A9_BAC", "Q9-ZZZ", KEY.decode()) if spelt(t) in content] == []
    with connect(home) as con:  # an unkeyed hash of a tail, a work order or a serial number leads back as well
        secrets = con.execute("select alert_id from alerts union select msn from tables.raw_fleet").fetchall()
        works = con.execute("select reference from tables.raw_maintenance where reference is not null").fetchall()
    words = set(re.findall(rb"\w+", content))
    assert [s for (s,) in (*secrets, *works) if spelt(s) in words] == []


@pytest.fixture
def plain(given_away):
    return given_away(None, None, "parquet")


@pytest.fixture
def masked(given_away):
    return given_away(None, KEY, "parquet")


def test_pseudonyms_keep_every_row(plain, masked):
    assert plain.rows == masked.rows


@pytest.mark.parametrize("view", ["health_parameters", "residuals", "features", "fleet_ranking"])
def test_pseudonyms_keep_numbers(plain, masked, view):
    before, after = (f.frame(view).select(pl.selectors.numeric()).sort(pl.all()) for f in (plain, masked))
    assert before.equals(after)


@pytest.mark.parametrize(("view", "flight"), [("flights", "flight_id"), ("alerts", "raised_flight_id")])
def test_pseudonyms_replace_tails(masked, view, flight):
    names = masked.frame(view)
    assert names["tail"].str.contains(r"^P[A-Z2-7]{9}$").all()
    assert names.filter(~pl.col(flight).str.starts_with(pl.col("tail") + "_")).is_empty()


def test_pseudonyms_still_join_views(plain, masked):
    together = masked.frame("flights").join(masked.frame("legs"), on=["operator", "tail", "flight_id"])
    assert together.height == plain.rows["legs"]


def test_pseudonym_depends_on_key_alone(home):
    one, two = (access_scope(home, o, KEY).pseudonym("LX-AAB") for o in (None, "AQX"))
    assert one == two != access_scope(home, None, KEY[::-1]).pseudonym("LX-AAB")


def test_formats_export_same_values(given_away):
    frames = [given_away("AQX", None, f).frame("health_parameters") for f in FORMATS]
    keys = [pl.col(k).cast(pl.String) for k in ("flight_id", "pack", "parameter")]
    first, *others = (f.sort(*keys)["value"].cast(pl.Float64) for f in frames)
    assert [first.equals(other) for other in others] == [True, True]


def test_exported_cell_is_no_formula(watched, tmp_path):
    export(watched.home, tmp_path / "out", EVERYTHING, "csv")
    files = (io.StringIO(f.read_bytes().decode(), newline="") for f in (tmp_path / "out").glob("*.csv"))
    cells = [c for f in files for row in csv.reader(f) for c in row]
    assert [c for c in cells if c[:1] in "=+-@\t\r" and c and not NUMBER.fullmatch(c)] == []
    assert any(FORMULA in c for c in cells)


@given(text=st.text(), number=st.floats(allow_nan=False, allow_infinity=False))
def test_exported_text_is_harmless(text, number):
    frame = pl.DataFrame({"text": [text], "number": [number]})
    written = safe(frame)
    (_, (cell, value)) = csv.reader(io.StringIO(written.write_csv(quote_style="non_numeric"), newline=""))
    assert cell in (text, "'" + text)
    assert cell[:1] not in tuple("=+-@\t\r\n")
    assert float(value) == number


KILLED = "from benchmarks.fault_points import arm; arm('before_rename:1'); from pipelines.cli import main; main()"


def kill_export(home: Path, out: Path) -> None:
    """Export flights in a process that is killed before its first file has its name."""
    words = ["export", "--home", home, "--view", "flights", "--out", out]
    assert subprocess.run([sys.executable, "-c", KILLED, *words], capture_output=True, check=False).returncode < 0


def test_killed_export_leaves_nothing(home, tmp_path):
    """What it left half done goes with the next."""
    out = tmp_path / "out"
    kill_export(home, out)
    assert not out.exists()
    assert hdt("export", "--home", home, "--view", "flights", "--out", out).returncode == 0
    assert [f.name for f in tmp_path.iterdir()] == ["out"]


def test_killed_export_keeps_earlier_one(home, tmp_path, monkeypatch):
    """Until the next export takes the place of both."""
    out = tmp_path / "out"
    words = ["export", "--home", home, "--view", "flights", "--out", out]
    assert hdt(*words).returncode == 0
    before = (out / "flights.parquet").read_bytes()
    kill_export(home, out)
    assert (out / "flights.parquet").read_bytes() == before
    monkeypatch.setenv("HDT_EXPORT_KEY", KEY.decode())
    assert hdt(*words, "--pseudonymise", "--format", "csv").returncode == 0
    assert {f.name for f in out.iterdir()} == {"flights.csv", MANIFEST}, "the earlier export is gone"
    assert [f.name for f in tmp_path.iterdir()] == ["out"], "and so is what killed ones left"


@pytest.mark.parametrize("target", ["mine", "link", "mine/thesis.txt"])
def test_foreign_files_are_not_overwritten(home, tmp_path, target):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("x")
    (tmp_path / "link").symlink_to(mine)
    with pytest.raises(FileExistsError, match="is not overwritten"):
        export(home, tmp_path / target, EVERYTHING, "csv", ["flights"])
    assert [f.name for f in mine.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("place", [".", "x", "tables/export", "../{name}/x"])
def test_export_stays_out_of_home(home, place):
    folder = home / place.format(name=home.name)
    with pytest.raises(ValueError, match="lies in the home"):
        export(home, folder, EVERYTHING, "csv", ["flights"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--operator", "XXX"), "no operator XXX in"),
        (("--operator", "A' or 1=1 --"), "no operator A' or 1=1 -- in"),
        (("--view", "../flights"), "no view ../flights; the catalog has"),
        (("--pseudonymise",), "pseudonyms need a key"),
        (("--pseudonymise", "--key-file", "short"), "could be guessed"),
        (("--key-file", "short"), "a key is for --pseudonymise"),
        (("--format", "duckdb", "--view", "flights"), "leave --view out"),
    ],
    ids=lambda w: " ".join(w) if isinstance(w, tuple) else "",
)
def test_wrong_export_takes_one_line(home, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HDT_EXPORT_KEY", raising=False)
    Path("short").write_text("canary-key")
    done = hdt("export", "--home", home, "--out", tmp_path / "out", *words)
    assert done.returncode == 2
    stderr = done.stderr
    assert message in stderr
    assert len(stderr.splitlines()) == 1
    assert "canary" not in stderr.replace(str(tmp_path), "").replace(str(home), "")
    assert not (tmp_path / "out").exists()


PAGE = (Path(__file__).parents[2] / "docs/catalog.md").read_text()
READERS = dict(re.findall(r"^```python\n((?:import (\w+).*\n)(?:.*\n)*?)^```", PAGE, re.MULTILINE))


@pytest.mark.parametrize("code", READERS, ids=READERS.values())
def test_page_examples_run(given_away, tmp_path, monkeypatch, code):
    pytest.importorskip(READERS[code])
    for name, form in (("out", "parquet"), ("csv", "csv"), ("aqx", "duckdb")):
        (tmp_path / name).symlink_to(given_away("AQX", None, form).folder)
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    exec(code, namespace)
    answers = {k: v for k, v in namespace.items() if k in ("worst", "last_departure", "alerts", "lives", "own")}
    assert answers
    assert all(len(v) for v in answers.values() if hasattr(v, "__len__"))
