"""Physics from an FMU: FMI 2.0 for model exchange, run by fmpy (the extra `fmi`)."""

from hdt_fmi.fmu import fmu_model
from hdt_fmi.fmu_events import fmu_over_time

__all__ = ["fmu_model", "fmu_over_time"]
