"""A landing zone flown month by month and the same one taken in at once give the same rows."""

import shutil
from pathlib import Path

import polars as pl
import pytest
from nights import run

from docs.hindsight import REVISIONS
from pipelines.storage.catalog import connect

NIGHTS = ("20240401", "20240501", "20240601", "20250101")
"""Each sees what had come before that day; on the first the commissioning windows are not flown yet."""
KEY = ["operator", "tail", "flight_id", "pack", "component"]
OF_TONIGHT = {"open_alerts", "tables.prognosis_choices"}
"""Views and tables whose rows are of each unit's last flight, or of what is open after it."""
AT_HOME = {"tables.prognosis_model": ["service"]}


def land(source: Path, landing: Path, end: str) -> None:
    """What had come of a landing zone by a day: flights that departed, and lines that were written, before it."""
    for file in (f for f in sorted(source.rglob("*")) if f.is_file()):
        target = landing / file.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        if file.name in ("messages.csv", "maintenance.csv"):
            head, *lines = file.read_text().splitlines()
            earlier = [line for line in lines if line[:10].replace("-", "") < end]
            target.write_text("\n".join([head, *earlier]) + "\n")
        elif _day(file) < end:
            shutil.copy2(file, target)


def _day(file: Path) -> str:
    """Of a file of flights the day of the first."""
    if file.stem.startswith("history_"):
        return file.stem.removeprefix("history_").replace("-", "") + "01"
    return file.stem.split("_")[-2] if file.parent.name in ("acms", "cpl") else ""


Tables = dict[str, pl.DataFrame]


def read(home: Path) -> Tables:
    """All views, and all tables as `tables.NAME`; which files hold them is no matter."""
    with connect(home) as con:
        names = con.execute("select table_schema, table_name from information_schema.tables").fetchall()
        frames = {(s, n): con.sql(f'select * from {s}."{n}"').pl() for s, n in names if (s, n) != ("tables", "files")}
    return {name if schema == "main" else f"{schema}.{name}": frame for (schema, name), frame in frames.items()}


@pytest.fixture(scope="module")
def at_once(sample_home) -> Tables:
    return read(sample_home)


@pytest.fixture(scope="module")
def nights(sample_landing, tmp_path_factory) -> dict[str, Tables]:
    """What each night's catalog held."""
    root = tmp_path_factory.mktemp("nights")
    catalogs = {}
    for end in NIGHTS:
        land(sample_landing, root / "landing", end)
        night = run(root / "landing", root / "home")
        assert not night.failed, night.failed
        catalogs[end] = read(root / "home")
    return catalogs


def differences(one: pl.DataFrame, other: pl.DataFrame) -> list[str]:
    """Columns in which two frames differ, numbers by more than 1e-9."""
    if one.shape != other.shape:
        return [f"{one.height} rows for {other.height}"]
    order = [c for c, kind in one.schema.items() if not kind.is_float() and not kind.is_nested()]
    one, other = (frame.sort(order, maintain_order=True) for frame in (one, other))
    return [name for name in one.columns if not _same(one[name], other[name])]


def _same(one: pl.Series, other: pl.Series) -> bool:
    if one.dtype.is_float():
        far = (one - other).abs().max()
        return one.is_null().equals(other.is_null()) and (far is None or far <= 1e-9)
    return one.equals(other)


def test_monthly_nights_end_the_same(nights, at_once):
    last = nights[NIGHTS[-1]]
    assert last.keys() == at_once.keys()
    assert len(at_once) > 80
    free = {n: at_once[n].drop(AT_HOME.get(n, [])) for n in at_once}
    by_table = {n: differences(last[n].select(frame.columns), frame) for n, frame in free.items()}
    assert not {n: columns for n, columns in by_table.items() if columns}
    assert last["prognoses"].height > 2500


def test_later_nights_revise_no_row(nights, at_once):
    """Each night's rows of flights up to it are those of the whole record, but for what is declared."""
    version = at_once["tables.calibration_dsm"]["dsm_version"]
    settled = [end for end in NIGHTS[:-1] if nights[end]["tables.calibration_dsm"]["dsm_version"].equals(version)]
    assert settled == list(NIGHTS[1:-1])
    by_night = {}
    compared = set()
    for end in settled:
        for name, whole in at_once.items():
            day = None if name in OF_TONIGHT else _day_of_row(name, whole)
            if day is not None:
                compared.add(name)
                one, other = (_standing(name, frame.filter(day < end)) for frame in (nights[end][name], whole))
                if name == "prognosis_outcomes":  # its rows end where an event's came to be on record
                    one = one.join(other, on=KEY, how="semi")
                    assert one.height > 0.9 * other.height
                    other = other.join(one, on=KEY, how="semi")
                by_night[end, name] = differences(one, other)
    assert not {place: columns for place, columns in by_night.items() if columns}
    assert compared >= {"prognoses", "features", "health_parameters", "residuals", "alerts", "training_set", "as_of"}
    assert compared >= {"prognosis_outcomes", "unit_lives", "tables.prognosis_model", "tables.raw_messages"}
    assert {name.removeprefix("tables.") for name in compared} >= {t for r in REVISIONS for t in r.tables}


def _day_of_row(name: str, frame: pl.DataFrame) -> pl.Expr | None:
    """The day that a row speaks of, as YYYYMMDD; None where it speaks of no flight, alert, life or month."""
    if "on_date" in frame.columns:
        return pl.col("on_date").dt.strftime("%Y%m%d")
    if "flight_id" in frame.columns:
        return pl.col("flight_id").str.slice(-11, 8)
    moment = {"alerts": "raised_at", "lives": "first_departed_at", "model": "month"}.get(name.rpartition("_")[2])
    return pl.col(moment).dt.strftime("%Y%m%d") if moment in frame.columns else None


def _standing(name: str, frame: pl.DataFrame) -> pl.DataFrame:
    """A table without what is declared to change."""
    table = name.removeprefix("tables.")
    revised = {column for revision in REVISIONS if table in revision.tables for column in revision.names}
    if "parameter" in frame.columns:
        return frame.filter(~pl.col("parameter").is_in(revised))
    return frame.drop(c for c in frame.columns if c in revised)
