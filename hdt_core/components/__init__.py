"""The components that the chain knows: those of the air-conditioning pack, and every one that a package brings.

A package brings one by an entry point of the group `hdt.components` that names a `Component`.
"""

from functools import cache

from hdt_core.components.cabin_air_compressor import CAC
from hdt_core.components.compressor import CC
from hdt_core.components.declaration import ACTIONS, Channel, Component, Limit, Reading, Record
from hdt_core.components.exchanger import HX
from hdt_core.components.unmetered_exchanger import HXT
from hdt_core.packages import load_entry_points

__all__ = [
    "ACTIONS", "Channel", "Component", "ComponentError", "Limit", "Reading", "Record", "component_rows", "components",
    "recorded_components",
]  # fmt: skip

GROUP = "hdt.components"


@cache
def components() -> dict[str, Component]:
    """Every component by its code: this project's own, then those of other packages by name.

    Raises
    ------
    ComponentError
        A package can't be loaded, names something else than a `Component`, or one of a code that is taken.
    """
    known = {c.code: c for c in (HX, CC, HXT, CAC)}
    for named, found in load_entry_points(GROUP, "component", ComponentError):
        if not isinstance(found, Component):
            raise ComponentError(f"{named} is no Component")
        if found.code in known:
            raise ComponentError(f"{named}: there is a component {found.code} already")
        known[found.code] = found
    return known


class ComponentError(Exception):
    """What a package brings is no component."""


def component_rows() -> list[dict[str, object]]:
    """Every component as a row of the table `components`."""
    return [
        {
            "component": c.code, "name": c.name, "loss": c.loss, "lost": c.lost, "message_code": c.message_code,
            "diagnosis": c.diagnosis, "limit_loss": c.limit.mean, "recorded": c.record is not None,
            "version": c.version,
        }
        for c in components().values()
    ]  # fmt: skip


def recorded_components() -> dict[str, Component]:
    """Those that files of their own describe, by the name of their folder."""
    return {c.folder: c for c in components().values() if c.record is not None}
