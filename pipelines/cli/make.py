"""Commands to try and check the installation: simulate, doctor, docs."""

import json
import re
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.base import AsJson, HomeDir, LandingDir, StopError, app, err, out

DEMO = {"seed": 21, "operators": 1, "tails": 2, "flights": 250}
"""A small fleet with alerts after its first night; the seed was chosen by trial, and a test checks it."""


@app.command()
def simulate(
    target: Annotated[Path, typer.Option("--out", help="New folder for `landing` and `truth`.")],
    seed: Annotated[int, typer.Option(help="Same seed and size, same fleet.")] = DEMO["seed"],
    operators: Annotated[int, typer.Option(min=1, max=26)] = DEMO["operators"],
    tails: Annotated[int, typer.Option(min=1, help="Aircraft of each operator.")] = DEMO["tails"],
    flights: Annotated[int, typer.Option(min=1, help="Flights of each aircraft.")] = DEMO["flights"],
    kind: Annotated[str, typer.Option("--type", help="Type of aircraft: contract, 787 or A330.")] = "contract",
    form: Annotated[str, typer.Option("--format", help="Recorder files of that type: 717 or 767.")] = "",
) -> None:
    """Write a simulated fleet, and its truth in its own folder.

    By default two aircraft, each with a heat exchanger that needs work after the last night. The files are those of a
    ground station; with --type, a recorder's own, one a flight, with parameter map and description.
    """
    from rich.progress import track

    from hdt_core.simulate.design import FleetSettings
    from pipelines.intake.landing_file import RECORDER
    from pipelines.intake.readers import readers
    from pipelines.intake.simulated import write_fleet

    if (target / "landing").exists():
        raise StopError(f"{target / 'landing'} exists; give --out a new folder")
    formats = {"contract": [""]} if kind == "contract" and not form else readers()[RECORDER].FORMATS
    form = form or next(iter(formats.get(kind, [""])))
    if form not in formats.get(kind, ()):
        raise StopError(f"--type {kind} --format {form or 'none'}; types are {', '.join(formats)}, formats 717 and 767")
    size = FleetSettings(operators=operators, tails=tails, flights=flights)
    if kind != "contract":
        size = replace(size, suite=kind, cpl_share=1.0)
    aircraft = write_fleet(target, seed, size, form)
    for _ in track(aircraft, description="aircraft", total=operators * tails, console=err):
        pass
    out.print(f"Landing zone: {target / 'landing'}. Truth: {target / 'truth'}")


@app.command()
def doctor(landing: LandingDir = None, home: HomeDir = None, as_json: AsJson = False) -> None:
    """Check the installation, the landing zone and the home.

    Only folders given are checked. Each check prints its result; exit code 1 if one is a fault.
    """
    from pipelines.cli.doctor import examine

    checks = list(examine(landing, home))
    if as_json:
        out.print_json(json.dumps([{"check": c.name, "well": c.well, "says": c.message} for c in checks]))
    else:
        for check in checks:
            out.print(f"{'well ' if check.well else 'FAULT'}  {check.name}: {check.message}")
    if not all(c.well for c in checks):
        raise typer.Exit(1)


@app.command()
def docs(page: Annotated[str, typer.Argument(help="Name of a page; without it, a list.")] = "") -> None:
    """Print a page of the documentation, or list them."""
    pages = resources.files("pipelines") / "docs"
    if not page:
        for file in sorted(f.name for f in pages.iterdir() if f.name.endswith(".md")):
            first = (pages / file).read_text(encoding="utf-8").splitlines()[0]
            out.print(f"{file.removesuffix('.md'):24} {first.lstrip('# ')}")
        return
    name = page.removeprefix("docs/").removesuffix(".md")
    if not re.fullmatch(r"[a-z0-9-]+", name) or not (pages / f"{name}.md").is_file():
        raise StopError(f"no page {page}; `hdt docs` lists them")
    out.print((pages / f"{name}.md").read_text(encoding="utf-8").rstrip())
