"""Components of the chain: those of the air-conditioning pack, and those that packages declare.

A package declares one by an entry point of the group `hdt.components` that names a `Component`.
"""

from functools import cache

from hdt_core.components.cabin_air_compressor import CAC
from hdt_core.components.declaration import ACTIONS, Channel, Component, Limit, Reading, Record
from hdt_core.components.pack import CC, HX
from hdt_core.components.unmetered_exchanger import HXT
from hdt_core.components.wear_law import LINEAR, RESISTANCE, WearLaw, power_law
from hdt_core.loading import UserError, load_entry_points

__all__ = [
    "ACTIONS", "LINEAR", "RESISTANCE", "Channel", "Component", "ComponentError", "Limit", "Reading", "Record",
    "WearLaw", "component_rows", "components", "power_law", "recorded_components",
]  # fmt: skip

GROUP = "hdt.components"


@cache
def components() -> dict[str, Component]:
    """Return every component by its code: this project's own, then those of other packages by name.

    Raises
    ------
    ComponentError
        A package can't be loaded, names something else than a `Component`, or one of a code that is taken.
    """
    by_code = {c.code: c for c in (HX, CC, HXT, CAC)}
    for label, component in load_entry_points(GROUP, "component", ComponentError):
        if not isinstance(component, Component):
            raise ComponentError(f"{label} is no Component")
        if component.code in by_code:
            raise ComponentError(f"{label}: there is a component {component.code} already")
        by_code[component.code] = component
    return by_code


class ComponentError(UserError):
    """A package's entry point is no component."""

    def __str__(self) -> str:
        return f"{super().__str__()}; correct or uninstall it"


def component_rows() -> list[dict[str, object]]:
    """Return every component as a row of the table `components`."""
    return [
        {
            "component": c.code, "name": c.name, "loss": c.loss, "lost": c.lost, "message_code": c.message_code,
            "diagnosis": c.diagnosis, "limit_loss": c.limit.mean, "recorded": c.record is not None,
            "version": c.version,
        }
        for c in components().values()
    ]  # fmt: skip


def recorded_components() -> dict[str, Component]:
    """Return components with files of their own, by the name of their folder."""
    return {c.folder: c for c in components().values() if c.record is not None}
