"""A trial from its start to its page: what is said is sealed and judged; figures hold the truth of simulated trials."""

import datetime as dt
import doctest
import json
import math
from collections import Counter
from contextlib import contextmanager

import pytest
import trials
from small_catalog import START, alert, catalog, fill, flight, message, replaced

from hdt_trial import evaluation, figures, frozen, intervals, seal
from hdt_trial.commands import app
from hdt_trial.declaration import DEFAULT, TrialError, read_declaration
from hdt_trial.evaluation import evaluate_log
from hdt_trial.figures import judge_alerts
from hdt_trial.judgement import Judge
from hdt_trial.log import entries, faults
from hdt_trial.outcomes import read_outcomes, seal_outcomes
from hdt_trial.page import page
from hdt_trial.seal import declaration_of, seal_night, start

LAST = 200


class World:
    """A catalog that grows by a flight a day."""

    def __init__(self, home, con, monkeypatch):
        self.con = con
        self.home = home
        self.now = 9
        self.tables = {"features_alerts": [], "raw_messages": [], "raw_maintenance": [], "features_work": []}
        for module in (seal, evaluation):
            monkeypatch.setattr(module, "connect", self.connect)

    @contextmanager
    def connect(self, _home):
        until = START + dt.timedelta(days=self.now, hours=12)
        alerts = [a for a in self.tables["features_alerts"] if a["raised_at"] <= until]
        closed = [{"closed_at": a["closed_at"] if (a["closed_at"] or until) < until else None} for a in alerts]
        rows = {
            "features_alerts": [a | ends for a, ends in zip(alerts, closed, strict=True)],
            "raw_messages": [m for m in self.tables["raw_messages"] if m["message_time"] <= until],
            "raw_maintenance": [w for w in self.tables["raw_maintenance"] if w["counts_from"] <= until],
            "features_work": self.tables["features_work"],
            "raw_flights": [flight(n) for n in range(self.now + 1)],
            "prognoses": [prognosis(self.now)],
        }
        fill(self.con, **rows)
        yield self.con

    def night(self, day):
        self.now = day
        return seal_night(self.home, START + dt.timedelta(days=day, hours=14))

    def verdicts(self, source="hdt"):
        return [a.verdict for a in self.score_alerts(source).alerts]

    def score_alerts(self, source="hdt"):
        log = entries(self.home / "trial")
        declared = declaration_of(log)
        with self.connect(self.home) as con:
            outcomes = read_outcomes(con, log, declared)
        return judge_alerts(log, Judge(declared, outcomes), source)


def prognosis(day):
    figures = {"rul_low": 30.0, "rul_flights": 60.0, "rul_high": 120.0, "p_event_50": 0.3, "model_version": "m"}
    return flight(day) | {"pack": 1, "component": "HX", "split": "live"} | figures


@pytest.fixture(scope="module")
def con():
    with catalog() as con:
        yield con


@pytest.fixture
def world(con, tmp_path, monkeypatch):
    return World(tmp_path, con, monkeypatch)


def begin(world, more=""):
    text = DEFAULT.replace("days = 90", "days = 400").replace("early_flights = 150", "early_flights = 60")
    return start(world.home, text + more, START + dt.timedelta(days=9, hours=14))


def seal_nights(world, *days, more=""):
    """Begin a trial and seal these nights of it."""
    begin(world, more)
    for day in days:
        world.night(day)


def test_alerts_are_judged_when_sealed(world):
    """Raised on day 20 and sealed that night, message on day 50: 30 flights. Of the other, the message came first."""
    world.tables |= {
        "features_alerts": [alert("good", 20), alert("late", 120), alert("none", 70, closed=90)],
        "raw_messages": [message(50), message(121)],
        "raw_maintenance": [replaced(52)],
    }
    seal_nights(world, 20, 40, 70, 125, LAST)
    verdicts = {a.alert.known_at.date(): (a.verdict, a.lead_flights) for a in world.score_alerts().alerts}
    day = {n: (START + dt.timedelta(days=n)).date() for n in (20, 70, 125)}
    assert verdicts == {day[20]: ("hit", 30), day[125]: ("after_event", None), day[70]: ("false_alarm", None)}
    assert [e.verdict for e in world.score_alerts().events] == ["hit", "missed"]


@pytest.mark.parametrize(
    ("finding", "verdict"), [("FOULED", "hit"), ("NO_FAULT_FOUND", "false_alarm"), (None, "removed")]
)
def test_removal_is_judged_by_finding(world, finding, verdict):
    world.tables |= {"features_alerts": [alert("one", 20)], "raw_maintenance": [replaced(50, finding)]}
    seal_nights(world, 20, 80)
    assert world.verdicts() == [verdict]


