"""The order of runs follows from what the stages are made from; how cells are shared out to them."""

from collections.abc import Iterable
from itertools import permutations

import polars as pl
import pytest

from pipelines.lineage import STAGE, STAGES, declare_stage, steps
from pipelines.orchestration import batches
from pipelines.orchestration.local_executor import LocalExecutor
from pipelines.orchestration.runs import Runner


def test_stage_follows_what_it_needs():
    there: set[str] = set()
    for step in steps(STAGES):
        assert len({stage.grain for stage in step.stages}) == 1
        for stage in step.stages:
            assert there.issuperset((*stage.parents, *stage.untracked)), stage.name
            assert there.isdisjoint(stage.tables)
            there.update(stage.tables)
    assert there == {table for stage in STAGES for table in stage.tables}


def test_night_takes_eleven_runs():
    """Fleet, aircraft and flights are taken in; the model; own components and their sisters; all are followed."""
    assert [s.grain for s in steps(STAGES)] == [
        "fleet",
        "aircraft",
        *["flight", "fleet"] * 2,
        "flight",
        *["aircraft", "fleet"] * 2,
    ]


def test_every_step_has_a_label():
    assert all(any(stage.label for stage in step.stages) for step in steps(STAGES))


HEALTH = {"twin_health", "legs_admitted", "features", "features_alerts", "raw_cases"}


@pytest.mark.parametrize(
    ("stale", "names"),
    [
        ("raw_components", {"raw_components", "calibration_components"}),
        ("twin_health", HEALTH),
        ("features_alerts", {"features_alerts", "raw_cases"}),
    ],
)
def test_step_makes_stale_stages_only(stale, names):
    """Those that follow from a stale one."""
    (step,) = [step for step in steps(STAGES) if STAGE[stale] in step.stages]
    assert step.tables([stale]) == [t for stage in step.stages if stage.name in names for t in stage.tables]
    assert step.tables([]) == []


CHAIN = (
    declare_stage("one", "any", "raw_flights"),
    declare_stage("two", "any", "legs_samples", parents=("raw_flights",)),
    declare_stage("three", "any", "twin_health", parents=("legs_samples",)),
    declare_stage("four", "any", "calibration_dsm", untracked=("twin_health",)),
)


@pytest.mark.parametrize("declared", list(permutations(CHAIN)), ids=lambda stages: "-".join(s.name for s in stages))
def test_order_of_declaration_is_free(declared):
    assert [[s.name for s in step.stages] for step in steps(declared)] == [["one", "two"], ["three"], ["four"]]


def test_cycle_is_named():
    circle = declare_stage("legs", "any", "legs_samples", parents=("residuals",))
    with pytest.raises(ValueError, match="form a cycle: legs, residuals"):
        steps([circle, declare_stage("residuals", "any", "residuals", parents=("legs_samples",))])


KEYS = ["AAA:T1", "AAA:T2", "AAA:T3", "BBB:T4"]
FLIGHTS = [f"2026010{day}_01" for day in range(1, 6)]


@pytest.fixture(autouse=True)
def room_for_ten(monkeypatch):
    """Ten flights a run."""
    monkeypatch.setattr(batches, "CELLS_A_RUN", 10)


def cells_of(*rows: tuple[str, str, str]) -> pl.DataFrame:
    return pl.DataFrame(rows, schema=["operator", "tail", "flight_id"], orient="row")


def flight_cells(pairs: Iterable[tuple[str, str]]) -> pl.DataFrame:
    """Cells of an aircraft's key and a flight's."""
    return cells_of(*((*a.split(":"), f"{a[4:]}_{f}") for a, f in pairs))


def share_out(flights: dict[str, int], keys: list[str]) -> list[tuple[str, ...]]:
    index = batches.PartitionIndex(KEYS, [], {key: {f"{i}" for i in range(n)} for key, n in flights.items()})
    cells = cells_of(*((*k.split(":"), "") for k in keys))
    return [tuple(batch.aircraft) for batch in index.batches("aircraft", cells, ranges=True)]


@pytest.mark.parametrize(
    ("each", "expected"),
    [
        (5, [("AAA:T1", "AAA:T2"), ("AAA:T3", "BBB:T4")]),
        (6, [("AAA:T1",), ("AAA:T2",), ("AAA:T3",), ("BBB:T4",)]),
        (99, [("AAA:T1",), ("AAA:T2",), ("AAA:T3",), ("BBB:T4",)]),
        (1, [tuple(KEYS)]),
    ],
)
def test_aircraft_share_runs_by_flights(each, expected):
    assert share_out(dict.fromkeys(KEYS, each), KEYS) == expected


