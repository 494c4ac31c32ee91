"""The page over a real home, an empty one, five flights, fifty aircraft and a hostile fleet."""

import base64
import re
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from alert_texts import evidence_of, text_columns

from pipelines.report.facts import Facts, read_facts
from pipelines.report.page import page, write_report
from pipelines.report.tonight import tonight_with_cards
from pipelines.report.tracks import DAY_MS, SIDE, Frame, drawing, fleet_band, tracks
from pipelines.report.words import day, diagnosis, pack_name
from pipelines.storage.publication import publish

PARTS = {"tonight", "alerts", "tracks", "trust", "gaps", "quarantine", "yield", "design", "figures", "card"}


@pytest.fixture(scope="module")
def facts(sample_home: Path) -> Facts:
    return read_facts(sample_home)


@pytest.fixture(scope="module")
def sample_page(facts: Facts) -> str:
    return page(facts)


@pytest.fixture
def parsed(read, sample_page):
    return read(sample_page)


def section(page: str, name: str) -> str:
    return page.split(f'id="{name}"')[1].split("</section>", maxsplit=1)[0]


def sound(parsed) -> None:
    """What holds of every page, whatever it shows."""
    assert not parsed.open
    assert not parsed.crossed
    ids = parsed.values("id")
    assert len(ids) == len(set(ids))
    assert set(ids) >= PARTS
    # links stay on the page and lead somewhere; nothing is fetched
    links = [v for v in parsed.values("href") if v != "data:,"]
    assert {v[:1] for v in links} <= {"#"}
    assert {v[1:] for v in links} <= set(ids)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in parsed.values("src"))
    # ours alone runs; no other script may
    assert parsed.tags.count("script") == policy(parsed).count("sha256-") == 1
    assert not re.search(r"\b(nan|None|inf)\b", " ".join(parsed.words))


def policy(parsed) -> str:
    return next(v for v in parsed.values("content") if v.startswith("default-src"))


def test_sample_page_is_sound(parsed, sample_page):
    sound(parsed)
    assert "://" not in sample_page


def test_policy_forbids_what_is_foreign(parsed):
    """Nothing is fetched, no text becomes a program."""
    styles = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    assert policy(parsed).startswith(f"{styles}; script-src 'sha256-")
    assert "unsafe-eval" not in policy(parsed)


