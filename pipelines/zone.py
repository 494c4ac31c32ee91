"""Check whether a folder can be a landing zone, without heavy imports."""

from pathlib import Path


def find_landing_fault(landing: Path) -> str | None:
    """Explain why a folder can't be a landing zone, and the remedy; None where it may be one.

    Without a fleet list it is an empty mount point or another folder, and a night over it would look like a day
    without flights.
    """
    if (landing / "fleet.csv").is_file():
        return None
    if not landing.is_dir():
        return (
            f"no landing zone at {landing}; give --landing the folder that holds fleet.csv and one folder per operator"
        )
    subfolder = next(iter(sorted(landing.glob("*/fleet.csv"))), None)
    if subfolder is not None:
        return f"{landing} is no landing zone, but {subfolder.parent} is; give --landing {subfolder.parent}"
    if not any(landing.iterdir()):
        return f"{landing} is empty; mount the landing zone there, or give --landing the folder that holds fleet.csv"
    return f"no fleet.csv in {landing}; give --landing the folder that holds it and one folder per operator"
