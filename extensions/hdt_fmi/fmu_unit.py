"""Model description and one instance of an FMU, run by fmpy (the extra `fmi`)."""

import re
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from ctypes import c_double
from pathlib import Path
from types import ModuleType
from typing import Any

from hdt_core.physics.model import Array, Param, Signal, State

FATAL = 4
"""Status of a call after which the FMU must not be called again."""


class FmuUnit:
    """Instance of an FMU for model exchange; its unpacked folder is deleted with it.

    Parameters
    ----------
    path : path
    names : mapping
        Declared name to the FMU's, where they differ.

    Raises
    ------
    ImportError
        The extra is not installed.
    ValueError
        The FMU is of another kind, or has no binary for this platform.
    """

    def __init__(self, path: str | Path, names: Mapping[str, str]) -> None:
        fmpy, self.path, self._names = _fmpy(), Path(path), names
        self.description = _described(fmpy, self.path)
        self.name = self.description.modelName
        self.variables = {v.name: v for v in self.description.modelVariables}
        folder = tempfile.mkdtemp(prefix="fmu-")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        fmpy.extract(self.path, folder)
        binary = Path(folder, "binaries", fmpy.platform)
        if not binary.is_dir():
            raise ValueError(f"{path}: no binary for {fmpy.platform}")
        self.rejected = fmpy.fmi1.FMICallException
        self.fmu = fmpy.fmi2.FMU2Model(
            guid=self.description.guid,
            unzipDirectory=folder,
            modelIdentifier=self.description.modelExchange.modelIdentifier,
            instanceName=self.name,
        )
        self.fmu.instantiate()
        weakref.finalize(self, self.fmu.freeInstance)
        self._state_names = [d.variable.derivative.name for d in self.description.derivatives]

    def fmu_name(self, name: str) -> str:
        """Return the FMU's name for a declared name."""
        return self._names.get(name, name)

    def reference(self, name: str) -> int:
        """Return the FMU's value reference of a declared variable."""
        return int(self.variables[self.fmu_name(name)].valueReference)

    def states(self) -> tuple[State, ...]:
        """Return states in the FMU's order, with valid Python names and initial values."""
        self.begin([], ())
        initial = (c_double * len(self._state_names))()
        if self._state_names:
            self.fmu.getContinuousStates(initial, len(initial))
        names = {fmu_name: name for name, fmu_name in self._names.items()}
        return tuple(
            State(names.get(n, re.sub(r"\W", "_", n)), self.variables[n].unit or "-", value)
            for n, value in zip(self._state_names, initial, strict=True)
        )

    def check(
        self, declared: Sequence[Signal | Param], causalities: tuple[str, ...], types: tuple[str, ...] = ("Real",)
    ) -> None:
        """Raise ValueError where a declared name is not such a variable of the FMU or has another unit."""
        fit = {n: v for n, v in self.variables.items() if v.causality in causalities and v.type in types}
        for item in declared:
            variable = fit.get(self.fmu_name(item.name))
            if variable is None:
                kinds = " or ".join(causalities)
                has = ", ".join(sorted(fit))
                raise ValueError(f"{self.path}: {self.fmu_name(item.name)} is no {kinds}; it has {has}")
            if variable.unit is not None and variable.unit != item.unit:
                raise ValueError(f"{self.path}: {item.name} is in {variable.unit}, declared in {item.unit}")

    def begin(self, references: Sequence[int], values: Sequence[float]) -> float:
        """Restart at time 0 with these parameters; fixed ones can be set only before initialisation.

        Returns
        -------
        float
            When the first event is due; infinite where none is. [s]
        """
        self.fmu.reset()
        self.fmu.setupExperiment(startTime=0.0)
        if references:
            self.fmu.setReal(references, values)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self.settle()

    def settle(self) -> float:
        """Process an event in event mode and return to continuous time.

        Returns
        -------
        float
            When the next event is due, infinite where none is; NaN where the FMU ends the simulation. [s]
        """
        while (update := self.fmu.newDiscreteStates())[0] and not update[1]:
            pass
        if update[1]:
            return float("nan")
        self.fmu.enterContinuousTimeMode()
        return float(update[5]) if update[4] else float("inf")


def apply_losses(values: Mapping[str, Any], losses: Mapping[str, str]) -> dict[str, Array]:
    """Convert parameters for an FMU without losses: reduce each by the share its loss takes."""
    remaining = {of: values[of] * (1.0 - values[loss]) for loss, of in losses.items()}
    return {name: remaining.get(name, value) for name, value in values.items() if name not in losses}


def check_losses(losses: Mapping[str, str], params: Sequence[Param]) -> None:
    """Raise ValueError where a loss or its target is not a declared parameter."""
    unknown = sorted({*losses, *losses.values()} - {p.name for p in params})
    if unknown:
        raise ValueError(f"losses name {', '.join(unknown)}, declared as no parameter")


def _fmpy() -> ModuleType:
    try:
        import fmpy.fmi2
        import fmpy.model_description
    except ImportError as missing:
        raise ImportError(
            "an FMU as a component needs fmpy: pip install 'hybrid-digital-twin-extensions[fmi]'", name="fmpy"
        ) from missing
    module: ModuleType = fmpy
    return module


def _described(fmpy: ModuleType, path: Path) -> Any:
    """Read the model description; raise ValueError for unsupported FMUs.

    Raises
    ------
    ValueError
        It is none, or of another kind.
    """
    try:
        description = fmpy.model_description.read_model_description(path)
    except Exception as broken:  # whatever zipfile, lxml and fmpy have to say of the file
        raise ValueError(f"{path}: no FMU: {broken}") from broken
    if description.fmiVersion != "2.0" or description.modelExchange is None:
        kinds = [k for k in ("modelExchange", "coSimulation") if getattr(description, k, None) is not None]
        raise ValueError(f"{path}: FMI {description.fmiVersion}, {' and '.join(kinds)}; needs FMI 2.0, modelExchange")
    return description
