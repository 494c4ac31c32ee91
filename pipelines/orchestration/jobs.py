"""The night as a Dagster job, by the clock or when files have come; both are off until someone turns them on."""

import time
from collections.abc import Iterator
from pathlib import Path

import dagster as dg

from pipelines.intake.scan import list_new_files
from pipelines.orchestration.around_night import holding
from pipelines.orchestration.nightly import complete_night
from pipelines.resources import Home
from pipelines.versions import digest
from pipelines.zone import find_landing_fault

QUIET_S = 120
"""A file counts as delivered when it has not been written to for so long."""


class _Log:
    """Progress of a night in the run's own log."""

    def __init__(self, log: dg.DagsterLogManager) -> None:
        self.log = log

    def start(self, label: str, total: int) -> None:
        self.log.info(f"{label}: {total} cells")

    def advance(self, cells: int) -> None:
        self.log.info(f"{cells} cells made")


@dg.op
def take_in_what_is_new(context: dg.OpExecutionContext, home: Home) -> None:
    """Everything `hdt nightly` does; its runs, one a range of cells, stand beside this one in the list of runs."""
    where = Path(home.home)
    if fault := find_landing_fault(Path(home.landing)):
        raise dg.Failure(fault)
    with holding(where):
        night, _ = complete_night(Path(home.landing), where, _Log(context.log), within=context)
    for line in night.untold:
        context.log.warning(line)
    context.add_output_metadata({"new_files": night.new_files, "cells": night.cells, "runs": night.runs})
    if night.failed or night.not_followed:
        failed = (f"{where}: {why}" for where, why in night.failed.items())
        raise dg.Failure("; ".join((*failed, *night.not_followed)))


@dg.job(description="One night: from what lies in the landing zone to a published catalog.")
def nightly() -> None:
    """See `take_in_what_is_new`."""
    take_in_what_is_new()


every_night = dg.ScheduleDefinition(
    name="every_night",
    job=nightly,
    cron_schedule="0 2 * * *",
    execution_timezone="UTC",
    description="The fleet, every night, whether or not the sensor has fired.",
)


@dg.sensor(
    job_name="nightly",  # by name: Dagster rebinds a job given as object, and warns of a beta argument as it does
    minimum_interval_seconds=300,
    description="Runs a night when files have come and nobody writes to them.",
)
def landing_zone(context: dg.SensorEvaluationContext, home: Home) -> Iterator[dg.RunRequest | dg.SkipReason]:
    """One run for each state of the landing zone; a zone that is still being written to waits for the next look."""
    if fault := find_landing_fault(Path(home.landing)):
        yield dg.SkipReason(fault)
        return
    files, new = list_new_files(Path(home.landing), home.ledger)
    if not new:
        yield dg.SkipReason(f"nothing new among {files} files")
    elif time.time() - max(f.mtime_ns for f in new) / 1e9 < QUIET_S:
        yield dg.SkipReason(f"{len(new)} new files, the last still fresh: waiting until they are {QUIET_S} s old")
    else:
        context.log.info(f"{len(new)} new files")
        yield dg.RunRequest(run_key=digest(*sorted(f"{f.path} {f.size} {f.mtime_ns}" for f in new)))
