"""The row of a unit is the same in every output, also where no alert is open."""

from datetime import date
from pathlib import Path

import pytest
from asgi_client import Client
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.report.rows import UnitRow, rows_of
from pipelines.web.casebook import application
from pipelines.web.guard import LOCAL
from pipelines.web.sign_in import Person


@pytest.fixture(scope="module")
def units(sample_home: Path) -> list[UnitRow]:
    rows = [unit for unit in rows_of(sample_home) if unit.needs_work]
    assert rows
    return rows


@pytest.fixture(scope="module")
def outputs(sample_home: Path, tmp_path_factory) -> dict[str, str]:
    """The text of each output, without line breaks."""
    folder = tmp_path_factory.mktemp("outputs")
    write = {"report": ["--out", str(folder / "report.html")], "orders": ["--out", str(folder)]}
    texts = {name: run(name, sample_home, *more) for name, more in write.items()}
    texts["report"] = (folder / "report.html").read_text(encoding="utf-8")
    texts["orders"] = (folder / "orders.html").read_text(encoding="utf-8")
    texts["case list"] = run("case", sample_home, before="list")
    texts["digest"] = run("digest", sample_home)
    texts["page"] = Client(application(sample_home, LOCAL, lambda request: Person("Ada"))).get("/").text
    return {name: " ".join(text.split()) for name, text in texts.items()}


def run(command: str, home: Path, *more: str, before: str = "") -> str:
    words = [word for word in (command, before, "--home", str(home), *more) if word]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "300"})
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("output", ["report", "orders", "case list", "digest", "page"])
def test_output_lists_units_needing_work(units, outputs, output):
    missing = [unit.name() for unit in units if f"{unit['tail']} pack {unit['pack']}" not in names_in(outputs[output])]
    assert missing == []


def names_in(text: str) -> str:
    """The text with a tail and its pack beside each other, as orders have them in two lines."""
    return text.replace("<br>", " ")


@pytest.mark.parametrize("output", ["report", "digest", "page"])
def test_task_has_the_same_words(units, outputs, output):
    assert [unit.name() for unit in units if unit.to_do() not in outputs[output]] == []


def test_explain_has_the_same_words(sample_home, units):
    texts = {unit.name(): run("explain", sample_home, f"{unit['tail']} {unit['pack']}") for unit in units}
    parts = [(unit.name(), part) for unit in units for part in (unit.to_do(), unit.effort(), unit.cost())]
    assert [(name, part) for name, part in parts if part not in texts[name]] == []


def test_message_come_has_its_day():
    come = UnitRow({"came_at": date(2024, 6, 9), "came_flights_ago": 9}, {})
    assert come.flights_left() == "none since 2024-06-09, 9 flights ago"


def test_message_phrase_has_one_noun():
    raised = UnitRow({"message_at": date(2024, 6, 9), "message_flights": 1, "message_flown": 4}, {})
    assert raised.message_phrase() == "message raised on 2024-06-09, not answered"
