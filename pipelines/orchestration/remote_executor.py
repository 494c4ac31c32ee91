"""Make batches on other machines: each is a Dagster run that the instance's own launcher sends out.

The engine is set in `<home>/dagster/dagster.yaml` (docs/storage.md). Dagster's daemon launches the runs, finds the lost
ones and starts them again; here they are submitted and awaited and, where a run of several aircraft failed, its
aircraft are submitted again one by one.
"""

import time
from collections import deque
from collections.abc import Iterator

import dagster as dg

from dagster_batched.runs import daemon_answers, failure_of, finished_runs, is_active, submit, successor
from pipelines.orchestration.batches import BatchResult, PartitionBatch, split_message
from pipelines.orchestration.local_executor import EngineError
from pipelines.orchestration.runs import LOCATION, Runner
from pipelines.partitions import NIGHT

LOOK_S = 0.5
AHEAD = 500  # runs queued at once: Dagster scans its whole queue each time


class RemoteExecutor:
    """Execute batches on other machines, by the same methods as `LocalExecutor`."""

    ranges = True  # several machines want several runs, and a run's tags name a range

    def __init__(self, runner: Runner) -> None:
        self.runner, self.instance = runner, runner.instance

    def settle(self) -> None:
        """Wait for runs that a killed night had sent out, so that none is made twice; cancel those not started."""
        if not daemon_answers(self.instance):
            raise EngineError(f"no Dagster daemon answers; start one: `dagster-daemon run --module-name {LOCATION}`")
        for run in self.instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.NOT_STARTED], tags=NIGHT)):
            self.instance.report_run_canceled(run, "its night was stopped before it was sent out")
        while is_active(self.instance, NIGHT):
            time.sleep(LOOK_S)

    def process_count(self, flights: int) -> int:
        """Return 1: the number of workers is set elsewhere, and runs are small."""
        return 1

    def prepare(self, flights: int) -> None:
        """Do nothing: the workers run already."""

    def should_distribute(self, batches: list[PartitionBatch], flights: int) -> bool:
        """Send out whatever there is, for the night's own machine may be a small one."""
        return bool(batches)

    def make(self, tables: list[str], batches: list[PartitionBatch], label: str) -> Iterator[BatchResult]:
        """Make the batches in any order and yield each result when it is ready.

        A run that Dagster retries is tracked under its new id; one of several aircraft that failed for good is replaced
        by a run of each.
        """
        job, unsent = self.runner.job(tables), deque(batches)
        running, whole_batches = dict[str, PartitionBatch](), set(batches)
        while unsent or running:
            while unsent and len(running) < AHEAD:
                batch = unsent.popleft()
                running[self._send(job, batch, label)] = batch
            for run in finished_runs(self.instance, running):
                batch = running.pop(run.run_id)
                if retry_id := successor(run):
                    running[retry_id] = batch
                    continue
                failure = None if run.is_success else self._failure_message(run, batch)
                repairs: tuple[str, ...] = ()
                if failure and len(batch.aircraft) > 1:
                    unsent.extend(batch.parts())
                    repairs, failure = split_message(label, batch, failure), None
                cells = batch.size if batch in whole_batches else 0  # cells of parts were counted with the whole batch
                yield BatchResult(cells, 1, {f"{label}: {batch.label}": failure} if failure else {}, repairs)
            time.sleep(LOOK_S)

    def close(self) -> None:
        """Do nothing: the workers outlive the night."""

    def _send(self, job: dg.JobDefinition, batch: PartitionBatch, label: str) -> str:
        """Submit one run; return its id."""
        run = self.runner.create(job, batch, label)
        submit(self.instance, run)
        return run.run_id

    def _failure_message(self, run: dg.DagsterRun, batch: PartitionBatch) -> str:
        self.runner.show_failed(run.run_id, batch)
        kinds = {dg.DagsterEventType.STEP_FAILURE, dg.DagsterEventType.RUN_FAILURE, dg.DagsterEventType.RUN_CANCELED}
        events = [entry.get_dagster_event() for entry in self.instance.all_logs(run.run_id, of_type=kinds)]
        return failure_of(events) or next((e.message for e in reversed(events) if e.message), run.status.value)
