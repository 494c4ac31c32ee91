"""Delivered, late, twice, broken, taken away, in any order, with nights killed in between: a dictionary agrees."""

import os
import shutil
import signal
from pathlib import Path
from typing import ClassVar

import polars as pl
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule, run_state_machine_as_test
from zones import drop_fleet, simulated

from pipelines.storage.catalog import connect
from pipelines.storage.store import Store

EXAMPLES = int(os.environ.get("HDT_SOAK_KILLS", "0")) // 20 or 3
ZONE = simulated(16, 4, operator="QQX", tail="Z9")
FLIGHTS = st.sampled_from(ZONE.flights)
INTAKE = 3
"""Steps of the chain that take in: enough to lose a row, in a third of the time."""


class AnyOrder(RuleBasedStateMachine):
    """`good`: for each flight the files of the zone that hold it whole. `stored`: rows of each flight after a night.

    `perhaps`: rows of flights that a killed night may have stored before their file went.
    """

    children: ClassVar
    intact: ClassVar
    root: ClassVar[Path]
    count: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__()
        AnyOrder.count += 1
        own = self.root / str(self.count)
        self.landing = own / "landing"
        self.home = self.children.home(own / "home")
        self.acms = ZONE.folder(self.landing) / "acms"
        drop_fleet(self.landing, [ZONE])
        ZONE.drop_papers(self.landing)
        self.good: dict[str, set[str]] = {f: set() for f in ZONE.flights}
        self.stored: dict[str, int] = {}
        self.perhaps: dict[str, int] = {}

    @rule(flight=FLIGHTS)
    def deliver(self, flight: str) -> None:
        ZONE.only([flight]).drop_csv(self.landing)
        self.good[flight].add(f"{flight}.csv")

    @rule(flight=FLIGHTS)
    def begin_to_deliver(self, flight: str) -> None:
        self.acms.mkdir(exist_ok=True)
        (self.acms / f"{flight}.csv.part").write_text("flight_id,report_ti")

    @rule(flight=FLIGHTS)
    def deliver_once_more(self, flight: str) -> None:
        one = self.acms / f"{flight}.csv"
        two = f"{flight} (1).csv"
        if one.exists():
            shutil.copy(one, self.acms / two)
            (self.good[flight].add if one.name in self.good[flight] else self.good[flight].discard)(two)

    @rule(flight=FLIGHTS, content=st.sampled_from([b"", b"\0\1\2", b"flight_id,pack\n", b"<html>"]))
    def break_it(self, flight: str, content: bytes) -> None:
        self.acms.mkdir(exist_ok=True)
        (self.acms / f"{flight}.csv").write_bytes(content)
        self.good[flight].discard(f"{flight}.csv")

    @rule(flight=FLIGHTS)
    def take_away(self, flight: str) -> None:
        (self.acms / f"{flight}.csv").unlink(missing_ok=True)
        self.good[flight].discard(f"{flight}.csv")

    @rule(first=st.integers(1, 4))
    def deliver_history(self, first: int) -> None:
        ZONE.only(ZONE.flights[:first]).drop_history(self.landing)
        for place, flight in enumerate(ZONE.flights):
            (self.good[flight].add if place < first else self.good[flight].discard)("history")

    def rows_by_flight(self, until: str) -> dict[str, int]:
        flights = (f for f, files in self.good.items() if files and f <= until)
        return {f: ZONE.snapshots.filter(flight_id=f).height for f in flights}

    @precondition(lambda self: any(self.good.values()))
    @rule()
    def run_a_night(self) -> None:
        self.backfill(ZONE.flights[-1])

    @precondition(lambda self: any(self.good.values()))
    @rule(until=FLIGHTS)
    def backfill(self, until: str) -> None:
        self.children.complete_night(self.landing, self.home, steps=INTAKE, only=until)
        self.stored |= self.rows_by_flight(until)
        self.agree()

    @precondition(lambda self: self.stored)
    @rule()
    def publish(self) -> None:
        self.children.complete_night(self.landing, self.home, publish=1)
        with connect(self.home) as con:
            rows = con.execute("select flight_id, count(*) from tables.raw_snapshots group by all").fetchall()
        assert dict(rows).items() >= self.stored.items()

    @precondition(lambda self: any(self.good.values()))
    @rule(place=st.integers(1, 60))
    def kill_a_night(self, place: int) -> None:
        ended, message = self.children.night(self.landing, self.home, steps=INTAKE, fault=f"any:{place}")
        assert ended in (0, signal.SIGKILL), message
        self.perhaps |= self.rows_by_flight(ZONE.flights[-1])
        self.intact(self.home)

    def agree(self) -> None:
        self.intact(self.home)
        rows = Store(self.home).read_table("raw_snapshots")
        counts = dict(rows.group_by("flight_id").len().iter_rows())
        assert self.stored.items() <= counts.items() <= (self.perhaps | self.stored).items()
        deliveries = Store(self.home).read_table("raw_deliveries")
        account = pl.sum_horizontal("loaded", "quarantined", "duplicate")
        assert deliveries.filter(pl.col("delivered") != account).is_empty()
        assert deliveries["loaded"].sum() == rows.height

    def teardown(self) -> None:
        if any(self.good.values()):
            self.run_a_night()


def test_any_order_ends_as_modelled(children, intact, tmp_path):
    AnyOrder.children = children
    AnyOrder.intact = staticmethod(intact)
    AnyOrder.root = tmp_path
    fixed = {"derandomize": True, "database": None, "deadline": None, "suppress_health_check": list(HealthCheck)}
    how = settings(max_examples=EXAMPLES, stateful_step_count=9, **fixed)
    run_state_machine_as_test(AnyOrder, settings=how)


@pytest.mark.parametrize("goes", ["taken away", "replaced", "broken"])
def test_killed_night_keeps_its_account(children, intact, home, tmp_path, goes):
    """Killed when the rows were stored and their account was not; then their file goes."""
    landing = tmp_path / "landing"
    drop_fleet(landing, [ZONE])
    ZONE.drop_history(landing)
    assert children.night(landing, home, steps=INTAKE, fault="before_mark:7")[0] == signal.SIGKILL
    stored = Store(home).read_table("raw_snapshots").height
    assert (stored, Store(home).read_table("raw_deliveries").height) == (ZONE.snapshots.height, 0)
    (file,) = ZONE.folder(landing).glob("acms/*.parquet")
    file.unlink() if goes == "taken away" else file.write_bytes(b"PAR1")
    if goes == "replaced":
        ZONE.only(ZONE.flights[:1]).drop_history(landing)
    children.complete_night(landing, home, steps=INTAKE)
    intact(home)
    assert Store(home).read_table("raw_snapshots").height == stored
    assert Store(home).read_table("raw_deliveries")["loaded"].sum() == stored
    quarantine = pl.concat(Store(home).read_table(t) for t in ("raw_quarantine", "raw_files_quarantine"))
    assert quarantine["reason"].to_list() == (["cannot_read_parquet"] if goes == "broken" else [])