def test_gap_of_aircraft_splits_a_run():
    assert share_out(dict.fromkeys(KEYS, 1), [KEYS[0], *KEYS[2:]]) == [("AAA:T1",), ("AAA:T3", "BBB:T4")]


def test_processes_share_runs_evenly():
    """Two of 20 flights and one of 10 would keep one process waiting for the other's last."""
    keys = [f"AAA:T{i:02}" for i in range(50)]
    index = batches.PartitionIndex(keys, [], {key: {"1"} for key in keys})
    cells = cells_of(*(("AAA", key[4:], "") for key in keys))
    assert [b.size for b in index.batches("aircraft", cells, batch_factor=2, n_processes=2)] == [13, 13, 13, 11]
    assert [b.size for b in index.batches("aircraft", cells, batch_factor=2)] == [17, 17, 16]


def test_batches_hold_wanted_cells_alone():
    flown = {"AAA:T1": {*FLIGHTS}, "AAA:T2": {*FLIGHTS[1:4]}, "BBB:T4": {FLIGHTS[0], FLIGHTS[4]}}
    index = batches.PartitionIndex(KEYS, FLIGHTS, flown)
    expected_cells = {("AAA:T1", f) for f in FLIGHTS if f != FLIGHTS[2]} | {("AAA:T2", f) for f in FLIGHTS[1:4]}
    cells = flight_cells(expected_cells)
    batch_cells = [cell for batch in index.batches("flight", cells, ranges=True) for cell in batch.partition_keys()]
    assert sorted(batch_cells) == sorted(f"{a}|{f}" for a, f in expected_cells)


def test_long_history_takes_several_runs(monkeypatch):
    monkeypatch.setattr(batches, "CELLS_A_RUN", 2)
    index = batches.PartitionIndex(KEYS[:1], FLIGHTS, {KEYS[0]: {*FLIGHTS}})
    runs = list(index.batches("flight", flight_cells((KEYS[0], f) for f in FLIGHTS)))
    ends = [(FLIGHTS[a], FLIGHTS[b], n) for a, b, n in ((0, 1, 2), (2, 3, 2), (4, 4, 1))]
    assert [(*b.flights, b.size) for b in runs] == ends


def test_scattered_flights_share_one_run():
    flown = {key: {*FLIGHTS} for key in KEYS}
    index = batches.PartitionIndex(KEYS, FLIGHTS, flown)
    pairs = list(zip(KEYS, (FLIGHTS[3], FLIGHTS[0], FLIGHTS[4], FLIGHTS[1]), strict=True))
    cells = flight_cells(pairs)
    assert len(list(index.batches("flight", cells, ranges=True))) == 4
    (one,) = index.batches("flight", cells)
    assert sorted(one.partition_keys()) == sorted(f"{a}|{f}" for a, f in pairs)
    assert one.ends() == (f"{KEYS[0]}|{FLIGHTS[0]}", f"{KEYS[-1]}|{FLIGHTS[4]}")
    assert [part.aircraft for part in one.parts()] == [[key] for key in KEYS]


def test_scattered_aircraft_share_one_run():
    index = batches.PartitionIndex(KEYS, [], {key: {f"{i}" for i in range(4)} for key in KEYS})
    cells = cells_of(("AAA", "T1", ""), ("AAA", "T3", ""))
    (one,) = index.batches("aircraft", cells)
    assert one.partition_keys() == ["AAA:T1", "AAA:T3"]
    index = batches.PartitionIndex(KEYS, [], {key: {f"{i}" for i in range(6)} for key in KEYS})
    assert len(list(index.batches("aircraft", cells))) == 2


def test_range_holds_no_other_flight():
    flown = {"AAA:T1": {FLIGHTS[0], FLIGHTS[1]}, "AAA:T2": {FLIGHTS[1]}, "AAA:T3": {FLIGHTS[0]}, "BBB:T4": set()}
    index = batches.PartitionIndex(KEYS, FLIGHTS, flown)
    cells = flight_cells([(KEYS[0], FLIGHTS[1]), (KEYS[1], FLIGHTS[1]), (KEYS[2], FLIGHTS[0])])
    keys = [batch.partition_keys() for batch in index.batches("flight", cells, ranges=True)]
    assert keys == [[f"AAA:T1|{FLIGHTS[1]}", f"AAA:T2|{FLIGHTS[1]}"], [f"AAA:T3|{FLIGHTS[0]}"]]


def test_batch_splits_into_halves():
    batch = batches.PartitionBatch(tuple((KEYS[0], f) for f in FLIGHTS), (FLIGHTS[0], FLIGHTS[-1]))
    one, two = batch.parts()
    assert one.partition_keys() + two.partition_keys() == batch.partition_keys()
    assert (one.flights, two.flights) == ((FLIGHTS[0], FLIGHTS[1]), (FLIGHTS[2], FLIGHTS[4]))


