"""Cases keep id, owner and order number through nights after which their alerts have another first flight."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from command import hdt

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


def cases(home: Path) -> dict[str, dict]:
    rows = json.loads(hdt("case", "list", "--home", home, "--json").stdout)
    return {row["case_id"]: row for row in rows if row["diagnosis"] == "HX_FOULING"}


def orders(home: Path, out: Path) -> set[str]:
    assert hdt("orders", "--home", home, "--out", out).returncode == 0
    with open(out / "orders.csv") as file:
        return {row["reference"] for row in csv.DictReader(file) if row["component"] == "HX"}


@pytest.mark.parametrize("change", [new_rules, another_aircraft])
def test_a_case_keeps_its_owner_through_nights(own_home, tmp_path, change: Callable[[Path, Path], None]) -> None:
    landing, home = own_home
    before, numbers = cases(home), orders(home, tmp_path)
    for name in before:
        assert hdt("case", "assign", name, "--to", "Bo", "--by", "Ada", "--home", home).returncode == 0
    change(landing, home)
    assert hdt("nightly", "--landing", landing, "--home", home).returncode == 0
    after = cases(home)
    assert before.keys() <= after.keys()
    assert {after[name]["owner"] for name in before} == {"Bo"}
    assert numbers <= orders(home, tmp_path)
    moved = [row for name, row in after.items() if name in before and row["alert_id"] != name]
    assert all(f"{name}  " in hdt("case", "show", before[name]["alert_id"], "--home", home).stdout for name in before)
    assert moved or change is not new_rules