def test_work_showing_loss_answers(world):
    wash = replaced(50, None) | {"action": "CLEANED"}
    verdict = {"verdict": "logged", "in_force": True, "position": 1, "is_shown": True}
    times = {"flown_from": wash["counts_from"], "known_from": wash["counts_from"]}
    world.tables |= {
        "features_alerts": [alert("one", 20)],
        "raw_maintenance": [wash],
        "features_work": [wash | verdict | times],
    }
    seal_nights(world, 20, 80)
    assert world.verdicts() == ["answered"]


def test_withdrawn_alert_still_counts(world):
    """One not yet flown on is open."""
    world.tables["features_alerts"] = [alert("gone", 20), alert("young", 90)]
    begin(world)
    world.night(20)
    del world.tables["features_alerts"][0]
    entry = world.night(91)
    assert entry.body["withdrawn"]["hdt"] == ["gone"]
    assert world.verdicts() == ["false_alarm", "open"]


def test_outcomes_of_file_are_judged(world, tmp_path):
    world.tables["features_alerts"] = [alert("one", 20)]
    begin(world)
    world.night(20)
    file = tmp_path / "shop.csv"
    at = START + dt.timedelta(days=45)
    file.write_text(f"operator,tail,pack,component,at,kind,finding\nAAA,T-1,1,HX,{at.isoformat()},REPLACED,FOULED\n")
    seal_outcomes(world.home, file, START + dt.timedelta(days=46))
    world.night(80)
    assert [(a.verdict, a.lead_flights) for a in world.score_alerts().alerts] == [("hit", 25)]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("AAA,T-1,one,HX,2026-01-01,MESSAGE", "row 2 column pack: 'one'"),
        ("AAA,T-1,1,HX,yesterday,MESSAGE", "row 2 column at: 'yesterday'"),
        ("AAA,T-1,1,HX,2026-01-01,BROKEN", "row 2 column kind: 'BROKEN'"),
        ("AAA,,1,HX,2026-01-01,MESSAGE", "row 2 column tail: None"),
    ],
)
def test_impossible_outcome_names_its_place(world, tmp_path, row, message):
    file = tmp_path / "shop.csv"
    file.write_text(f"operator,tail,pack,component,at,kind\n{row}\n")
    with pytest.raises(TrialError, match=message):
        seal_outcomes(world.home, file)


def test_operator_rules_are_judged_alike(world, tmp_path):
    """A rule given as SQL is sealed; a file is taken at its word."""
    file = tmp_path / "maker.csv"
    file.write_text(f"operator,tail,pack,component,raised_at\nAAA,T-1,1,HX,{START + dt.timedelta(days=45)}\n")
    sql = "select operator, tail, 1 as pack, 'HX' as component, max(departed_at) as raised_at from flights group by all"
    world.tables |= {"features_alerts": [alert("one", 20)], "raw_messages": [message(50)]}
    rules = f'[rule.trend]\nsql = "{sql}"\n[rule.maker]\nfile = "{file}"\n'
    seal_nights(world, 20, 45, 130, more=rules)
    result = evaluation.evaluate(world.home)
    assert set(result.figures) == {"hdt", "trend", "maker"}
    assert world.verdicts("trend") == ["hit", "hit", "too_late", "after_event"]
    assert "[rule.maker]" in result.text
    assert str(file) not in result.text
    assert "max(departed_at)" not in result.text
    assert result.verdicts["maker"]["too_late"] is None  # one alert: kept back
    assert result.agreement["maker"]["ours alone"] is None


def test_changes_after_start_are_sealed(world, monkeypatch):
    begin(world)
    assert "changes" not in world.night(20).body
    monkeypatch.setattr(frozen, "constants", lambda: (("health/alerts.py SHARE", "0.5"),))
    changes = world.night(21).body["changes"]
    assert "constants health/alerts.py SHARE: nothing is now 0.5" in changes
    assert "changes" not in world.night(22).body
    assert list(faults(world.home / "trial")) == []


def test_night_seals_only_news(world):
    world.tables["features_alerts"] = [alert("one", 20)]
    begin(world)
    first = world.night(20)
    again = world.night(20)
    assert [a["alert_id"] for a in first.body["alerts"]["hdt"]] == ["one"]
    assert again.body["alerts"]["hdt"] == []
    assert again.body["prognoses"] == []


def test_nights_are_sealed_as_declared(world):
    start(world.home, DEFAULT, START)
    assert world.night(89)
    assert world.night(90) is None