@pytest.mark.parametrize("cells", [((KEYS[0], ""),), ()])
def test_single_cell_is_not_split(cells):
    assert batches.PartitionBatch(cells).parts() == []


class Together(Runner):
    """Fails where several aircraft share a run, and for some aircraft always."""

    bad: tuple[str, ...] = ()

    def _run(self, tables, batch, label):
        return "no" if len(batch.aircraft) > 1 or set(batch.aircraft) & set(self.bad) else None

    def _bisect_failed_batch(self, tables, batch, why, label):
        return 0, why


EVERY_AIRCRAFT = batches.PartitionBatch(tuple((key, "") for key in KEYS))


def test_common_failure_is_mended_alone():
    done = Together(None, None, None, {}).make([], EVERY_AIRCRAFT, "alerts")
    assert (done.runs, done.failed) == (5, {})
    assert done.repairs == ("alerts: a run of 4 aircraft stopped, so each was made alone; report it: no",)


def test_own_failure_is_not_mended(monkeypatch):
    monkeypatch.setattr(Together, "bad", (KEYS[1],))
    done = Together(None, None, None, {}).make([], EVERY_AIRCRAFT, "alerts")
    assert (done.failed, done.repairs) == ({f"alerts: {KEYS[1]}": "no"}, ())


class OfOneAircraft(Runner):
    """Of four flights fails as a whole and no part; of eight two flights for one reason, and a third for its own."""

    def _run(self, tables, batch, label):
        flown = "".join(flight for _, flight in batch.cells)
        bad = "boom" if {*flown} & {*"36"} else "bang" if "5" in flown else None
        return bad if label == "twins" else "disk full" if flown == "0123" else None

    def _describe_flights(self, batch):
        return f"flight {batch.flights[0]}"


def test_halves_mend_a_batch():
    batch = batches.PartitionBatch(tuple(("AAA:T-1", str(k)) for k in range(4)))
    done = OfOneAircraft(None, None, None, {}).make([], batch, "legs")
    line = "legs: a run of 1 aircraft stopped, so each part was made alone; report it: disk full"
    assert (done.runs, done.failed, done.repairs) == (3, {}, (line,))


def test_each_reason_stands_once():
    """With its flights."""
    batch = batches.PartitionBatch(tuple(("AAA:T-1", str(k)) for k in range(8)))
    done = OfOneAircraft(None, None, None, {}).make([], batch, "twins")
    assert list(done.failed.values()) == ["flight 3, flight 6: boom; flight 5: bang"]


def test_batch_ends_follow_the_partitions():
    late = [*FLIGHTS[1:], FLIGHTS[0]]
    index = batches.PartitionIndex(KEYS, late, {KEYS[0]: {*FLIGHTS}})
    (batch,) = index.batches("flight", flight_cells((KEYS[0], f) for f in FLIGHTS))

    assert batch.flights == (FLIGHTS[1], FLIGHTS[0])


class WithoutFourth(OfOneAircraft):
    """Every flight fails but the fourth of eight."""

    def _run(self, tables, batch, label):
        return None if [flight for _, flight in batch.cells] == ["3"] else "boom"


def test_three_bad_flights_end_the_search():
    """The second half is not searched."""
    batch = batches.PartitionBatch(tuple(("AAA:T-1", str(k)) for k in range(8)))
    done = WithoutFourth(None, None, None, {}).make([], batch, "twins")
    assert list(done.failed.values()) == ["flight 0, flight 1, flight 2, flight 4: boom"]


@pytest.mark.parametrize(
    ("keys", "tags"),
    [
        (KEYS[:1], {"hdt/aircraft": "AAA:T1", "hdt/operator": "AAA"}),
        (KEYS[:2], {"hdt/operator": "AAA"}),
        (KEYS[2:], {}),
    ],
    ids=["aircraft", "operator", "fleet"],
)
def test_run_is_found_by_what_it_is_of(keys, tags):
    own = batches.PartitionBatch(tuple((key, "") for key in keys)).tags()
    assert {name: value for name, value in own.items() if name.startswith("hdt/")} == tags


@pytest.mark.parametrize(
    ("flights", "n_batches", "is_shared"), [(1_999, 2, False), (2_000, 2, True), (2_000, 1, False)]
)
def test_two_thousand_flights_are_shared(tmp_path, flights, n_batches, is_shared):
    executor = LocalExecutor(tmp_path, tmp_path, jobs=2)
    assert executor.should_distribute([batches.PartitionBatch()] * n_batches, flights) is is_shared
