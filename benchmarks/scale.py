"""Cost of a first night by size of the fleet: `python -m benchmarks.scale [S M L] [--rounds N] [--alone] [--write]`.

S, M, L: 1,000, 10,000 and 100,000 flights of the project's own simulator, as history files. Claims: Dagster's share of
the processor at most 10 %, cost that grows with an exponent of at most 1.05, a first night of L in 10 minutes, peak
memory at most 2 GB, an idle night in 5 s, the fleet's ranking in 100 ms. Dagster's share is taken within one night in
one process (benchmarks/bookkeeping.py); beside it stands the same chain without Dagster, asset by asset and batch by
batch: same functions, same store, same ledger. Every contestant is a process of its own, in turn; medians. `--write`
puts the table into docs/scale.md.
"""

import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date, timedelta
from multiprocessing import forkserver
from pathlib import Path
from statistics import median
from types import SimpleNamespace

import dagster as dg
import polars as pl

from benchmarks.bookkeeping import bookkeeping
from benchmarks.harness import arguments, machine, show
from hdt_core.simulate.design import FleetSettings
from pipelines import partitions
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import around_night, nightly, runs
from pipelines.orchestration.batches import BatchResult, PartitionBatch, PartitionIndex, by_aircraft
from pipelines.orchestration.local_executor import cores
from pipelines.partitions import PartitionScope
from pipelines.resources import FrameIO
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import publish

SIZES = {
    "S": FleetSettings(operators=2, tails=2, flights=250),
    "M": FleetSettings(operators=4, tails=5, flights=500),
    "L": FleetSettings(operators=5, tails=10, flights=2000),
}
NEW_FLIGHTS = 100
_WHO = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
PAGE = Path(__file__).parents[1] / "docs" / "scale.md"
COLUMNS = "flight_id", "pack", "report_time", "hx_in_degc", "hx_out_degc", "tat_degc", "pack_flow_lbpm", "ram_door_pct"


class Silent:
    """Progress without output."""

    def start(self, label: str, total: int) -> None:
        """A step begins."""

    def advance(self, cells: int) -> None:
        """Some of it is done."""


class Bare:
    """A runner that calls the assets' functions itself, with no run, event or partition of Dagster's."""

    def __init__(self, defs: dg.Definitions, instance: object, ledger: Ledger, by: object) -> None:
        self.defs, self.ledger, self.keys = defs, ledger, {"aircraft": [], "flight": []}

    def fail_orphaned_runs(self) -> None:
        """Nothing was recorded."""

    def register(self, cells: pl.DataFrame) -> None:
        """Know these partitions."""
        aircraft = {partitions.aircraft_key(o, t) for o, t in cells.select("operator", "tail").unique().rows()}
        flights = {partitions.flight_key(f) for f in cells["flight_id"].unique() if f}
        self.keys["aircraft"] = sorted(aircraft | set(self.keys["aircraft"]))
        self.keys["flight"] = sorted(flights | set(self.keys["flight"]))

    def partition_index(self, cells: pl.DataFrame | None = None) -> PartitionIndex:
        """Partitions as they are now, and who flew which."""
        return PartitionIndex(self.keys["aircraft"], self.keys["flight"], by_aircraft(self.ledger.flights_on_file()))

    def make(self, tables: list[str], batch: PartitionBatch, label: str) -> BatchResult:
        """Compute, store and mark the tables."""
        cells = batch.partition_keys() or None
        home, scope = self.defs.resources["home"], PartitionScope.of(cells)
        keeper = FrameIO(home.store, home.ledger)
        context = SimpleNamespace(has_partition_key_range=cells is not None, partition_keys=cells)
        for node in _nodes(self.defs, tables):
            for output in node.op.compute_fn.decorated_fn(context, home):
                if isinstance(output, dg.Output):
                    keeper.store_frame(output.output_name, scope, output.value)
        return BatchResult(batch.size, 1)


