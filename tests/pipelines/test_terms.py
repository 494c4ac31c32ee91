"""Accepted physical terms: a file of the home that the calibration rests on."""

import pytest
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import accept_terms, accepted_terms, terms_file
from pipelines.versions import baseline_inputs


def test_what_is_accepted_makes_the_model_stale(tmp_path):
    before = baseline_inputs(Ledger(tmp_path))
    accept_terms(tmp_path, ["water_spray", "flow_leak", "water_spray"])
    assert accepted_terms(tmp_path) == ("flow_leak", "water_spray")
    assert baseline_inputs(Ledger(tmp_path)) == [*before, "term flow_leak", "term water_spray"]
    accept_terms(tmp_path, [])
    assert baseline_inputs(Ledger(tmp_path)) == before


def test_the_file_may_be_written_by_hand(tmp_path):
    terms_file(tmp_path).write_text("# by hand\n\n inlet_gain \n")
    assert accepted_terms(tmp_path) == ("inlet_gain",)


def test_an_unknown_name_is_refused(tmp_path):
    with pytest.raises(KeyError):
        accept_terms(tmp_path, ["unheard_of"])
    assert not terms_file(tmp_path).exists()


def test_the_command_accepts_and_drops(tmp_path):
    (tmp_path / "catalog.duckdb").touch()  # a home that has seen a night
    run = CliRunner()
    assert run.invoke(app, ["terms", "--home", str(tmp_path), "--accept", "water_spray"]).exit_code == 0
    assert accepted_terms(tmp_path) == ("water_spray",)
    assert run.invoke(app, ["terms", "--home", str(tmp_path), "--drop", "water_spray"]).exit_code == 0
    assert accepted_terms(tmp_path) == ()
    assert run.invoke(app, ["terms", "--home", str(tmp_path), "--accept", "unheard_of"]).exit_code != 0
