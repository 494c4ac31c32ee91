"""Blocks made on other machines: each is a Dagster run that the instance's own launcher sends out.

Which engine that is, `<home>/dagster/dagster.yaml` says (docs/distributed.md). Dagster's daemon hands the runs out,
finds the lost ones and starts them again; here they are submitted and waited for and, where a run of several aircraft
failed, its aircraft are sent out again one by one.
"""

import sys
import time
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import replace

import dagster as dg
from dagster._core.code_pointer import ModuleCodePointer
from dagster._core.origin import DEFAULT_DAGSTER_ENTRY_POINT, JobPythonOrigin, RepositoryPythonOrigin
from dagster._core.remote_origin import ManagedGrpcPythonEnvCodeLocationOrigin, RemoteJobOrigin, RemoteRepositoryOrigin
from dagster._core.storage.dagster_run import FINISHED_STATUSES
from dagster._core.storage.tags import AUTO_RETRY_RUN_ID_TAG, WILL_RETRY_TAG
from dagster._core.types.loadable_target_origin import LoadableTargetOrigin
from dagster._daemon.controller import all_daemons_live

from pipelines.blocks import Block, Made
from pipelines.runs import NIGHT, Runner, why_failed
from pipelines.workers import EngineError

LOOK_S = 0.5
AHEAD = 500  # runs that are sent before those before them are done: Dagster looks at its whole queue each time
_SILENT_S = 60  # beyond the half minute between two of the daemon's heartbeats
LOCATION = "pipelines.definitions"
_UNDER_WAY = [dg.DagsterRunStatus[s] for s in ("QUEUED", "STARTING", "STARTED", "CANCELING")]


class Elsewhere:
    """Hands on other machines; the same to a night as `Workers`."""

    folded = False  # several machines want several runs

    def __init__(self, runner: Runner) -> None:
        self.runner, self.instance = runner, runner.instance

    def settle(self) -> None:
        """Wait for what a killed night had sent out: it goes on without its night, and none of it is made twice."""
        if not all_daemons_live(self.instance, heartbeat_tolerance_seconds=_SILENT_S):
            raise EngineError(f"no Dagster daemon answers; start one: `dagster-daemon run --module-name {LOCATION}`")
        for run in self.instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.NOT_STARTED], tags=NIGHT)):
            self.instance.report_run_canceled(run, "its night was stopped before it was sent out")
        while self._at_large():
            time.sleep(LOOK_S)

    def worth(self, blocks: list[Block], few: bool) -> bool:
        """Whether the blocks are sent out: always, for the night's own machine may be a small one."""
        return bool(blocks)

    def make(self, tables: list[str], blocks: list[Block], label: str) -> Iterator[Made]:
        """Make the blocks in any order and say of each when it is done.

        A run that Dagster starts again is followed; one of several aircraft that failed for good makes room for a run
        of each.
        """
        job, unsent = self.runner.job(tables), deque(blocks)
        waiting: dict[str, Block] = {}
        while unsent or waiting:
            while unsent and len(waiting) < AHEAD:
                block = unsent.popleft()
                waiting[self._send(job, block)] = block
            for run in self._ended(waiting):
                block = waiting.pop(run.run_id)
                if (again := run.tags.get(AUTO_RETRY_RUN_ID_TAG)) and not run.is_success:
                    waiting[again] = block
                    continue
                why = None if run.is_success else self._why(run, block)
                if why and len(block.aircraft) > 1:  # their cells count once: as their block's
                    unsent.extend(replace(one, cells=0) for one in block.apart())
                    why = None
                where = f"{label}: {block.aircraft[0] if block.aircraft else 'fleet'}"
                yield Made(block, 1, {where: why} if why else {})
            time.sleep(LOOK_S)

    def stop(self) -> None:
        """They are not ours to stop."""

    def _send(self, job: dg.JobDefinition, block: Block) -> str:
        """Submit one run; its id."""
        target = LoadableTargetOrigin(executable_path=sys.executable, module_name=LOCATION)
        location = ManagedGrpcPythonEnvCodeLocationOrigin(target, LOCATION)
        code = RepositoryPythonOrigin(
            sys.executable, ModuleCodePointer(LOCATION, "defs", None), entry_point=DEFAULT_DAGSTER_ENTRY_POINT
        )
        run = self.runner.create(
            job,
            block,
            remote_job_origin=RemoteJobOrigin(RemoteRepositoryOrigin(location, "__repository__"), job.name),
            job_code_origin=JobPythonOrigin(job.name, code),
        )
        self.instance.submit_run(run.run_id, None)
        return run.run_id

    def _ended(self, waiting: Collection[str]) -> list[dg.DagsterRun]:
        """Runs that have ended, for good or with another that takes their place."""
        runs = self.instance.get_runs(dg.RunsFilter(run_ids=list(waiting), statuses=FINISHED_STATUSES))
        return [r for r in runs if not self._in_doubt(r)]

    def _in_doubt(self, run: dg.DagsterRun) -> bool:
        """Whether it failed and Dagster is yet to say if it starts again, or to start it."""
        if run.status != dg.DagsterRunStatus.FAILURE or not self.instance.run_retries_enabled:
            return False
        return run.tags.get(WILL_RETRY_TAG, "true") == "true" and AUTO_RETRY_RUN_ID_TAG not in run.tags

    def _at_large(self) -> bool:
        """Whether a run that a night sent out may still write."""
        lost = dg.RunsFilter(statuses=[dg.DagsterRunStatus.FAILURE], tags=NIGHT | {WILL_RETRY_TAG: "true"})
        under_way = self.instance.get_runs(dg.RunsFilter(statuses=_UNDER_WAY, tags=NIGHT), limit=1)
        return bool(under_way) or any(self._in_doubt(r) for r in self.instance.get_runs(lost))

    def _why(self, run: dg.DagsterRun, block: Block) -> str:
        self.runner.show_failed(run.run_id, block)
        kinds = {dg.DagsterEventType.STEP_FAILURE, dg.DagsterEventType.RUN_FAILURE, dg.DagsterEventType.RUN_CANCELED}
        events = [entry.get_dagster_event() for entry in self.instance.all_logs(run.run_id, of_type=kinds)]
        return why_failed(events) or next((e.message for e in reversed(events) if e.message), run.status.value)
