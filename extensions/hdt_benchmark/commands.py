"""The command `hdt benchmark`."""

import json
from dataclasses import asdict
from typing import Annotated

import typer
from rich.table import Table

from hdt_benchmark.timing import clock, machine, times
from pipelines.cli.base import AsJson, app, out


@app.command()
def benchmark(
    rounds: Annotated[int, typer.Option(min=1, help="Number of rounds; every contestant runs once a round.")] = 5,
    as_json: AsJson = False,
) -> None:
    """Compare the speed of this installation with SciPy and filterpy.

    All contestants do the same work in turn on one core; takes about ten seconds.
    """
    from hdt_benchmark.peers import PACKAGES, installed

    claims = installed(rounds)
    if as_json:
        out.print_json(
            json.dumps({"machine": machine(PACKAGES), "races": [asdict(c) | {"ratios": c.ratios} for c in claims]})
        )
        return
    table = Table()
    for name in ("work", "who", "time", "ours is faster", "answers apart"):
        table.add_column(name, justify="left" if name in {"work", "who"} else "right")
    for claim in claims:
        for place, (who, seconds) in enumerate(claim.seconds.items()):
            beside = (times(claim.ratios[who]), f"{claim.apart[who]:.0e}") if place else ("", "")
            table.add_row(
                "" if place else claim.work, who, clock(seconds), *beside, end_section=place + 1 == len(claim.seconds)
            )
    out.print(table, soft_wrap=False)
    out.print(machine(PACKAGES), soft_wrap=True)