def test_same_catalog_gives_same_bytes(sample_home, sample_page, tmp_path):
    write_report(sample_home, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == sample_page


def pack_rows(facts: Facts) -> list[dict]:
    return [unit.values for unit in facts.rows if unit["component"] is None]


@pytest.fixture
def packs(facts) -> list[str]:
    return [pack_name(row) for row in pack_rows(facts)]


def test_every_pack_has_a_card(packs, parsed):
    cards = [v for v in parsed.values("id") if v.startswith("pack-")]
    assert len(cards) == len(packs) == 4
    assert all(parsed.text().count(p) >= 2 for p in packs)


@pytest.fixture
def first_table(read, sample_page) -> str:
    return read(section(sample_page, "tonight")).text()


def test_first_table_has_every_pack(packs, first_table):
    assert [first_table.count(p) for p in packs] == [1] * 4


def test_first_table_has_open_alerts(facts, first_table):
    alerts = facts["alerts"].filter(pl.col("closed_at").is_null()).to_dicts()
    assert alerts
    assert all(f"{diagnosis(a['diagnosis'])} since {day(a['raised_at'])}" in first_table for a in alerts)


def test_figures_are_embedded(sample_page):
    figures = section(sample_page, "figures")
    assert figures.count("<figure") == 4
    images = re.findall(r'<img(?: class="(si|us)")? src="data:image/svg\+xml;base64,([^"]+)" alt="([^"]+)"', figures)
    assert [system for system, _, _ in images] == ["si", "us"] * 3 + [""]  # the last is in per cent
    assert all(b"<svg" in base64.b64decode(image) for _, image, _ in images)
    assert all(alt.startswith("Figure 1") for _, _, alt in images)


def test_chart_ends_at_present_state(facts, sample_page):
    """The last point of each chart is the pack's own with its interval; and whose the other is."""
    charts = tracks(facts)
    for row in pack_rows(facts):
        name = f"pack-{row['operator']}-{row['tail']}-{row['pack']}"
        own = charts[name]
        layout = drawing(charts, name, fleet_band(facts), 0.15)
        assert f'points="{layout["lines"]["own"]}"' in sample_page
        x, y = map(float, layout["lines"]["own"].split()[-1].split(","))
        x0, x1 = own["x"]
        low, top = own["y"]
        assert x0 + x / SIDE * (x1 - x0) == pytest.approx(own["own"]["x"][-1], abs=1e-4 * (x1 - x0))
        assert top - y / SIDE * (top - low) == pytest.approx(own["own"]["y"][-1], abs=0.01)
        assert own["own"]["y"][-1] == pytest.approx(100 * row["loss"], abs=0.06)
        around = 100 * 1.645 * row["loss_sd"]
        assert own["own"]["high"][-1] - own["own"]["low"][-1] == pytest.approx(2 * around, abs=0.11)
        assert own["own"]["x"][-1] == row["last_departed_at"].timestamp() * 1000
        assert own["other"] == f"pack-{row['operator']}-{row['tail']}-{3 - row['pack']}"


def with_values(facts: Facts, **values) -> Facts:
    """The same fleet, each row with other values."""
    rows = [replace(unit, values=unit.values | values) for unit in facts.rows]
    return replace(facts, rows=rows)


def with_outlook(facts: Facts, **values) -> Facts:
    """The same fleet, each pack with an outlook of its exchanger at two flights a day."""
    outlook = {"outlook_component": "HX", "flights_per_day": 2.0, "is_bound": False}
    return with_values(facts, **(outlook | values))


LEFT = {"rul_low": 20.0, "rul_flights": 60.0, "rul_high": 150.0}


def test_forecast_fans_out_from_loss(facts):
    for track in tracks(with_outlook(facts, **LEFT)).values():
        now = track["now"]
        loss = track["own"]["y"][-1]
        level = max(38.0, loss)
        assert track["fan"]["area"] == [(now, loss), (now + 10 * DAY_MS, level), (now + 75 * DAY_MS, level)]
        assert track["fan"]["median"] == [(now, loss), (now + 30 * DAY_MS, level)]


def test_distant_message_has_no_median(facts):
    charts = tracks(with_outlook(facts, **LEFT, is_bound=True))
    assert {len(t["fan"]["median"]) for t in charts.values()} == {0}


@pytest.mark.parametrize("column", ["flights_per_day", "rul_low"])
def test_lacking_outlook_draws_no_fan(facts, column):
    charts = tracks(with_outlook(facts, **(LEFT | {column: None})))
    assert [t["fan"] for t in charts.values()] == [{}] * len(charts)


def test_compressor_forecast_has_own_loss(facts):
    fouling = facts["health"].filter(parameter="hx_fouling")
    half = fouling.with_columns(parameter=pl.lit("cc_efficiency_loss"), value=0.5 * pl.col("value"))
    worn = replace(facts, frames=facts.frames | {"health": pl.concat([fouling, half])})
    for track in tracks(with_outlook(worn, **LEFT, outlook_component="CC")).values():
        assert track["fan"]["area"][0][1] == track["cc"]["y"][-1] != track["own"]["y"][-1]
        assert track["fan"]["level"] == max(25.0, track["cc"]["y"][-1])


def test_frame_places_its_corners():
    frame = Frame((0.0, 10.0), (-10.0, 40.0))
    assert (frame.across(0.0), frame.across(10.0), frame.down(40.0), frame.down(-10.0)) == (0.0, SIDE, 0.0, SIDE)
    assert frame.line([(5.0, 15.0)]) == "500,500"
    area = {"x": [0.0, 10.0], "low": [-10.0, -10.0], "high": [40.0, 15.0]}
    assert frame.area(area) == "0,0 1000,500 1000,1000 0,1000"


def test_card_offers_every_choice(facts):
    cards = tonight_with_cards(facts, 0.15)["cards"]
    alerts = [a for c in cards for a in c["alerts"]]
    assert {a["alert_id"] for a in alerts} == set(facts["alerts"].filter(pl.col("closed_at").is_null())["alert_id"])
    exchangers = [a for a in alerts if a["component"] == "HX"]
    assert exchangers
    for alert in exchangers:
        choices = {c[0].partition(" until ")[0]: c for c in alert["choices"]}
        assert set(choices) == {"inspect", "wash", "replace", "nothing"}
        assert all("min, " in c[3] for name, c in choices.items() if name != "nothing")
        assert choices["inspect"][1] == choices["nothing"][1], "a look alone changes no chance"


def test_fifty_aircraft_stay_small(facts):
    frames = {
        name: pl.concat(f.with_columns(tail=pl.format("T{}-{}", i, pl.col("tail").str.slice(-3))) for i in range(25))
        for name, f in facts.frames.items()
        if "tail" in f.columns
    }
    rows = [
        replace(unit, values=unit.values | {"tail": f"T{i}-{unit['tail'][-3:]}"})
        for i in range(25)
        for unit in facts.rows
    ]
    whole = page(replace(facts, rows=rows, frames=facts.frames | frames))
    assert whole.count('class="track"') >= 100
    assert len(whole.encode()) < 5_000_000


def band_of(facts: Facts, n_packs: int) -> dict:
    """The band of a made fleet, the k-th pack of which lost k per cent all the time."""
    days = pl.datetime_range(pl.datetime(2024, 1, 1), pl.datetime(2024, 6, 1), "1d", time_zone="UTC", eager=True)
    own = {"departed_at": days, "operator": "AAA", "pack": 1, "parameter": "hx_fouling"}
    rows = [pl.DataFrame(own | {"tail": f"T-{k}", "value": k / 100}) for k in range(n_packs)]
    return fleet_band(replace(facts, frames=facts.frames | {"health": pl.concat(rows)}))


def test_band_holds_nine_of_ten(facts):
    band = band_of(facts, 41)
    assert len(band["x"]) > 30
    assert (set(band["low"]), set(band["high"])) == ({2.0}, {38.0})


def test_few_packs_have_no_band(facts):
    assert band_of(facts, 3)["x"] == []


@pytest.mark.parametrize("units", ["si", "us"])
def test_one_word_chooses_units(facts, units, read):
    html = page(facts, units)
    assert f'<html lang="en" data-units="{units}">' in html
    assert (html.count('class="si"') == html.count('class="us"')) > 0


def test_empty_home_has_a_page(read, tmp_path):
    publish(tmp_path)
    write_report(tmp_path, tmp_path / "report.html")
    parsed = read((tmp_path / "report.html").read_text(encoding="utf-8"))
    sound(parsed)
    text = parsed.text()
    assert "No flight yet." in text
    assert "No alert has been raised." in text
    assert not {"data-chart", "points"} & {name for _, name, _ in parsed.attributes}


def first_flights(facts: Facts, n: int) -> Facts:
    """What the page knows after the first flights of one aircraft, nothing being calibrated."""
    tail = facts["flights"]["tail"][0]
    flights = facts["flights"].filter(tail=tail).head(n)["flight_id"].implode()
    own = pl.col("flight_id").is_in(flights)
    frames = {name: f.filter(tail=tail) if "tail" in f.columns else f for name, f in facts.frames.items()}
    frames = {name: f.filter(own) if "flight_id" in f.columns else f for name, f in frames.items()}
    frames |= {name: frames[name].clear() for name in ("alerts", "messages", "maintenance", "design", "gaps")}
    frames["twin"] = facts["twin"].filter(own, tail=tail)
    nothing = ("rul_flights", "rul_low", "rul_high", "p_event_50", "chance", "loss_sd", "diagnoses", "raised_at",
               "alert_id", "due_low_on", "due_on", "silent_since", "choices")  # fmt: skip
    quiet = dict.fromkeys(nothing) | {"urgency": "none"}
    rows = [replace(unit, values=unit.values | quiet) for unit in facts.rows if unit["tail"] == tail]
    frames |= {"segment": facts["segment"].clear()}
    return replace(facts, rows=rows, frames=frames, card={}, dsm=None)


@pytest.mark.parametrize("n", [1, 5])
def test_few_flights_make_a_page(facts, read, n):
    parsed = read(page(first_flights(facts, n)))
    sound(parsed)
    text = parsed.text()
    assert "Nothing to do tonight. 2 packs watched" in text
    assert "Not calibrated yet" in text


def test_hostile_names_stay_text(facts, read, hostile, parsed):
    evidence = evidence_of(hostile, ("Supports", hostile))

    def poison(frame: pl.DataFrame) -> pl.DataFrame:
        codes = {"gap", "urgency", "parameter", "severity", "scope", "kind", "action", "component"}
        stored = {c: text for c, text in text_columns(evidence, evidence, hostile).items() if c.endswith("_phrases")}
        texts = [c for c, t in frame.schema.items() if t == pl.String and c not in {*codes, *stored}]
        poisoned = [pl.concat_str(pl.col(c).fill_null(""), pl.lit(hostile)).alias(c) for c in texts]
        return frame.with_columns(*poisoned, *(pl.lit(v).alias(c) for c, v in stored.items() if c in frame.columns))

    frames = {name: poison(f) for name, f in facts.frames.items()}
    bad = replace(facts, frames=frames, card={hostile: {hostile: hostile}, "list": [hostile]})
    html = page(bad)
    poisoned = read(html)
    assert poisoned.tags.count("script") == parsed.tags.count("script")
    assert all(source.startswith("data:image/svg+xml;base64,") for source in poisoned.values("src"))
    assert poisoned.tags.count("img") == len(poisoned.values("src")) <= parsed.tags.count("img")
    assert set(poisoned.tags) <= set(parsed.tags) | {"ul"}
    assert not [name for _, name, _ in poisoned.attributes if name.startswith("on")]
    assert {"\u202e", "\x00"}.isdisjoint(html)
