"""Define the resources of a run: landing zone, store and ledger of one home."""

from functools import cached_property
from pathlib import Path

import dagster as dg
from pydantic import Field

from pipelines.io_manager import FrameIO
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store


class Home(dg.ConfigurableResource):  # type: ignore[type-arg]  # yields itself
    """The landing zone and the home of one fleet."""

    landing: str = Field(description="Folder the ground station drops files into (HDT_LANDING).")
    home: str = Field(description="Folder that holds tables, catalog, ledger and Dagster's own storage (HDT_HOME).")

    @cached_property
    def store(self) -> Store:
        """Store of the tables; it caches which files it has checked."""
        return Store(Path(self.home))

    @property
    def ledger(self) -> Ledger:
        """Ledger of delivered files and stored cells."""
        return Ledger(Path(self.home))


@dg.io_manager(config_schema={"home": dg.StringSource})
def frame_io(context: dg.InitResourceContext) -> FrameIO:
    """Build the IO manager of one home."""
    home = Path(context.resource_config["home"])
    return FrameIO(Store(home), Ledger(home))
