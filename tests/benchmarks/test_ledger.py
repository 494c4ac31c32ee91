"""The ledger of constants: every prior and threshold stands in it, and a change of one reaches the code."""

import tomllib
from pathlib import Path

import polars as pl
import pytest

from benchmarks import chain, ledger
from benchmarks.changed_source import changed, numbers
from benchmarks.fleets import read_record
from benchmarks.harness import put
from pipelines.storage.store import Store

ROOMS = ("record", "alerts", "calibration", "flight", "health", "margin", "prognosis", "records", "tracking")
LEDGER = tomllib.loads(ledger.LEDGER.read_text())


def module_file(module: str) -> Path:
    return ledger.ROOT.joinpath(*module.split(".")).with_suffix(".py")


@pytest.mark.parametrize("constant", ledger.ledger(), ids=lambda c: f"{c.module}:{c.path}")
def test_entry_can_be_changed(constant):
    """Halved and doubled sources differ from the present ones, and compile."""
    source = module_file(constant.module).read_text()
    variants = [changed(source, constant.path, factor, constant.scale) for factor in ledger.FACTORS]
    for text in variants:
        compile(text, constant.module, "exec")
    assert len({source, *variants}) == 3
    assert constant.source


def test_ledger_lists_every_number():
    """As an entry, or among those that are settled, once."""
    entries = {f"{c.module.removeprefix('hdt_core.')}:{c.path}" for c in ledger.ledger()}
    listed = [name for names in LEDGER["settled"].values() for name in names]
    settled = set(listed)
    assert len(listed) == len(settled)
    there = set()
    house = ledger.ROOT / "hdt_core"
    for file in (f for room in ROOMS for f in (house / room).rglob("*.py")):
        module = ".".join(file.relative_to(house).with_suffix("").parts)
        there |= {f"{module}:{name}" for name in numbers(file.read_text())}
        there |= {f"{module}:*"} & settled
    lacking = {n for n in there - settled if not _entered(n, entries) and f"{n.split(':')[0]}:*" not in settled}
    assert lacking == set()
    assert settled - there == set()


def _entered(name: str, entries: set[str]) -> bool:
    return any(entry == name or entry.startswith(f"{name}.") for entry in entries)


@pytest.mark.parametrize(
    ("source", "path", "scale", "value"),
    [
        ("A, B = 1.5, 20", "B", "value", 40),
        ("A = {'x': (1.0, 0.5), 'y': (2.0, 0.25)}", "A.*.1", "value", {"x": (1.0, 1.0), "y": (2.0, 0.5)}),
        ("A = 0.9", "A", "complement", 0.8),
        ("class L:\n    A: float = 1 / 8", "L.A", "value", 0.25),
        ("A = dict(x=3, y=5)", "A.y", "value", {"x": 3, "y": 10}),
    ],
)
def test_only_named_constant_is_doubled(source, path, scale, value):
    space: dict = {}
    exec(changed(source, path, 2.0, scale), space)
    result = space["L"].A if "L." in path else space[path.split(".")[0]]
    assert result == value


def test_unknown_constant_is_refused():
    with pytest.raises(KeyError):
        changed("A = 1", "B", 2.0)


KEY = ["operator", "tail", "flight_id", "pack"]


@pytest.fixture(scope="module")
def tables(sample_home) -> dict[str, pl.DataFrame]:
    """What the chain makes of the sample's record in memory."""
    return chain.run(read_record(sample_home))


def joined_to_stored(rows: pl.DataFrame, home: Path, table: str, kind: str) -> pl.DataFrame:
    """Rows beside those that the night stored, one to one."""
    joined = rows.join(Store(home).read_table(table), on=[*KEY, kind], suffix="_stored", validate="1:1")
    assert joined.height == rows.height
    return joined


@pytest.mark.parametrize(
    ("name", "table", "kind", "column", "apart"),
    [
        ("health", "twin_health", "parameter", "value", 1e-9),
        ("health", "twin_health", "parameter", "sd", 1e-9),
        ("prognoses", "prognoses", "component", "rul_flights", 1e-6),
    ],
)
def test_chain_in_memory_equals_night(tables, sample_home, name, table, kind, column, apart):
    both = joined_to_stored(tables[name], sample_home, table, kind)
    assert (both[column] - both[f"{column}_stored"]).abs().max() < apart


def test_chain_raises_alerts_of_night(tables, sample_home):
    columns = ("alert_id", "raised_flight_id", "diagnosis")
    stored = Store(sample_home).read_table("features_alerts")
    assert set(tables["alerts"].select(columns).iter_rows()) == set(stored.select(columns).iter_rows())


def test_missing_run_keeps_published_cell(tmp_path, monkeypatch):
    page = tmp_path / "constants.md"
    results = tmp_path / "results.jsonl"
    page.write_text("<!-- ledger: begin -->\n<!-- ledger: end -->\n")
    monkeypatch.setattr(ledger, "PAGE", page)
    first, second = (f"{c.module}:{c.path}" for c in ledger.ledger()[:2])
    base = dict.fromkeys(ledger.MOVES, 1.0)

    def note(at: str, factor: float, **figures: float) -> None:
        ledger._note(results, {"fleet": "A", "at": at, "factor": factor, "figures": base | figures})

    note("", 1.0)
    note(first, 0.5, lead=50.0)
    put("ledger", ledger.table(results), page)
    note(second, 0.5, lead=-50.0)
    rows = [row for row in results.read_text().splitlines(keepends=True) if first not in row]
    results.write_text("".join(rows))
    put("ledger", ledger.table(results), page)
    text = page.read_text()
    assert text.count("lead +49") == text.count("lead -51") == 1
