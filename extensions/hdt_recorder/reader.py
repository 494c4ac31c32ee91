"""What the house asks of recorders, by the entry point `hdt.readers`; the decoders load with the first file."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

from hdt_recorder.types_of_zone import components_in, types_of
from pipelines.intake.landing_file import RECORDER
from pipelines.intake.readers import REPORTS, TYPES

__all__ = ["FOLDERS", "FORMATS", "checks", "components_in", "coverage", "install", "open_zone", "read_printed", "rows"]


def _later(module: str, name: str) -> Callable[..., Any]:
    """A function whose module loads when it is called."""

    def call(*given: Any) -> Any:
        return getattr(import_module(f"hdt_recorder.{module}"), name)(*given)

    return call


FOLDERS = (RECORDER, REPORTS, TYPES)
FORMATS = {"787": ("767", "717"), "A330": ("717", "767")}
open_zone = types_of
rows = _later("recorder_rows", "recorder_rows")
read_printed = _later("printed_reports", "read_printed")
coverage, checks = _later("coverage", "coverage"), _later("coverage", "checks")
install = _later("simulated_recordings", "install")
