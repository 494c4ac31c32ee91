"""Figures of a night for Prometheus, and alert rules over them."""

import re
from pathlib import Path

import pytest
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


def metrics(*words: object):
    return CliRunner().invoke(app, ["metrics", *map(str, words)])


@pytest.fixture(scope="module")
def values(sample_home, tmp_path_factory):
    file = tmp_path_factory.mktemp("metrics") / "hdt.prom"
    result = metrics("--home", sample_home, "--out", file)
    assert result.exit_code == 0, result.output
    return figures(file.read_text())


def test_figures_equal_last_night(values, sample_home):
    night = Ledger(sample_home, read_only=True).nights().row(-1, named=True)
    for name in ("files", "new_files", "runs", "cells"):
        assert values[f"hdt_night_{name}"] == {(): float(night[name])}
    assert values["hdt_night_failed"] == {(): 0.0}
    assert 1.0 < values["hdt_night_seconds"][()] < 3600.0


def test_figures_equal_catalog(values, sample_home):
    with connect(sample_home) as con:
        flights = con.execute("select operator, epoch(max(departed_at)) from flights group by operator").fetchall()
        ((refused,),) = con.execute("select sum(n_rows) from quarantine where n_rows > 0").fetchall()
        files = con.execute("select distinct file from quarantine where scope = 'file'").fetchall()
        ((alerts,),) = con.execute("select count(*) from open_alerts").fetchall()
    assert values["hdt_last_flight_timestamp_seconds"] == {(o,): at for o, at in flights}
    assert sum(values["hdt_quarantined_rows"].values()) == refused
    assert {labels[1] for labels in values["hdt_refused_files"]} == {file for (file,) in files}
    assert sum(values["hdt_open_alerts"].values()) == alerts


def test_printed_figures_equal_file(values, sample_home):
    assert figures(metrics("--home", sample_home).output) == values


def test_missing_night_takes_one_line(tmp_path):
    result = metrics("--home", tmp_path)
    assert isinstance(result.exception, StopError)
    assert "run `hdt nightly" in str(result.exception)


def test_rules_use_exported_figures(sample_home):
    names = {family.name for family in read_metrics(sample_home).collect()}
    rules = [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]
    assert len(rules) == 4
    assert {name for rule in rules for name in re.findall(r"hdt_\w+", rule["expr"])} <= names
