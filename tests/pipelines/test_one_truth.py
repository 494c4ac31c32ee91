"""Night, headline, ranking, cards and `explain` say one thing of an alert: one order, one badge, then and now apart."""

import datetime as dt
import re
from pathlib import Path

import polars as pl
import pytest
from alert_texts import evidence_of, text_columns
from answers import query
from command import hdt
from nights import empty_home
from small_catalog import START, catalog, flight

from hdt_core.components import component_rows
from pipelines.casework import list_cases
from pipelines.cli.night import print_ranking
from pipelines.digest.changes import changes_since
from pipelines.digest.orders import work_orders
from pipelines.report.explain import explain
from pipelines.report.facts import read_facts
from pipelines.report.page import page
from pipelines.report.words import URGENCY
from pipelines.storage.catalog import connect
from pipelines.storage.publication import publish
from pipelines.storage.store import FLEET

BADGE = r"(T-\d) pack (\d) \(\w+\)\s+AAA.*?\s(Act now|Plan|No action)\s"
THEN = 10
NOW = 40
LOSSES = {("T-1", 1): (0.16, 0.34), ("T-1", 2): (0.02, 0.04), ("T-2", 1): (0.17, 0.21), ("T-2", 2): (0.01, 0.02)}
CHANCES = {("T-1", 1): (0.03, 0.88), ("T-1", 2): (0.0, 0.0), ("T-2", 1): (0.04, 0.2), ("T-2", 2): (0.0, 0.0)}
ALERTS = (
    ("aaaa1111", "T-1", 1, "HX", "HX_FOULING", "medium", "high", None),
    ("aaaa2222", "T-2", 1, "SENSOR", "SENSOR_FAULT", "low", "low", None),
    ("bbbb1111", "T-2", 1, "HX", "HX_FOULING", "medium", "medium", None),
    ("bbbb2222", "T-2", 2, "RAM_DOOR", "RAM_DOOR_FAULT", "high", "high", None),
    ("cccc1111", "T-1", 2, "SENSOR", "SENSOR_FAULT", "low", "low", 20),
)


def tables(tail: str) -> dict[str, list[dict]]:
    """What is stored of one aircraft: two flights that count, the one that raised its alerts and its last."""
    health = []
    prognoses = []
    alerts = []
    for (own, pack), loss in LOSSES.items():
        for n, value, p in zip((THEN, NOW), loss, CHANCES[own, pack], strict=True):
            row = flight(n, tail=tail) | {"pack": pack, "component": "HX"}
            health.append(row | {"parameter": "hx_fouling", "value": value, "sd": 0.01, "unit": "-", "status": "ok"})
            left = {"rul_flights": 200 * (1 - p), "rul_low": 100 * (1 - p), "rul_high": 300 * (1 - p)}
            prognoses.append(row | left | {"p_event_50": p, "model_version": "m", "split": "live"})
        if own != tail:
            del health[-2:], prognoses[-2:]
    for name, own, pack, component, diagnosis, then, now, closed in ALERTS:
        if own == tail:
            identity = {"alert_id": name, "pack": pack, "component": component, "diagnosis": diagnosis}
            ends = None if closed is None else START + dt.timedelta(days=closed)
            row = {"raised_severity": then, "severity": now, "closed_at": ends}
            evidence_now = evidence_of(f"Now {name}", ("Supports", "a"), ("Against", "b"))
            row |= text_columns(evidence_of(f"Then {name}"), evidence_now, f"Do {name}.")
            raised = flight(THEN, tail=tail)
            times = {"raised_flight_id": raised["flight_id"], "raised_at": raised["departed_at"]}
            alerts.append(raised | identity | row | times | {"now_flight_id": flight(NOW, tail=tail)["flight_id"]})
    flights = [flight(n, tail=tail) | {"landed_at": START, "source": "acms"} for n in range(NOW + 1)]
    return {"raw_flights": flights, "twin_health": health, "features_alerts": alerts, "prognoses": prognoses}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("home")
    store = empty_home(where)
    outlook = []
    for tail in ("T-1", "T-2"):
        for name, rows in tables(tail).items():
            if name == "prognoses":
                outlook += rows
            else:
                store.replace(name, [("AAA", tail)], pl.DataFrame(rows, infer_schema_length=None))
    store.replace("prognoses", [FLEET], pl.DataFrame(outlook))
    store.replace("components", [FLEET], pl.DataFrame(component_rows()))
    publish(where)
    return where


