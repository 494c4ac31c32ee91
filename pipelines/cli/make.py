"""Commands for who tries and checks: simulate, doctor, docs."""

import json
import re
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.base import AsJson, HomeDir, LandingDir, StopError, app, err, out

SHOWN = {"seed": 21, "operators": 1, "tails": 2, "flights": 250}
"""A small fleet that has something to show after its first night: found by trying seeds, held by a test."""


@app.command()
def simulate(
    target: Annotated[Path, typer.Option("--out", help="New folder for `landing` and `truth`.")],
    seed: Annotated[int, typer.Option(help="Same seed and size, same fleet.")] = SHOWN["seed"],
    operators: Annotated[int, typer.Option(min=1, max=26)] = SHOWN["operators"],
    tails: Annotated[int, typer.Option(min=1, help="Aircraft of each operator.")] = SHOWN["tails"],
    flights: Annotated[int, typer.Option(min=1, help="Flights of each aircraft.")] = SHOWN["flights"],
    kind: Annotated[str, typer.Option("--type", help="Type of aircraft: contract, 787 or A330.")] = "contract",
    form: Annotated[str, typer.Option("--format", help="Recorder files of that type: 717 or 767.")] = "",
) -> None:
    """Write a simulated fleet, and its truth apart.

    As it stands, two aircraft, each with a heat exchanger that can't wait after the last night. The files are
    those that a ground station would drop; with --type, a recorder's own, a file a flight, with map and description.
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
    made = write_fleet(target, seed, size, form)
    for _ in track(made, description="aircraft", total=operators * tails, console=err):
        pass
    out.print(f"Landing zone: {target / 'landing'}. Truth: {target / 'truth'}", soft_wrap=True)


@app.command()
def doctor(landing: LandingDir = None, home: HomeDir = None, as_json: AsJson = False) -> None:
    """Check the installation, the landing zone and the home.

    The folders are looked at where they are given. Each check says what it found; exit code 1 if one is a fault.
    """
    from pipelines.cli.doctor import examine

    checks = list(examine(landing, home))
    if as_json:
        out.print_json(json.dumps([{"check": c.name, "well": c.well, "says": c.says} for c in checks]))
    else:
        for check in checks:
            out.print(f"{'well ' if check.well else 'FAULT'}  {check.name}: {check.says}", markup=False, soft_wrap=True)
    if not all(c.well for c in checks):
        raise typer.Exit(1)


@app.command()
def docs(page: Annotated[str, typer.Argument(help="Name of a page; none lists them.")] = "") -> None:
    """Print a page of the documentation.

    As Markdown; without a name, which pages there are.
    """
    pages = resources.files("pipelines") / "docs"
    if not page:
        for file in sorted(f.name for f in pages.iterdir() if f.name.endswith(".md")):
            first = (pages / file).read_text(encoding="utf-8").splitlines()[0]
            out.print(f"{file.removesuffix('.md'):24} {first.lstrip('# ')}", markup=False, soft_wrap=True)
        return
    name = page.removeprefix("docs/").removesuffix(".md")
    if not re.fullmatch(r"[a-z0-9-]+", name) or not (pages / f"{name}.md").is_file():
        raise StopError(f"no page {page}; `hdt docs` lists them")
    out.print((pages / f"{name}.md").read_text(encoding="utf-8").rstrip(), markup=False, soft_wrap=True)