def night(landing: Path, home: Path, shared: bool = True) -> None:
    """Run a night as `hdt nightly` does, in parallel where that pays."""
    with around_night.lock_home(home):
        done = nightly.run_night(landing, home, Silent(), jobs=cores() if shared else 1)
        assert not done.failed, done.failed
        if not done.idle:
            publish(home)


def alone(landing: Path, home: Path) -> dict[str, float]:
    """Run a night in one process and measure Dagster's bookkeeping."""
    with bookkeeping() as seconds:
        night(landing, home, shared=False)
        return {"dagster_s": seconds()}


def bare(landing: Path, home: Path) -> None:
    """Run a night without Dagster."""
    runs.open_instance = lambda home: None
    runs.Runner = Bare
    night(landing, home, shared=False)


def _nodes(defs: object, tables: list[str]) -> list:
    """The assets that make the tables, in the order in which the tables are named."""
    by_table = {key.path[0]: asset for asset in defs.assets for key in asset.keys if len(key.path) == 1}  # no views
    return list({id(by_table[t]): by_table[t] for t in tables}.values())


def scan(landing: Path, home: Path) -> None:
    """The peer of ingest to health: a bare Polars scan of the columns that the chain reads."""
    files = sorted(landing.glob("*/*/acms/*.parquet"))
    for file in files:
        pl.scan_parquet(file).select(pl.selectors.by_name(*COLUMNS, require_all=False)).collect()


def deliver(landing: Path, count: int) -> None:
    """So many new flights, a CSV file each: the last ones of every aircraft flown again within days after its last.

    Dates differ from aircraft to aircraft, as those of late files do.
    """
    aircraft = sorted({f.parent.parent for f in landing.glob("*/*/acms/*.parquet")})
    for place, folder in enumerate(aircraft):
        rows = pl.read_parquet(sorted((folder / "acms").glob("*.parquet"))[-1])
        day = rows["report_time"].max().date() + timedelta(days=1 + place % 5)
        flights = rows["flight_id"].unique().sort()[-math.ceil(count / len(aircraft)) :]
        for leg, flight in enumerate(flights, 1):
            fly_again(folder, rows.filter(flight_id=flight), day, leg)


def fly_again(folder: Path, flight: pl.DataFrame, day: date, leg: int) -> None:
    """Deliver an aircraft's flight once more, as a CSV file, as if it were of another day."""
    later = flight.with_columns(pl.col("report_time") + (day - flight["report_time"].min().date()))
    name = f"{folder.name}_{day:%Y%m%d}_{leg:02}"
    stamped = pl.col("report_time").dt.strftime("%Y-%m-%dT%H:%M:%SZ")
    later.with_columns(stamped, flight_id=pl.lit(name)).write_csv(folder / "acms" / f"{name}.csv")


CONTESTANTS: dict[str, Callable[[Path, Path], dict[str, float] | None]] = {
    "night": night,
    "alone": alone,
    "bare": bare,
    "scan": scan,
    "idle": night,
    "new": night,
}