@pytest.fixture(scope="module")
def report(home: Path) -> str:
    return page(read_facts(home))


def part(report: str, name: str) -> str:
    """Text of a section, tags taken out."""
    text = re.sub(r"<[^>]+>", " ", report.partition(f'id="{name}"')[2].partition("</section>")[0])
    return text.replace("\N{NO-BREAK SPACE}", " ")


OPEN = {"aaaa1111": "act", "bbbb2222": "act", "bbbb1111": "plan", "aaaa2222": "plan"}
"""Urgency of the open alerts, in their order."""
RANKED = [
    ("T-1", 1, "act", "HX_FOULING"), ("T-2", 2, "act", "RAM_DOOR_FAULT"),
    ("T-2", 1, "plan", "HX_FOULING, SENSOR_FAULT"), ("T-1", 2, "none", None),
]  # fmt: skip
NAMES = ["T-1 pack 1 (left)", "T-2 pack 2 (right)", "T-2 pack 1 (left)"]


@pytest.mark.parametrize(
    ("sql", "expected"),
    [
        ("select alert_id, urgency from open_alerts order by place", [*OPEN.items()]),
        ("select tail, pack, urgency, diagnoses from fleet_ranking order by place", RANKED),
    ],
)
def test_catalog_orders_by_urgency(home, sql, expected):
    assert query(home, sql) == expected


def test_cards_follow_the_catalog(report):
    card = r"<h3>([^<]*) <span|<h4>[^<]*<span class=\"tag \w+\">([^<]*)</span>[^<]*<span class=\"small\">case (\w+)"
    cards = re.findall(card, report)
    in_order = [NAMES[0], "aaaa1111", NAMES[1], "bbbb2222", NAMES[2], "bbbb1111", "aaaa2222", "T-1 pack 2 (right)"]
    assert [name or case for name, _, case in cards] == in_order
    assert {case: badge for _, badge, case in cards if case} == {case: URGENCY[u] for case, u in OPEN.items()}


def test_first_table_follows_the_catalog(report):
    tonight = part(report, "tonight")
    assert sorted(NAMES, key=tonight.index) == NAMES
    badges = re.findall(BADGE, tonight, re.DOTALL)
    assert badges == [(tail, str(pack), URGENCY[urgency]) for tail, pack, urgency, _ in RANKED]


@pytest.mark.parametrize(("name", "urgency"), OPEN.items())
def test_explain_names_the_urgency(home, name, urgency):
    assert f"{URGENCY[urgency]}. Alert {name}." in str(explain(home, name))


def test_terminal_shares_the_order(home, capsys):
    print_ranking(home)
    assert re.findall(r"AAA (T-\d) (\d)", capsys.readouterr().out) == [(tail, str(pack)) for tail, pack, *_ in RANKED]


def test_other_outputs_share_the_order(home):
    """Digest, orders and `case list`."""
    with connect(home) as con:
        orders = work_orders(con, {})["alert_id"].to_list()
    digest, listed = ([r["alert_id"] for r in rows] for rows in (changes_since(home).changes["new"], list_cases(home)))
    assert orders == digest == listed == [*OPEN]


@pytest.mark.parametrize(("tail", "pack"), [row[:2] for row in RANKED])
def test_printed_name_explains_the_pack(home, tail, pack):
    assert str(explain(home, f"AAA {tail} {pack}")).startswith(f"AAA {tail} pack {pack}")


