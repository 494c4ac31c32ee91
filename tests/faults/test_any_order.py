"""Delivered, late, twice, broken, taken away, in any order, with nights killed in between: a dictionary agrees."""

import os
import shutil
import signal
from pathlib import Path
from typing import ClassVar

import polars as pl
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule, run_state_machine_as_test
from zones import drop_fleet, simulated

from pipelines.store import Store

EXAMPLES = int(os.environ.get("HDT_SOAK_KILLS", "0")) // 20 or 3
ZONE = simulated(16, 4, operator="QQX", tail="Z9")
FLIGHTS = st.sampled_from(ZONE.flights)
INTAKE = 3
"""Steps of the chain that take in: enough to lose a row, in a third of the time."""


class AnyOrder(RuleBasedStateMachine):
    """`good`: for each flight the files of the zone that hold it whole. `stored`: rows of each flight after a night."""

    children: ClassVar
    intact: ClassVar
    root: ClassVar[Path]
    made: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__()
        AnyOrder.made += 1
        own = self.root / str(self.made)
        self.landing, self.home = own / "landing", self.children.home(own / "home")
        self.acms = ZONE.folder(self.landing) / "acms"
        drop_fleet(self.landing, [ZONE])
        ZONE.drop_papers(self.landing)
        self.good: dict[str, set[str]] = {f: set() for f in ZONE.flights}
        self.stored: dict[str, int] = {}

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
        one, two = self.acms / f"{flight}.csv", f"{flight} (1).csv"
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

    @precondition(lambda self: any(self.good.values()))
    @rule(only=st.booleans())
    def run_a_night(self, only: bool) -> None:
        how = {"only": "Z9"} if only else {}
        assert self.children.night(self.landing, self.home, steps=INTAKE, **how) == (0, "")
        self.stored |= {f: ZONE.snapshots.filter(flight_id=f).height for f, files in self.good.items() if files}
        self.agree()

    @precondition(lambda self: any(self.good.values()))
    @rule(place=st.integers(1, 60))
    def kill_a_night(self, place: int) -> None:
        ended, said = self.children.night(self.landing, self.home, steps=INTAKE, fault=f"any:{place}")
        assert ended in (0, signal.SIGKILL), said
        self.intact(self.home)

    def agree(self) -> None:
        self.intact(self.home)
        rows = Store(self.home).read("raw_snapshots")
        assert dict(rows.group_by("flight_id").len().iter_rows()) == self.stored
        told = Store(self.home).read("raw_deliveries")
        assert told.filter(pl.col("delivered") != pl.sum_horizontal("loaded", "quarantined", "duplicate")).is_empty()
        assert told["loaded"].sum() == rows.height

    def teardown(self) -> None:
        if any(self.good.values()):
            self.run_a_night(only=False)


def test_any_order_of_deliveries_and_kills_ends_as_the_model_says(children, intact, tmp_path):
    AnyOrder.children, AnyOrder.intact, AnyOrder.root = children, staticmethod(intact), tmp_path
    how = settings(
        max_examples=EXAMPLES,
        stateful_step_count=9,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(AnyOrder, settings=how)
