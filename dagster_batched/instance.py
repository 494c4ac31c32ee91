"""Open an instance of Dagster in one folder with a batched event log."""

import os
from pathlib import Path

import dagster as dg

from dagster_batched.partitions import make_keys_quickly, skip_input_versions

BATCH_EVENTS = 1000

_SETTINGS = """\
{mark} {note}
telemetry:
  enabled: false
nux:
  enabled: false
freshness:
  enabled: true
compute_logs:  # the assets print nothing, and capturing output would start two processes a step
  module: dagster._core.storage.noop_compute_log_manager
  class: NoOpComputeLogManager
event_log_storage:
  module: dagster_batched.event_log
  class: BatchedSqliteEventLogStorage
  config:
    base_dir: {base}/history
"""


def batch_events() -> None:
    """Have Dagster pass asset events in batches; a user's own setting stays."""
    os.environ.setdefault("DAGSTER_EVENT_BATCH_SIZE", str(BATCH_EVENTS))


def open_instance(base: Path, mark: str, note: str) -> dg.DagsterInstance:
    """Open the instance of a folder; a `dagster.yaml` there that does not begin with `mark` is used unchanged.

    Parameters
    ----------
    base : Path
        Absolute folder; it is created where it is missing, and may have been moved.
    mark, note : str
        First line of the settings that are written here: by whom, and a note about them.
    """
    batch_events()
    skip_input_versions()
    make_keys_quickly()
    base.mkdir(parents=True, exist_ok=True)
    settings, ours = base / "dagster.yaml", _SETTINGS.format(base=base, mark=mark, note=note)
    written = settings.read_text() if settings.exists() else ""
    if written != ours and (written.startswith(mark) or not written):  # a kill of an older version left it empty
        _replace_text(settings, ours)
    return dg.DagsterInstance.from_config(str(base))


def _replace_text(path: Path, text: str) -> None:
    """Replace a file at once: a process that read it half written would use Dagster's slow event log for its life."""
    copy = path.with_name(f".{path.name}.{os.getpid()}")
    copy.write_text(text)
    copy.replace(path)
