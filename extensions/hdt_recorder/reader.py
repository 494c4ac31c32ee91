"""The recorder's interface to intake, by the entry point `hdt.readers`; the decoders load with the first file."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

from hdt_recorder.types_of_zone import components_in, types_of
from pipelines.intake.landing_file import RECORDER
from pipelines.intake.readers import REPORTS, TYPES

__all__ = ["FOLDERS", "FORMATS", "checks", "components_in", "coverage", "install", "open_zone", "read_printed", "rows"]


def _lazy_function(module: str, name: str) -> Callable[..., Any]:
    """Return a function that imports its module when called."""

    def call(*args: Any) -> Any:
        return getattr(import_module(f"hdt_recorder.{module}"), name)(*args)

    return call


FOLDERS = (RECORDER, REPORTS, TYPES)
FORMATS = {"787": ("767", "717"), "A330": ("717", "767")}
open_zone = types_of
rows = _lazy_function("recorder_rows", "recorder_rows")
read_printed = _lazy_function("printed_reports", "read_printed")
coverage, checks = _lazy_function("coverage", "coverage"), _lazy_function("coverage", "checks")
install = _lazy_function("simulated_recordings", "install")
