"""The Dagster location: `dagster dev`, the daemon and `hdt` all run the assets built here; the night as a job.

A schedule and a sensor start the night; both are off by default.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dagster as dg

from dagster_batched.runs import batch_events
from hdt_core.loading import UserError
from pipelines.assets import asset_definitions, write_home_report
from pipelines.assets.stage import SENSORS
from pipelines.intake.scan import list_new_files
from pipelines.orchestration.around_night import find_home_fault, find_landing_fault, lock_home, notify_failure
from pipelines.orchestration.nightly import complete_night
from pipelines.resources import Home
from pipelines.storage.files import narrow_umask
from pipelines.versions import digest

QUIET_S = 120
"""Time without a write after which a file counts as delivered. [s]"""


class _Log:
    """Progress of a night in the run's own log."""

    def __init__(self, log: dg.DagsterLogManager) -> None:
        self.log = log

    def start(self, label: str, total: int) -> None:
        self.log.info(f"{label}: {total} cells")

    def advance(self, cells: int) -> None:
        self.log.info(f"{cells} cells made")


@dg.op
def run_nightly_chain(context: dg.OpExecutionContext, home: Home) -> None:
    """Run all that `hdt nightly` does, then write the report; its runs, by ranges of cells, are listed beside this."""
    home_path = Path(home.home)
    if fault := find_landing_fault(Path(home.landing)):
        raise dg.Failure(fault)
    with lock_home(home_path):
        night, _ = complete_night(Path(home.landing), home_path, _Log(context.log), parent_run=context)
    for line in night.failed_deliveries:
        context.log.warning(line)
    write_home_report(home_path)
    context.log_event(dg.AssetMaterialization("report"))
    context.add_output_metadata({"new_files": night.new_files, "cells": night.cells, "runs": night.runs})
    if night.failed or night.failed_hooks:
        failed = (f"{home_path}: {why}" for home_path, why in night.failed.items())
        raise dg.Failure("; ".join((*failed, *night.failed_hooks)))


@dg.job(description="One night: from files in the landing zone to a published catalog.")
def nightly() -> None:
    """See `run_nightly_chain`."""
    run_nightly_chain()


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
    """Request one run for each state of the landing zone; skip while files are still being written."""
    if fault := find_landing_fault(Path(home.landing)):
        yield dg.SkipReason(fault)
        return
    files, new_files = list_new_files(Path(home.landing), home.ledger)
    if not new_files:
        yield dg.SkipReason(f"nothing new among {files} files")
    elif time.time() - max(f.mtime_ns for f in new_files) / 1e9 < QUIET_S:
        yield dg.SkipReason(f"{len(new_files)} new files, the last too recent: waiting until they are {QUIET_S} s old")
    else:
        context.log.info(f"{len(new_files)} new files")
        yield dg.RunRequest(run_key=digest(*sorted(f"{f.path} {f.size} {f.mtime_ns}" for f in new_files)))


@dg.run_failure_sensor(monitored_jobs=[nightly], description="Sends receivers of notify.toml why a night failed.")
def failed_night(context: dg.RunFailureSensorContext, home: Home) -> None:
    """Send the error of each failed step, else the run's."""
    errors = [event.step_failure_data.error for event in context.get_step_failure_events()]
    reasons = [error.message.strip() for error in errors if error] or [str(context.failure_event.message)]
    for line in notify_failure(Path(home.home), reasons):
        context.log.warning(line)


def build_defs(*, landing: str | Path, home: str | Path, **overrides: Any) -> dg.Definitions:
    """Build the whole location over one landing zone and one home; `overrides` replace resources by name."""
    sensors = [landing_zone, failed_night, *SENSORS]
    return asset_definitions(landing, home, overrides, jobs=[nightly], schedules=[every_night], sensors=sensors)


def from_environment() -> dg.Definitions:
    """Build the definitions for `dagster dev`: folders from HDT_LANDING and HDT_HOME, else those of `make run`."""
    home = Path(os.environ.get("HDT_HOME", "hdt_home")).resolve()
    if fault := find_home_fault(home):
        raise UserError(fault)
    batch_events()
    narrow_umask()
    return build_defs(landing=Path(os.environ.get("HDT_LANDING", "data_samples")).resolve(), home=home)


defs = from_environment()
