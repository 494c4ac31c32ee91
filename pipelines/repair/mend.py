"""What of a home is not what was written: found before a night begins, told in a line each, and made again by it.

A file that is missing or changed is taken out of its table and its cells become stale; a damaged log is written anew
from the files. Of a computed stage all tables of an aircraft go together, since it goes on from what it has stored.
Disks change bits and keep size and time: a night reads a share of all files, and all once one was met that is damaged.
"""

import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import groupby
from pathlib import Path

import polars as pl

from hdt_core.tables import TABLES
from pipelines.intake.costs import COSTS
from pipelines.intake.findings import CASES, FINDINGS
from pipelines.lineage import FOLLOWED, MAKER, STAGES, Stage
from pipelines.storage import ledger_copy, seal
from pipelines.storage.cases import CaseLog
from pipelines.storage.data_file import hash_in
from pipelines.storage.delta import DamageError, shards_of
from pipelines.storage.files import LOG
from pipelines.storage.ledger import Ledger
from pipelines.storage.months import in_shard, without_folded
from pipelines.storage.store import EMPTY, FLEET, Aircraft, Store, shard_of
from pipelines.versions import made_as


def mend(landing: Path, store: Store, ledger: Ledger) -> list[str]:
    """Make stale what is damaged, put back what people said; a line for each thing that was."""
    told = _mend_tables(landing, store, ledger)
    if ledger.settled_as() != made_as(ledger, STAGES):  # else a night of this version has looked
        told += _mend_earlier(store, ledger)
    log = CaseLog(store.home).mend(store.read("raw_cases"))  # of tables that are whole again
    return [*told, log] if log else told


def _mend_earlier(store: Store, ledger: Ledger) -> Iterator[str]:
    """Convert or make again what earlier versions stored and this one would not: other types, keys more than once."""
    for table in TABLES:
        with suppress(DamageError):  # which whoever reads the table meets, and mends
            if n := store.retype(table):
                yield f"{n} files of {table} held other types than are declared: converted"
            for aircraft, n in store.doubled(table).items() if MAKER[table].group != "raw" else ():
                _make_again(store, ledger, table, aircraft)
                yield f"{n} keys of {table} stood more than once ({' '.join(aircraft).strip() or 'fleet'}): made again"


def _make_again(store: Store, ledger: Ledger, table: str, aircraft: Aircraft) -> None:
    """Let an aircraft's rows of a computed table be made again, and what follows from them."""
    begins = f"{shard_of(aircraft)}/" if aircraft != FLEET else "fleet"
    for stage in (s for s in STAGES if s is MAKER[table] or table in FOLLOWED[s.name]):
        ledger.forget(stage.tables, None if stage.grain == "fleet" else aircraft)
        _drop_tables(store, stage.tables if stage is MAKER[table] or stage.grain == "aircraft" else (), begins)


def _mend_tables(landing: Path, store: Store, ledger: Ledger) -> list[str]:
    told = [fault] if (fault := ledger_copy.mend(ledger)) else []
    if store.place.remote:
        return told
    held = seal.read(store.home)
    if held is None and ledger.snapshots():
        told.append(f"{seal.NAME} was gone or damaged: every table was read whole")
    lost = _changed(store, held, ledger) if held else _lost(store, ledger)
    for table, paths in groupby(sorted(lost), key=lambda path: path.split("/")[0]):
        told += _mend_table(landing, store, ledger, table, list(paths), held)
    if held and lost:
        seal.forget(store, held, set(lost), {path.split("/")[0] for path in lost if seal.is_log(path)})
    store.place.trust()
    return told


def _changed(store: Store, held: seal.Seal, ledger: Ledger) -> list[str]:
    """Sealed files that are not what was written, as far as size and time tell, or this night's share, or all."""
    read = seal.in_turn(held.files, ledger.nights().height)
    if store.place.doubted:
        read = set(held.files)
        for hint in Path(store.place.url).glob(f"*/{LOG}/{seal.HINT}"):
            hint.unlink()  # it is not sealed, and a wrong one keeps a log from being read
    rest = (path for path in held.files if path not in read)
    return [*seal.changed(store, held, rest), *seal.changed(store, held, sorted(read), whole=True)]


def _lost(store: Store, ledger: Ledger) -> list[str]:
    """Files that are not what was written where no seal says: every table is read, and must be as new as is known."""
    if not (store.home / seal.NAME).exists() and not ledger.snapshots():
        return []  # no night has ended yet
    return [path for table in TABLES for path in _lost_of(store, ledger, table)]


def _lost_of(store: Store, ledger: Ledger, table: str) -> list[str]:
    known = max((night.get(table, -1) for night in ledger.snapshots().values()), default=-1)
    try:
        held = store.tables.open(table)
    except DamageError:
        return [f"{table}/{LOG}"]
    if held is None or held.version() < known:
        return [f"{table}/{LOG}"] if known >= 0 else []
    return seal.changed(store, None, [f"{table}/{file}" for file in shards_of(held).values()], whole=True)


