"""Diagnoses of alerts, a file each: facts, phrases, severity, evidence, action, and the work that ends its cases.

A new one is a file in this folder with its `DIAGNOSES`; what its `rule` finds becomes alerts. Report, `hdt explain`,
catalog, check of alerts and trials of limits follow from the declaration.
"""

from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from hdt_core.alerts.diagnosis import Diagnosis

_MODULES = [import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)]
DIAGNOSES: dict[str, Diagnosis[Any]] = {d.code: d for module in _MODULES for d in module.DIAGNOSES}
"""By code."""
LOSS = {d.code: d.loss for d in DIAGNOSES.values() if d.loss}
"""Feature of the loss that a case of wear rests on."""
