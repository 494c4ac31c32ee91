"""Whether a folder can be a landing zone; nothing heavy is loaded to say that it can't."""

from pathlib import Path


def fault_of(landing: Path) -> str | None:
    """Why a folder can't be a landing zone, and what to do; None where it may be one.

    Without its list of the fleet it is an empty mount point or another folder, and a night over it would take silence
    for a day without flights.
    """
    if (landing / "fleet.csv").is_file():
        return None
    if not landing.is_dir():
        return (
            f"no landing zone at {landing}; give --landing the folder that holds fleet.csv and one folder per operator"
        )
    below = next(iter(sorted(landing.glob("*/fleet.csv"))), None)
    if below is not None:
        return f"{landing} is no landing zone, but {below.parent} is; give --landing {below.parent}"
    if not any(landing.iterdir()):
        return f"{landing} is empty; mount the landing zone there, or give --landing the folder that holds fleet.csv"
    return f"no fleet.csv in {landing}; give --landing the folder that holds it and one folder per operator"
