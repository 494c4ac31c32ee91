"""Declaration of a component: physics, record, codes, failure limit, action.

Intake, legs, calibration, twin, residuals, features, alerts, remaining life, catalog and report follow from it.
"""

import hashlib
import inspect
import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import polars as pl

from hdt_core.components.wear_law import WearLaw
from hdt_core.physics.model import PhysicsModel

CODE = r"[A-Z]{2,8}"
"""Pattern of a component's code."""
REPLACED, CLEANED, INSPECTED, ADJUSTED = ACTIONS = ("REPLACED", "CLEANED", "INSPECTED", "ADJUSTED")
"""Actions of the maintenance log."""
*FAULTS, NO_FAULT = FINDINGS = ("FOULED", "CLOGGED", "CORRODED", "DAMAGED", "NO_FAULT_FOUND")
"""Codes of an inspection's finding, in the maintenance log and in the log of cases."""


@dataclass(frozen=True, slots=True)
class Limit:
    """Loss at which the failure message comes.

    Attributes
    ----------
    mean, sd : float
        Fleet mean and its uncertainty. [-]
    unit_sd : float
        Spread over units about the fleet mean. [-]
    """

    mean: float
    sd: float
    unit_sd: float


@dataclass(frozen=True, slots=True)
class Channel:
    """A column of the component's files and the signal it becomes: signal = column * scale + offset.

    Attributes
    ----------
    column : str
        Name in the file, in small letters, its unit at the end.
    signal : str
        Name in SI.
    unit, meaning : str
        Of the signal.
    low, high : float
        Physical range of the quantity; a value outside becomes null and is reported. [signal's unit]
    harmful_per_s : float, optional
        Drift from which a flight counts as unsteady; not checked where absent. [signal's unit / s]
    needed : bool
        Whether health can't be estimated without it.
    """

    column: str
    signal: str
    unit: str
    meaning: str
    scale: float = 1.0
    offset: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    harmful_per_s: float | None = None
    needed: bool = True


@dataclass(frozen=True, slots=True)
class Record:
    """Contents of the component's own files, `<OPERATOR>/<TAIL>/<code>/*.csv` or `.parquet`.

    Attributes
    ----------
    channels : tuple of Channel
        Columns beside `flight_id`, `report_time` and `pack` (1 where the file has none).
    derive : callable, optional
        Given samples with the channels as columns, and `operator, tail, flight_id, pack, time_utc`, adds those of the
        model's signals that follow from them.
    nominal : Expr, optional
        Samples to which the model applies; all where absent.
    """

    channels: tuple[Channel, ...]
    derive: Callable[[pl.DataFrame], pl.DataFrame] | None = None
    nominal: pl.Expr | None = None


@dataclass(frozen=True, slots=True)
class Reading:
    """A quantity that follows from a sample without a model, reported as a mean of every flight.

    Attributes
    ----------
    name, unit, meaning : str
        The name begins with the component's code in small letters.
    value : Expr
        Over the channels and the columns that `derive` adds; null where unknown.
    where : Expr, optional
        Samples that count; a flight without any is `off_nominal`.
    below : float
        Upper bound of the quantity; samples beyond it contradict its definition. [unit]
    """

    name: str
    unit: str
    meaning: str
    value: pl.Expr
    where: pl.Expr | None = None
    below: float = math.inf