@pytest.mark.parametrize(("chance", "urgency"), [(0.501, "act"), (0.499, "plan"), (0.101, "plan"), (0.099, "none")])
def test_chance_decides_the_urgency(chance, urgency):
    """30 flights lie before the end of 30 days: the hazard between 25 and 50 flights is even."""
    points = {f"p_event_{n}": min(1.0, chance * n / 30) for n in (25, 50, 100, 200, 300)}
    points["p_event_50"] = 1 - (1 - chance) ** 5 / (1 - points["p_event_25"]) ** 4
    own = tables("T-1") | {"features_alerts": []}
    outlook = [row | points for row in own["prognoses"] if row["pack"] == 1]
    with catalog(**own | {"prognoses": outlook}) as con:
        ((got, expected),) = con.sql("select urgency, chance from unit_urgencies").fetchall()
        ranked = con.sql("select urgency from fleet_ranking where pack = 1").fetchall()
    assert expected == pytest.approx(chance, abs=1e-6)
    assert (got, ranked) == (urgency, [(urgency,)])


def test_card_parts_then_from_now(report):
    """What was true when it was raised and what is true now, each with its date, in the same words."""
    card = part(report, "tracks").partition("case aaaa1111")[2].partition("case bbbb2222")[0]
    then, now = re.split(r"\bNow\b", card.partition("When raised")[2], maxsplit=1)
    at_first = ("2024-03-11 06:00 UTC", "16 % (14 to 18)", "more than 97", "3 %", "medium")
    today = ("2024-04-10 06:00 UTC", "34 % (32 to 36)", "24 (12 to 36)", "88 %", "high")
    assert [p for text, phrases in ((then, at_first), (now, today)) for p in phrases if p not in text] == []
    tonight = part(report, "tonight")
    row = tonight[tonight.index("T-1 pack 1") : tonight.index("T-2 pack 2")]
    assert all(text in row for text in ("34 % (32 to 36)", "24 (12 to 36)", "88 %", "fouling since 2024-03-11"))
    assert "16 %" not in row


def test_card_weighs_the_evidence(report):
    card = part(report, "tracks").partition("case aaaa1111")[2].partition("case bbbb2222")[0]
    assert card.index("Now aaaa1111") < card.index("Why it was raised") < card.index("Then aaaa1111")
    assert [role for role in ("Supports:", "Neutral:", "Against:") if role in card] == ["Supports:", "Against:"]


@pytest.mark.parametrize("words", ["T-1", "t-1", "T-1 1", "T-1/1", "AAA T-1", "AAA T-1 1", "T-1 pack 1 (left)"])
def test_any_name_explains_the_pack(home, words):
    answer = str(explain(home, words))
    head = "AAA T-1 pack 1 (left): Act now since 2024-04-10. Heat transfer lost 34 % (32 to 36); flights left 24"
    assert answer.startswith(f"{head} (12 to 36)")
    then, now = answer.split("When raised (2024-03-11 06:00 UTC, after T-1_20240311_01, medium)")[1].split("Now (after")
    assert "flights left (90 %) more than 97; message in 50 flights 3 %. Then aaaa1111." in then
    assert "flights left (90 %) 24 (12 to 36); message in 50 flights 88 %. Now aaaa1111." in now


def test_tail_explains_its_worst_pack(home):
    answer = str(explain(home, "T-2"))
    assert answer.startswith("AAA T-2 pack 2 (right): Act now since")
    assert "Do bbbb2222." in answer
    assert "Also AAA T-2 pack 1 (left): Plan, heat exchanger fouling, sensor fault." in answer


def test_pack_explains_urgent_alert_first(home):
    answer = str(explain(home, "T-2 1"))
    assert answer.index("Do bbbb1111.") < answer.index("Do aaaa2222.")
    assert "Do bbbb2222." not in answer


def test_quiet_pack_names_last_alert(home):
    last = "No alert is open. The last, sensor fault, closed 2024-03-21: alert cccc1111."
    assert last in str(explain(home, "T-1 2"))


def test_closed_alert_has_its_end(home):
    answer = str(explain(home, "cccc1111"))
    assert "closed 2024-03-21." in answer
    assert "At its end (after" in answer


def test_words_need_no_quotes(home):
    done = hdt("explain", "T-1", "1", "--home", home)
    assert done.returncode == 0, done.stderr
    assert "AAA T-1 pack 1 (left): Act now since" in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [("bbbb", "2 alerts begin with bbbb"), ("T-1 3", "no pack or alert"), ("", "no pack or alert")],
)
def test_unknown_name_is_refused(home, words, message):
    done = hdt("explain", words, "--home", home)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert message in done.stderr
