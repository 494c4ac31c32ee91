"""After a night: what changed, for whom, and work orders."""

import datetime as dt
import json
from pathlib import Path

import polars as pl
import pytest
from command import hdt
from digest_nights import FIRST, SECOND, flight, publish_night
from small_catalog import catalog, fouling

from pipelines.digest.changes import EMPTY, Digest, compare, read_state
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


@pytest.fixture(scope="module")
def digest(two_nights) -> Digest:
    return since(two_nights)


@pytest.fixture(scope="module")
def last_state(two_nights) -> dict:
    """The state after both nights."""
    with connect(two_nights) as con:
        return read_state(con)


def test_digest_lists_changes_by_kind(digest):
    names = {kind: [r.get("alert_id") for r in rows] for kind, rows in digest.changes.items()}
    assert names == {"new": ["cccc"], "worse": ["aaaa"], "closed": ["bbbb"], "moved": [None]}


def test_text_names_the_changes(digest):
    parts = ("low to high", "flights left 10 (5 to 30); 2 flights ago 80 (40 to 120).", "=wash & look <now>")
    assert [part for part in parts if part not in as_text(digest)] == []


def test_html_is_escaped(digest):
    assert "=wash &amp; look &lt;now&gt;" in as_html(digest)


def test_json_has_the_day(digest):
    (closed,) = json.loads(as_json(digest))["changes"]["closed"]
    assert closed["closed_on"] == f"{flight(42)['departed_at']:%Y-%m-%d}"


def test_same_state_has_no_change(last_state):
    assert not compare(last_state, last_state).changes


def test_digest_keeps_to_an_operator(last_state):
    digest = compare(EMPTY, last_state)
    assert digest.of("AAA").changes == digest.changes
    assert not digest.of("ZZZ").changes


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
    assert ("moved" in compare(state(then, 20), state(now, 20 + flown)).changes) is expected


def state(outlook: tuple[float, ...], n: int, life: int = 0) -> dict:
    names = dict(zip(("rul_low", "rul_flights", "rul_high"), outlook, strict=True))
    row = {"operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "life": life, "n_flights": n}
    return EMPTY | {"outlook": {"one": row | names}}


@pytest.mark.parametrize(
    ("then", "now"),
    [
        ((40, 80, 120), (30, 70, 110)),
        ((40, 80, 120), (10, 29, 60)),
        ((40, 80, 120), (60, 111, 200)),
        ((40, 200, 300), (200, 300, 300)),
    ],
)
def test_new_unit_has_own_outlook(then, now):
    assert not compare(state(then, 20), state(now, 30, life=1)).changes


@pytest.fixture(scope="module")
def orders(two_nights) -> Path:
    """The folder in which the command writes work orders."""
    folder = two_nights.parent / "orders"
    done = hdt("orders", "--home", two_nights, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def order_rows(orders) -> list[dict]:
    return json.loads((orders / "orders.json").read_text())


def test_sheet_of_orders_has_columns(orders):
    names = ["reference", "operator", "tail", "pack", "component", "action", "due", "reason", "case_id", "alert_id"]
    names += ["minutes", "people", "tools", "part", "zone", "task"]
    assert pl.read_csv(orders / "orders.csv").columns == names


def test_sheet_of_orders_holds_no_formula(orders):
    sheet = pl.read_csv(orders / "orders.csv", infer_schema=False)
    assert sheet["action"].to_list() == ["'=wash & look <now>"] * 2


def test_work_orders_have_due_dates(order_rows):
    assert [r["alert_id"] for r in order_rows] == ["aaaa", "cccc"]
    # five flights at two a day after the last one: two days and a half later the message may have come
    assert {r["due"] for r in order_rows} == {f"{flight(42)['departed_at'] + dt.timedelta(days=3):%Y-%m-%d}"}


def test_work_orders_name_the_work(order_rows):
    assert [(r["minutes"], r["people"], r["task"]) for r in order_rows] == [(45, 1, "21-52-00-210-801")] * 2


def test_page_of_orders_is_whole(orders):
    page = (orders / "orders.html").read_text()
    parts = ("45 min, 1 person<br>task 21-52-00-210-801<br>zone 191/192", "HDT-aaaa", "&lt;now&gt;")
    assert [part for part in parts if part not in page] == []


def test_other_operator_has_no_order(two_nights):
    with connect(two_nights) as con:
        assert work_orders(con, {}, "ZZZ").is_empty()
