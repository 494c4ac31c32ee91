"""Batches made on other machines: each is a Dagster run that the instance's own launcher sends out.

Which engine that is, `<home>/dagster/dagster.yaml` says (docs/storage.md). Dagster's daemon hands the runs out,
finds the lost ones and starts them again; here they are submitted and waited for and, where a run of several aircraft
failed, its aircraft are sent out again one by one.
"""

import time
from collections import deque
from collections.abc import Iterator

import dagster as dg

from dagster_batched.runs import daemon_answers, failure_of, finished_runs, is_active, submit, successor
from pipelines.orchestration.batches import BatchResult, PartitionBatch, made_apart
from pipelines.orchestration.local_executor import EngineError
from pipelines.orchestration.runs import LOCATION, Runner
from pipelines.partitions import NIGHT

LOOK_S = 0.5
AHEAD = 500  # runs that are sent before those before them are done: Dagster looks at its whole queue each time


class RemoteExecutor:
    """Hands on other machines; the same to a night as `LocalExecutor`."""

    ranges = True  # several machines want several runs, and a run's tags name a range

    def __init__(self, runner: Runner) -> None:
        self.runner, self.instance = runner, runner.instance

    def settle(self) -> None:
        """Wait for what a killed night had sent out: it goes on without its night, and none of it is made twice."""
        if not daemon_answers(self.instance):
            raise EngineError(f"no Dagster daemon answers; start one: `dagster-daemon run --module-name {LOCATION}`")
        for run in self.instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.NOT_STARTED], tags=NIGHT)):
            self.instance.report_run_canceled(run, "its night was stopped before it was sent out")
        while is_active(self.instance, NIGHT):
            time.sleep(LOOK_S)

    def among(self, flights: int) -> int:
        """Nothing to divide by: how many workers there are is not known here, and runs are small."""
        return 1

    def expect(self, flights: int) -> None:
        """They are there."""

    def worth(self, batches: list[PartitionBatch], flights: int) -> bool:
        """Whether the batches are sent out: always, for the night's own machine may be a small one."""
        return bool(batches)

    def make(self, tables: list[str], batches: list[PartitionBatch], label: str) -> Iterator[BatchResult]:
        """Make the batches in any order and say of each when it is done.

        A run that Dagster starts again is followed; one of several aircraft that failed for good makes room for a run
        of each.
        """
        job, unsent = self.runner.job(tables), deque(batches)
        waiting, counted = dict[str, PartitionBatch](), set(batches)
        while unsent or waiting:
            while unsent and len(waiting) < AHEAD:
                batch = unsent.popleft()
                waiting[self._send(job, batch, label)] = batch
            for run in finished_runs(self.instance, waiting):
                batch = waiting.pop(run.run_id)
                if again := successor(run):
                    waiting[again] = batch
                    continue
                why = None if run.is_success else self._why(run, batch)
                told: tuple[str, ...] = ()
                if why and len(batch.aircraft) > 1:
                    unsent.extend(batch.parts())
                    told, why = made_apart(label, batch, why), None
                cells = batch.size if batch in counted else 0  # those of a part count once: as their whole's
                yield BatchResult(cells, 1, {f"{label}: {batch.label}": why} if why else {}, told)
            time.sleep(LOOK_S)

    def stop(self) -> None:
        """They are not ours to stop."""

    def _send(self, job: dg.JobDefinition, batch: PartitionBatch, label: str) -> str:
        """Submit one run; its id."""
        run = self.runner.create(job, batch, label)
        submit(self.instance, run)
        return run.run_id

    def _why(self, run: dg.DagsterRun, batch: PartitionBatch) -> str:
        self.runner.show_failed(run.run_id, batch)
        kinds = {dg.DagsterEventType.STEP_FAILURE, dg.DagsterEventType.RUN_FAILURE, dg.DagsterEventType.RUN_CANCELED}
        events = [entry.get_dagster_event() for entry in self.instance.all_logs(run.run_id, of_type=kinds)]
        return failure_of(events) or next((e.message for e in reversed(events) if e.message), run.status.value)