def _mend_table(
    landing: Path, store: Store, ledger: Ledger, table: str, lost: list[str], held: seal.Seal | None
) -> Iterator[str]:
    log = any(seal.is_log(path) for path in lost)
    if log:
        if not _write_log(store, table, held.tables.get(table) if held else None):
            _drop(store, MAKER[table])
        ledger.forget(MAKER[table].tables)
        ledger.forget_snapshots(table)
        yield f"the log of {table} was damaged: written anew, and {MAKER[table].name} is made again"
    files = {f"{table}/{file}" for file in store.tables.shards(table).values()}
    known = files.union(held.tables.get(table, ()) if held else ())
    gone, absent = [path for path in lost if path in known], set[str]()
    store.tables.drop(table, [path.removeprefix(f"{table}/") for path in gone])
    for path in lost:  # of no use to anybody, and noticed again otherwise
        if not seal.is_log(path):
            (Path(store.place.url) / path).unlink(missing_ok=True)
    for path in gone:
        absent |= _forget(landing, store, ledger, table, path.removeprefix(f"{table}/").rsplit(".", 2)[0])
    if gone:
        yield f"{len(gone)} of {len(known)} files of {table} were missing or changed: made again"
    if earlier := {path for path in lost if not seal.is_log(path)}.difference(gone):
        yield f"{len(earlier)} files of earlier nights of {table} were missing or changed"
    if absent:
        yield f"their rows came from files that have left the landing zone, put them back: {', '.join(sorted(absent))}"


def _forget(landing: Path, store: Store, ledger: Ledger, table: str, shard: str) -> set[str]:
    """Let the cells of a shard be stale; the delivered files they need that are not in the landing zone."""
    folder, _, name = shard.rpartition("/")
    if name == EMPTY:
        return set()
    aircraft = (folder.split("/")[0], folder.split("/")[1]) if folder else FLEET
    stage = MAKER[name.removeprefix("aside_") if name.startswith("aside_") else table]
    flights = _flights(ledger, table, aircraft, name) if stage is MAKER[table] else None
    ledger.forget(stage.tables, aircraft, flights)
    if stage.group == "raw":
        return _absent(landing, ledger, stage, aircraft, flights)
    _drop(store, stage, f"{folder}/" if folder else "fleet")
    return set()


def _drop(store: Store, stage: Stage, begins: str = "") -> None:
    """Let a computed stage begin anew, for all or one aircraft; one that goes flight by flight does so anyway."""
    _drop_tables(store, stage.tables if stage.grain != "flight" and stage.group != "raw" else (), begins)


def _drop_tables(store: Store, tables: Iterable[str], begins: str) -> None:
    for table in tables:
        shards = store.tables.shards(table).items()
        store.tables.drop(table, [f for s, f in shards if s.startswith(begins) and s != EMPTY])


def _flights(ledger: Ledger, table: str, aircraft: Aircraft, name: str) -> list[str] | None:
    """Flights of a shard; None above flights."""
    if TABLES[table].grain != "flight":
        return None
    cells = ledger.of([aircraft]).done(table).filter(operator=aircraft[0], tail=aircraft[1])
    return cells.with_columns(TABLES[table].shard_of).filter(in_shard(name))["flight_id"].to_list()


def _absent(landing: Path, ledger: Ledger, stage: Stage, aircraft: Aircraft, flights: Iterable[str] | None) -> set[str]:
    own = ledger.of([aircraft])
    kinds = {kind for recipe in stage.tables.values() for kind in recipe.files} - {CASES, FINDINGS, COSTS}
    held = own.flight_files() if flights is not None else own.files(kinds)
    held = held.filter(pl.col("kind").is_in(kinds), operator=aircraft[0], tail=aircraft[1])
    if flights is not None:
        held = held.filter(pl.col("flight_id").is_in(list(flights)))
    return {path for path in held["path"].unique() if not (landing / path).is_file()}


def _write_log(store: Store, table: str, files: list[str] | None) -> bool:
    """A table's log anew, over the files of the last night or else the last whole file of each shard.

    Whether the files of the last night are known and whole.
    """
    root = Path(store.place.url) / table
    shutil.rmtree(root / LOG, ignore_errors=True)
    there = sorted(root.rglob("[!.]*.parquet"), key=lambda path: path.stat().st_mtime_ns)
    wanted = [str(path.relative_to(store.place.url)) for path in there] if files is None else files
    lost = seal.changed(store, None, wanted, whole=True)
    whole = [file.removeprefix(f"{table}/") for file in wanted if file not in lost]
    shards = {f.removesuffix(f".{hash_in(f)}.parquet"): f for f in whole if hash_in(f)}
    for _, own in groupby(sorted(shards.items()), key=lambda item: item[0].rpartition("/")[0]):
        frames = {shard: pl.read_parquet(root / file) for shard, file in own}
        store.tables.put(table, without_folded(TABLES[table], frames))
    return files is not None and not lost
