"""Aircraft types that come with the project, each a description: what recorders of the type hold of the packs.

A package brings another by an entry point of the group `hdt.types` that names the path of its description.
"""

from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

GROUP = "hdt.types"


@cache
def shipped() -> tuple[Path, ...]:
    """Descriptions of this project and of other packages."""
    own = sorted(Path(__file__).parent.glob("*.toml"))
    return (*own, *(Path(str(p.load())) for p in sorted(entry_points(group=GROUP), key=lambda p: p.name)))