@dataclass(frozen=True, slots=True)
class Component:
    """A part that wears: its physics, failure, record and alert.

    Attributes
    ----------
    code : str
        As in the maintenance log; in small letters the name of its folder and the prefix of its parameters.
    name, lost : str
        Name in reports and alerts; the quantity that wear reduces ("UA lost").
    model : PhysicsModel
        Its equations, design and health parameters.
    loss : str
        The health parameter whose growth ends a unit's life.
    limit : Limit
        Loss at which it fails, before any failure on record.
    life_flights : float
        Flights from new to `limit`, by experience: the prior of the wear rate, whose standard deviation is as large.
    action : str
        Recommended action for a worn one.
    message_code : str, optional
        The aircraft's own message when it fails.
    estimator : str
        Method that estimates its design, and its health flight by flight: a name of `hdt_core.estimation.estimators()`.
    new_share : float
        Chance that a unit is as built when its record begins.
    warn_loss : float
        Loss that raises an alert once exceeded with a probability of 0.7.
    ended_by : tuple of str
        Actions after which it is as built.
    around_work : tuple of int
        Flights of the tail before and after an entry of the log that calibration leaves out.
    otherwise, waiting : str
        Another explanation of the loss; the cost of waiting.
    record : Record, optional
        Source of its signals; none for the pack's parts, which the default record holds.
    readings : tuple of Reading
        Quantities that its record shows without a model.
    terms : mapping of str to PhysicsModel
        The model with a physical term of `hdt_core.physics.terms`, in service once an engineer accepts the term.
    bleed_air : bool
        Whether engine bleed air feeds it: then flights with a bleed off or the cross-feed open are not normal.
    needs : mapping of str to tuple of str
        Columns of the default record without which a parameter can't be estimated; for the pack's parts.
    wear_law : WearLaw, optional
        What grows in proportion to flights: `LINEAR` the loss, `RESISTANCE` its resistance, `power_law(p)` its root.
        Where absent the fleet's lives weigh several.
    """

    code: str
    name: str
    lost: str
    model: PhysicsModel
    loss: str
    limit: Limit
    life_flights: float
    action: str
    message_code: str | None = None
    estimator: str = "nls"
    new_share: float = 0.5
    warn_loss: float = 0.15
    ended_by: tuple[str, ...] = (REPLACED, CLEANED)
    around_work: tuple[int, int] = (10, 1)
    otherwise: str = "a drifting sensor of the same record"
    waiting: str = "Waiting costs what the loss costs, and in the end a failure in service"
    record: Record | None = None
    readings: tuple[Reading, ...] = ()
    terms: Mapping[str, PhysicsModel] = field(default_factory=dict)
    bleed_air: bool = False
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    wear_law: WearLaw | None = None

    def __post_init__(self) -> None:
        for fault in self._faults():
            raise ValueError(f"component {self.code}: {fault}")

    @property
    def folder(self) -> str:
        """Folder of an aircraft that holds its files."""
        return self.code.lower()

    @property
    def diagnosis(self) -> str:
        """Code of its wear alert."""
        return f"{self.code}_DEGRADED"

    @property
    def has_term(self) -> bool:
        """Whether a physical term is in service."""
        return self.model in self.terms.values()

    @property
    def version(self) -> str:
        """Digest of the declaration, the source of its functions included; results of another one are stale."""
        return hashlib.blake2b(_canonical_text(self).encode(), digest_size=6).hexdigest()

    def with_terms(self, names: Collection[str]) -> "Component":
        """Return the component with the model of the accepted terms."""
        models = [model for name, model in self.terms.items() if name in names]
        return replace(self, model=models[0]) if models else self

    def _faults(self) -> list[str]:
        health = {p.name for p in self.model.free("health")} | {r.name for r in self.readings}
        signals = {c.signal for c in self.record.channels} if self.record else set()
        faults = [] if re.fullmatch(CODE, self.code) else ["the code is two to eight capital letters"]
        if self.loss not in {p.name for p in self.model.free("health")}:
            faults.append(f"{self.loss} is no health parameter of {self.model.name}")
        if odd := sorted(n for n in health if not n.startswith(f"{self.folder}_")):
            faults.append(
                f"names of its health parameters and readings begin with {self.folder}_, not {', '.join(odd)}"
            )
        if not 0.0 < self.new_share < 1.0:
            faults.append(f"new_share is a chance between 0 and 1, not {self.new_share}")
        if set(self.ended_by) - set(ACTIONS):
            faults.append(f"ended_by takes {', '.join(ACTIONS)}")
        if self.record and self.record.derive is None and (missing := [s.name for s in self.model.inputs
                                                                       if s.name not in signals]):  # fmt: skip
            faults.append(f"no channel and no derivation gives {', '.join(missing)}")
        return faults


def _canonical_text(value: Any) -> str:
    """Format a value equally in every process: functions by their source, expressions by their form."""
    if is_dataclass(value) and not isinstance(value, type):
        return f"{type(value).__name__}({', '.join(_canonical_text(getattr(value, f.name)) for f in fields(value))})"
    if isinstance(value, dict):
        return _canonical_text(tuple(value.items()))
    if isinstance(value, tuple):
        return f"({', '.join(map(_canonical_text, value))})"
    if inspect.isfunction(value):
        return inspect.getsource(value)
    return str(value)
