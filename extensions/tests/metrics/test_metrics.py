"""Figures of a night for Prometheus, and alert rules over them."""

import re
from pathlib import Path

import yaml
from prometheus_client.parser import text_string_to_metric_families
from typer.testing import CliRunner

from hdt_metrics.commands import read_metrics
from pipelines.cli.base import StopError, app
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger

RULES = Path(__file__).parents[3] / "deploy" / "prometheus-rules.yaml"


def figures(text: str) -> dict[str, dict[tuple[str, ...], float]]:
    """Values by metric and labels."""
    families = text_string_to_metric_families(text)
    return {f.name: {tuple(s.labels.values()): s.value for s in f.samples} for f in families}


def test_figures_equal_home(sample_home, tmp_path):
    file = tmp_path / "hdt.prom"
    result = CliRunner().invoke(app, ["metrics", "--home", str(sample_home), "--out", str(file)])
    assert result.exit_code == 0, result.output
    values = figures(file.read_text())
    night = Ledger(sample_home, read_only=True).nights().row(-1, named=True)
    for name in ("files", "new_files", "runs", "cells"):
        assert values[f"hdt_night_{name}"] == {(): float(night[name])}
    assert values["hdt_night_failed"] == {(): 0.0}
    assert 1.0 < values["hdt_night_seconds"][()] < 3600.0
    with connect(sample_home) as con:
        flights = con.execute("select operator, epoch(max(departed_at)) from flights group by operator").fetchall()
        ((refused,),) = con.execute("select sum(n_rows) from quarantine where n_rows > 0").fetchall()
        files = con.execute("select distinct file from quarantine where scope = 'file'").fetchall()
        ((alerts,),) = con.execute("select count(*) from open_alerts").fetchall()
    assert values["hdt_last_flight_timestamp_seconds"] == {(o,): at for o, at in flights}
    assert sum(values["hdt_quarantined_rows"].values()) == refused
    assert {labels[1] for labels in values["hdt_refused_files"]} == {file for (file,) in files}
    assert sum(values["hdt_open_alerts"].values()) == alerts
    printed = CliRunner().invoke(app, ["metrics", "--home", str(sample_home)])
    assert figures(printed.output) == values


def test_rules_use_exported_figures(tmp_path, sample_home):
    result = CliRunner().invoke(app, ["metrics", "--home", str(tmp_path)])
    assert isinstance(result.exception, StopError)
    assert "run `hdt nightly" in str(result.exception)
    names = {family.name for family in read_metrics(sample_home).collect()}
    rules = [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]
    assert len(rules) == 4
    for rule in rules:
        assert set(re.findall(r"hdt_\w+", rule["expr"])) <= names
