"""An instance of Dagster in one folder whose event log is batched."""

from pathlib import Path

import dagster as dg

from dagster_batched.partitions import skip_input_versions
from dagster_batched.sqlite import batch_events

_SETTINGS = """\
{mark} {says}
telemetry:
  enabled: false
nux:
  enabled: false
freshness:
  enabled: true
compute_logs:  # the assets print nothing, and catching what they print would start two processes a step
  module: dagster._core.storage.noop_compute_log_manager
  class: NoOpComputeLogManager
event_log_storage:
  module: dagster_batched.sqlite
  class: BatchedSqliteEventLogStorage
  config:
    base_dir: {base}/history
"""


def open_instance(base: Path, mark: str, says: str) -> dg.DagsterInstance:
    """The instance of a folder; a `dagster.yaml` there that does not begin with `mark` is used as it is.

    Parameters
    ----------
    base : Path
        Folder, absolute; it is made where it is missing, and may have been moved.
    mark, says : str
        First line of the settings that are written here: by whom, and what to know about them.
    """
    batch_events()
    skip_input_versions()
    base.mkdir(parents=True, exist_ok=True)
    settings, ours = base / "dagster.yaml", _SETTINGS.format(base=base, mark=mark, says=says)
    if not settings.exists() or settings.read_text().startswith(mark):
        settings.write_text(ours)
    return dg.DagsterInstance.from_config(str(base))
