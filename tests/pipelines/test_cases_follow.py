"""Cases keep id, owner and order number through nights after which their alerts have another first flight."""

import csv
import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import polars as pl
import pytest
from answers import query
from asgi_client import Client
from command import hdt

from pipelines.web.casebook import application
from pipelines.web.guard import LOCAL
from pipelines.web.sign_in import Person

SOON = (datetime.now(UTC) + timedelta(days=5)).date().isoformat()
SAMPLES = Path(__file__).parents[2] / "data_samples"


def new_rules(landing: Path, home: Path) -> None:
    """As after an upgrade: alerts are raised at another loss."""
    (home / "alerts.toml").write_text("fouling = 0.16\n")


def another_aircraft(landing: Path, home: Path) -> None:
    """The model is estimated again from one aircraft more."""
    shutil.copytree(SAMPLES / "AQX/LX-AAD", landing / "AQX/LX-AAD")
    lines = (SAMPLES / "fleet.csv").read_text().splitlines()
    own = [line for line in lines[1:] if line.split(",")[1] in {"LX-AAB", "LX-AAD", "A9-BAC"}]
    (landing / "fleet.csv").write_text("\n".join([lines[0], *own]) + "\n")


def redelivered(landing: Path, home: Path) -> None:
    """The flight that raised the alert comes again, its pack's outlet six degrees colder."""
    (alert_id,) = (row["alert_id"] for row in cases(home).values())
    ((name, pack),) = query(home, f"select raised_flight_id, pack from alerts where alert_id = '{alert_id}'")
    (file,) = landing.glob(f"*/*/acms/{name}.csv")
    rows = pl.read_csv(file)
    is_own = pl.col("pack") == pack
    rows.with_columns(pl.col("hx_out_degc") - 6.0 * is_own).write_csv(file)


def no_rule(landing: Path, home: Path) -> None:
    """As after an upgrade by which no wear is worth an alert."""
    (home / "alerts.toml").write_text("fouling = 0.6\nfouling_soon = 0.6\n")


def page(home: Path, name: str):
    """What the page answers to the link of a case."""
    return Client(application(home, LOCAL, lambda request: Person("Eng"))).get(f"/case/{name}")


def cases(home: Path) -> dict[str, dict]:
    rows = json.loads(hdt("case", "list", "--home", home, "--json").stdout)
    return {row["case_id"]: row for row in rows if row["diagnosis"] == "HX_FOULING"}


def orders(home: Path, out: Path) -> set[str]:
    assert hdt("orders", "--home", home, "--out", out).returncode == 0
    with open(out / "orders.csv") as file:
        return {row["reference"] for row in csv.DictReader(file) if row["component"] == "HX"}


def change_case(home: Path, *words: object) -> None:
    assert hdt("case", *words, "--by", "Ada", "--home", home).returncode == 0


def run(landing: Path, home: Path) -> None:
    assert hdt("nightly", "--landing", landing, "--home", home).returncode == 0


@pytest.mark.parametrize("change", [new_rules, another_aircraft, redelivered])
def test_case_keeps_owner_through_nights(own_home, tmp_path, change: Callable[[Path, Path], None]) -> None:
    landing, home = own_home
    before = cases(home)
    numbers = orders(home, tmp_path)
    for name in before:
        change_case(home, "assign", name, "--to", "Bo")
        change_case(home, "mute", name, "--until", SOON, "--note", "exchanger on order")
    change(landing, home)
    run(landing, home)
    after = cases(home)
    assert before.keys() <= after.keys()
    assert {(after[name]["owner"], after[name]["mute_note"]) for name in before} == {("Bo", "exchanger on order")}
    for name in before:
        change_case(home, "reopen", name, "--note", "it came")
    run(landing, home)
    assert numbers <= orders(home, tmp_path)
    renamed = [row for name, row in after.items() if name in before and row["alert_id"] != name]
    assert all(f"{name}  " in hdt("case", "show", before[name]["alert_id"], "--home", home).stdout for name in before)
    assert {page(home, row["alert_id"]).status_code for row in (*before.values(), *after.values())} == {200}
    assert renamed or change is another_aircraft


def test_link_of_withdrawn_case_answers(own_home) -> None:
    landing, home = own_home
    before = cases(home)
    no_rule(landing, home)
    run(landing, home)
    assert cases(home) == {}
    answers = [page(home, name) for name in before]
    assert {answer.status_code for answer in answers} == {200}
    assert all("withdrawn by the night of" in answer.text for answer in answers)
