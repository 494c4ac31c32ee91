"""What follows a published night: the hooks of installed packages, then the receivers of its digest."""

from importlib.metadata import entry_points
from pathlib import Path

from pipelines.storage.settings import notify_file


def call_hooks(home: Path) -> tuple[dict[str, str | None], tuple[str, ...]]:
    """Call the functions of the entry point group `hdt.after_night` with the home, in the order of their names.

    Returns
    -------
    tuple
        What they give, by the name under which a command tells it, and a line for each that failed: the night is done
        and published, and the others follow.
    """
    given: dict[str, str | None] = {}
    failed = []
    for point in sorted(entry_points(group="hdt.after_night"), key=lambda p: p.name):
        try:
            given |= point.load()(home)
        except Exception as error:
            failed.append(f"{point.name}: {error}")
    return given, tuple(failed)


def tell_receivers(home: Path) -> tuple[str, ...]:
    """A line for each receiver of the night's digest that could not be told; a home without receivers costs nothing."""
    if not notify_file(home).exists():
        return ()
    from pipelines.digest import tell_night

    return tuple(tell_night(home))
