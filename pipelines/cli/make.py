"""Commands for who tries, checks or measures: simulate, doctor."""

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.base import AsJson, HomeDir, LandingDir, StopError, app, err, out


@app.command()
def simulate(
    target: Annotated[Path, typer.Option("--out", help="New folder for `landing` and `truth`.")],
    seed: Annotated[int, typer.Option(help="Same seed and size, same fleet.")] = 1,
    operators: Annotated[int, typer.Option(min=1, max=26)] = 2,
    tails: Annotated[int, typer.Option(min=1, help="Aircraft of each operator.")] = 4,
    flights: Annotated[int, typer.Option(min=1, help="Flights of each aircraft.")] = 350,
) -> None:
    """Write a simulated fleet as a ground station would drop it, and its truth apart."""
    from rich.progress import track

    from hdt_core.simulate.design import FleetSettings
    from pipelines.simulated import write_fleet

    if (target / "landing").exists():
        raise StopError(f"{target / 'landing'} exists; give --out a new folder")
    made = write_fleet(target, seed, FleetSettings(operators=operators, tails=tails, flights=flights))
    for _ in track(made, description="aircraft", total=operators * tails, console=err):
        pass
    out.print(f"Landing zone: {target / 'landing'}. Truth: {target / 'truth'}", soft_wrap=True)


@app.command()
def doctor(landing: LandingDir = None, home: HomeDir = None, as_json: AsJson = False) -> None:
    """Check the installation, and the landing zone and home where they are given: each check with its answer."""
    import json

    from pipelines.doctor import examine

    checks = list(examine(landing, home))
    if as_json:
        out.print_json(json.dumps([{"check": c.name, "well": c.well, "says": c.says} for c in checks]))
    else:
        for check in checks:
            out.print(f"{'well ' if check.well else 'FAULT'}  {check.name}: {check.says}", markup=False, soft_wrap=True)
    if not all(c.well for c in checks):
        raise typer.Exit(1)