NO_TOML = (f"x = {'[' * 20_000}{']' * 20_000}", "x = \ud800", "=", f"x = {'9' * 5_000}")
NO_NUMBERS = ("days = 99999999999", "days = -1", "[cost]\nfalse_alarm = inf", "rule = 3", "[cost]\nfalse_alarm = nan")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("days = 0", "days"),
        ("weeks = 3", "no weeks"),
        ('days = "ninety"', "days in the declaration is 'ninety'"),
        ("[alert]\nlate_flights = 200", "late_flights, 200"),
        ('[rule.x]\nsql = "select 1"\nfile = "f"', "rule.x"),
        ("days =", "no TOML"),
        *((text, r"TOML|has no x") for text in NO_TOML),
        *((entry, ".") for entry in NO_NUMBERS),
    ],
)
def test_impossible_declaration_is_refused(text, message):
    with pytest.raises(TrialError, match=message):
        read_declaration(text)


@pytest.mark.parametrize("sql", ["select 1 as operator", "drop table x", "select * from no_such"])
def test_unanswerable_rule_is_refused(world, sql):
    with pytest.raises(TrialError, match="rule own"):
        begin(world, f'[rule.own]\nsql = "{sql}"\n')


def test_command_runs_whole_trial(own_home, tmp_path, capsys):
    """On the sample's home: start, an idle night that seals, a page, and a log that was touched."""
    landing, home = own_home

    def hdt(*words):
        code = app([*words, "--home", str(home)], standalone_mode=False)
        return code or 0, capsys.readouterr()

    assert hdt("trial", "start")[0] == 0
    code, output = hdt("nightly", "--landing", str(landing), "--json")
    digest = json.loads(output.out)["trial_digest"]
    assert (code, len(digest)) == (0, 64)
    assert hdt("trial", "page", "--out", str(tmp_path / "page.html"))[0] == 0
    assert "Shadow trial" in (tmp_path / "page.html").read_text()
    assert "proved up to entry 1" in hdt("trial", "verify", "--digest", digest)[1].out
    assert hdt("dossier", "--out", str(tmp_path / "dossier.html"))[0] == 0
    dossier = (tmp_path / "dossier.html").read_text()
    expected = ("1 Data lineage", "Attached: limits.md", "HX_FOULING", "estimation/fit.py CHANCE", "AQX", digest)
    assert [word for word in expected if word not in dossier] == []
    entry = home / "trial/00001.json"
    entry.write_bytes(entry.read_bytes().replace(b"AQX", b"AQY"))
    code, output = hdt("trial", "verify")
    assert (code, output.err) == (1, "FAULT: entry 1 is not the one whose digest heads.txt holds\n")
    code, output = hdt("nightly", "--landing", str(landing))
    assert code == 1
    assert "the trial was not sealed" in output.err


TRIALS = 50


@pytest.fixture(scope="module")
def declared():
    return trials.declaration()


def evaluate_fleet(seed, tails, declared):
    units = trials.fleet(seed, tails)
    return evaluate_log(trials.log(units), declared, trials.outcomes(units, declared), {})


def test_figures_cover_truth(declared):
    """Truth: the generator's own account of 800 aircraft, lives whole. Trials: 30 aircraft, 300 sealed flights."""
    truth = trials.truth(trials.fleet(10**6, 800), declared)
    coverage = Counter()
    counts = Counter()
    for seed in range(TRIALS):
        for f in evaluate_fleet(seed, 30, declared).figures["hdt"]:
            assert f.interval is not None, f
            low, high = (v if v is not None else s * math.inf for v, s in ((f.interval.low, -1), (f.interval.high, 1)))
            coverage[f.name] += low <= truth[f.name] <= high
            counts[f.name] += 1
    assert set(counts) == set(truth)
    assert {name: n for name, n in coverage.items() if n < 0.88 * TRIALS} == {}


def test_page_names_no_aircraft(declared):
    result = evaluate_fleet(5, 30, declared)
    html = page(result)
    assert [word for word in ("T-0", "AAA", "rehearsal") if word in html] == []
    assert "per 1,000 flights" in html
    assert "events</td>" in html
    assert result.after_the_fact == 0


def test_small_fleet_gives_nothing_away(declared):
    result = evaluate_fleet(5, 3, declared)
    assert {f.interval for f in result.figures["hdt"]} == {None}
    assert all(n is None or n == 0 or n >= declared.minimum.count for n in result.verdicts["hdt"].values())


@pytest.mark.parametrize("module", [figures, intervals])
def test_docstring_examples_hold(module):
    assert doctest.testmod(module).failed == 0
