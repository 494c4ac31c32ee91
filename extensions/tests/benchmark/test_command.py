"""`hdt benchmark`: contestants that agree, and what it prints."""

import json

from typer.testing import CliRunner

from hdt_benchmark.peers import installed
from pipelines.cli import load_extensions
from pipelines.cli.base import app, out


def test_contestants_of_the_benchmark_give_the_same_answers():
    claims = installed(rounds=1, records=1)
    assert [max(c.apart.values()) < 1e-5 for c in claims] == [True] * 3
    assert all(len(c.seconds) > 1 and min(c.seconds.values()) > 0 for c in claims)


def test_the_benchmark_prints_json(monkeypatch):
    load_extensions()
    monkeypatch.setattr("hdt_benchmark.peers.installed", lambda rounds: installed(rounds, 1))
    with out.capture() as printed:
        done = CliRunner().invoke(app, ["benchmark", "--rounds", "1", "--json"])
    assert done.exit_code == 0, done.output
    races = json.loads(printed.get())["races"]
    assert all(set(race["ratios"]) == set(race["apart"]) for race in races)
