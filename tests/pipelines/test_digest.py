"""After a night: what changed, for whom it is told, and work orders."""

import datetime as dt
import json
from pathlib import Path

import polars as pl
import pytest
from digest_nights import FIRST, SECOND, flight, publish_night
from small_catalog import catalog, fouling
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.digest.changes import EMPTY, compare, read_state
from pipelines.digest.changes import changes_since as since
from pipelines.digest.orders import work_orders
from pipelines.digest.render import as_html, as_json, as_text
from pipelines.storage.catalog import connect


@pytest.fixture(scope="module")
def two_nights(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("two") / "home"
    publish_night(home, FIRST)
    publish_night(home, SECOND)
    return home


def test_digest_lists_changes_by_kind(two_nights):
    digest = since(two_nights)
    assert {kind: [r.get("alert_id") for r in rows] for kind, rows in digest.changes.items()} == {
        "new": ["cccc"], "worse": ["aaaa"], "closed": ["bbbb"], "moved": [None],
    }  # fmt: skip
    text = as_text(digest)
    assert "low to high" in text
    assert "flights left 10 (5 to 30); 2 flights ago 80 (40 to 120)." in text
    assert "=wash & look <now>" in text
    assert "=wash &amp; look &lt;now&gt;" in as_html(digest)
    assert json.loads(as_json(digest))["changes"]["closed"][0]["closed_on"] == f"{flight(42)['departed_at']:%Y-%m-%d}"
    with connect(two_nights) as con:
        now = read_state(con)
    assert not compare(now, now).changes
    assert compare(EMPTY, now).of("AAA").changes == compare(EMPTY, now).changes
    assert not compare(EMPTY, now).of("ZZZ").changes


def test_recovery_without_work_is_a_gap():
    flown = [fouling(n, 0.2 if n < 50 else 0.01, pack=pack) for n in range(70) for pack in (1, 2)]
    digest = compare(EMPTY, read_state(catalog(twin_health=flown)))
    text = as_text(digest)
    for pack in ("1 (left)", "2 (right)"):
        assert f"T-1 pack {pack}: HX recovered on 2024-04-20 as after a wash" in text  # fifty days after March 1


@pytest.mark.parametrize(
    ("then", "now", "flown", "expected"),
    [
        ((40, 80, 120), (30, 70, 110), 10, False),  # ten flights flown, ten fewer left
        ((40, 80, 120), (10, 29, 60), 10, True),
        ((40, 80, 120), (60, 111, 200), 10, True),
        ((40, 200, 300), (200, 300, 300), 10, False),  # 300 stands for 300 or more
    ],
)
def test_outlook_beyond_interval_has_moved(then, now, flown, expected):
    def state(outlook: tuple[float, ...], n: int, life: int = 0) -> dict:
        names = dict(zip(("rul_low", "rul_flights", "rul_high"), outlook, strict=True))
        row = {"operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "life": life, "n_flights": n}
        return EMPTY | {"outlook": {"one": row | names}}

    assert ("moved" in compare(state(then, 20), state(now, 20 + flown)).changes) is expected
    assert not compare(state(then, 20), state(now, 20 + flown, life=1)).changes, "another unit has its own outlook"


def test_work_orders_have_due_dates(two_nights, tmp_path):
    answer = CliRunner().invoke(app, ["orders", "--home", str(two_nights), "--out", str(tmp_path / "out")])
    assert answer.exit_code == 0, answer.output
    names = ["reference", "operator", "tail", "pack", "component", "action", "due", "reason", "case_id", "alert_id"]
    names += ["minutes", "people", "tools", "part", "zone", "task"]
    sheet = pl.read_csv(tmp_path / "out/orders.csv", infer_schema=False)
    assert sheet.columns == names
    assert sheet["action"].to_list() == ["'=wash & look <now>"] * 2, "no formula for a spreadsheet"
    rows = json.loads((tmp_path / "out/orders.json").read_text())
    assert [r["alert_id"] for r in rows] == ["aaaa", "cccc"]
    # five flights at two a day after the last one: two days and a half later the message may have come
    assert {r["due"] for r in rows} == {f"{flight(42)['departed_at'] + dt.timedelta(days=3):%Y-%m-%d}"}
    assert [(r["minutes"], r["people"], r["task"]) for r in rows] == [(45, 1, "21-52-00-210-801")] * 2
    page = (tmp_path / "out/orders.html").read_text()
    assert "45 min, 1 person<br>task 21-52-00-210-801<br>zone 191/192" in page
    assert "HDT-aaaa" in page
    assert "&lt;now&gt;" in page
    with connect(two_nights) as con:
        assert work_orders(con, {}, "ZZZ").is_empty()