def measured(name: str, landing: Path, home: Path) -> dict[str, float]:
    """Wall and processor seconds and peak memory of one contestant in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.scale", "--child", name, str(landing), str(home)]
    line = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
    return dict(json.loads(line))


def child(name: str, landing: Path, home: Path) -> None:
    """Run a contestant and print its cost, imports excluded."""
    began, before = time.monotonic(), _cpu_s()
    result = CONTESTANTS[name](landing, home) or {}
    wall = time.monotonic() - began
    forkserver._forkserver._stop()  # its processes count as ours once they have ended
    here, below = (resource.getrusage(who).ru_maxrss / 1024 for who in _WHO)
    peak_mb = max(here, below)  # of the largest process
    print(json.dumps({"wall_s": wall, "cpu_s": _cpu_s() - before, "peak_mb": peak_mb} | result))


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in _WHO]
    return sum(u.ru_utime + u.ru_stime for u in used)


def ranking_ms(home: Path) -> float:
    """Median time of "fleet ranking tonight"."""
    times_ms = []
    with connect(home) as con:
        for _ in range(7):
            began = time.perf_counter()
            con.execute("select * from fleet_ranking order by place").fetchall()
            times_ms.append(1e3 * (time.perf_counter() - began))
    return median(times_ms)


def sized(name: str, rounds: int, scratch: Path, peers: bool = True) -> dict[str, float]:
    """Medians of one size; without `peers` only what a night, an idle one and one of few new flights cost."""
    size = SIZES[name]
    for _ in write_fleet(scratch / name, 11, size):
        pass
    landing, results = scratch / name / "landing", []
    for k in range(rounds):
        homes = {c: scratch / name / f"{c}{k}" for c in ("night", *(("alone", "bare") if peers else ()))}
        contestants = {c: measured(c, landing, home) for c, home in homes.items()}
        contestants |= {"scan": measured("scan", landing, scratch)} if peers else {}
        contestants["idle"] = measured("idle", landing, homes["night"])
        results.append(
            {f"{c}_{what}": value for c, row in contestants.items() for what, value in row.items()}
            | {"ranking_ms": ranking_ms(homes["night"])}
        )
    deliver(landing, NEW_FLIGHTS)
    late = measured("new", landing, scratch / name / f"night{rounds - 1}")
    flights = size.operators * size.tails * size.flights
    medians = {key: median(row[key] for row in results) for key in results[0]}
    return medians | {"flights": flights} | {f"new_{what}": value for what, value in late.items()}


def table(rows: dict[str, dict[str, float]]) -> str:
    """The table as Markdown, and the exponent of cost between the first and the last size."""
    lines = [
        "| size | flights | wall [s] | processor [s] | in one process | Dagster's share | without it | peak [MB] |"
        " idle [s] | 100 new [s] | their processor [s] | of the night's | ranking [ms] | processor / bare scan |",
        "| --- |" + " ---: |" * 13,
    ]
    for name, r in rows.items():
        share, per_scan = (_ratio(r, *of) for of in (("alone_dagster_s", "alone_cpu_s"), ("night_cpu_s", "scan_cpu_s")))
        lines.append(
            f"| {name} | {r['flights']:,.0f} | {r['night_wall_s']:.0f} | {r['night_cpu_s']:.0f}"
            f" | {r.get('alone_cpu_s', math.nan):.0f} | {share:.1%} | {r.get('bare_cpu_s', math.nan):.0f}"
            f" | {r['night_peak_mb']:.0f} | {r['idle_wall_s']:.1f} | {r['new_wall_s']:.0f} | {r['new_cpu_s']:.1f}"
            f" | {r['new_cpu_s'] / r['night_cpu_s']:.1%} | {r['ranking_ms']:.0f} | {per_scan:.0f} |"
        )
    if len(rows) > 1:
        first, *_, last = rows.values()
        exponent = math.log(last["night_cpu_s"] / first["night_cpu_s"]) / math.log(last["flights"] / first["flights"])
        lines.append(f"\nExponent of the processor's cost from the first to the last size: {exponent:.2f}.")
    lines.append(f"\n{machine()}")
    return "\n".join(lines).replace("nan%", "-").replace("nan", "-")


def _ratio(row: dict[str, float], over: str, under: str) -> float:
    return row.get(over, math.nan) / row.get(under, math.nan)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("sizes", nargs="*", default=["S", "M"])
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--alone", action="store_true", help="no peers: neither without Dagster nor a bare scan")
    parser.add_argument("--child", nargs=3)
    options = parser.parse_args()
    if options.child:
        child(options.child[0], Path(options.child[1]), Path(options.child[2]))
        return
    with tempfile.TemporaryDirectory() as scratch:
        text = table({name: sized(name, options.rounds, Path(scratch), not options.alone) for name in options.sizes})
    show("table", text, PAGE, write=options.write)


if __name__ == "__main__":
    main()
