"""The page over a real home, an empty one, five flights, fifty aircraft and a hostile fleet."""

import re
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from pipelines.report import write_report
from pipelines.report.facts import Facts, read_facts
from pipelines.report.page import page
from pipelines.report.words import pack_name
from pipelines.storage.catalog import publish

PARTS = {"tonight", "ranking", "alerts", "tracks", "gaps", "quarantine", "yield", "design", "figures", "card"}


@pytest.fixture(scope="module")
def facts(sample_home: Path) -> Facts:
    return read_facts(sample_home)


@pytest.fixture(scope="module")
def sample_page(facts: Facts) -> str:
    return page(facts)


def sound(found) -> None:
    """What holds of every page, whatever it shows."""
    assert not found.open
    assert not found.crossed
    ids = found.values("id")
    assert len(ids) == len(set(ids))
    assert set(ids) >= PARTS
    # links stay on the page and lead somewhere; nothing is fetched
    links = [v for v in found.values("href") if v != "data:,"]
    assert {v[:1] for v in links} <= {"#"}
    assert {v[1:] for v in links} <= set(ids)
    assert not found.values("src")
    assert found.tags.count("script") == 1
    assert not re.search(r"\b(nan|None|inf)\b", " ".join(found.words))


def test_the_sample_page_is_sound(read, sample_page):
    sound(read(sample_page))
    assert "://" not in sample_page


def test_same_catalog_same_bytes(sample_home, sample_page, tmp_path):
    write_report(sample_home, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == sample_page


def test_every_pack_is_ranked_and_drawn(facts, read, sample_page):
    found = read(sample_page)
    packs = [pack_name(r) for r in facts["ranking"].to_dicts()]
    assert len(packs) == 4
    drawn = [v for v in found.values("id") if v.startswith("pack-")]
    assert len(drawn) == len(packs)
    text = "".join(found.words)
    assert all(text.count(p) >= 2 for p in packs)


def test_the_headline_names_each_pack_with_an_open_alert_and_its_action(facts, read, sample_page):
    tonight = read(sample_page.split('id="tonight"')[1].split("</section>")[0])
    text = "".join(tonight.words)
    opened = facts["alerts"].filter(pl.col("closed_at").is_null()).to_dicts()
    for alert in opened:
        assert pack_name(alert) in text
        assert alert["recommended_action"].rstrip(".") in text


def test_the_figures_are_drawn(sample_page):
    figures = sample_page.split('id="figures"')[1].split("</section>")[0]
    assert figures.count("<figure") == 4
    assert figures.count("<svg") == 5


def test_an_empty_home_says_so(read, tmp_path):
    publish(tmp_path)
    write_report(tmp_path, tmp_path / "report.html")
    found = read((tmp_path / "report.html").read_text(encoding="utf-8"))
    sound(found)
    text = "".join(found.words)
    assert "No flight has arrived yet." in text
    assert "No alert has been raised." in text
    assert "svg" not in found.tags


def first_flights(facts: Facts, n: int) -> Facts:
    """What the page knows after the first flights of one aircraft, nothing being calibrated."""
    tail = facts["flights"]["tail"][0]
    flights = facts["flights"].filter(tail=tail).head(n)["flight_id"].implode()
    frames = {name: f.filter(tail=tail) if "tail" in f.columns else f for name, f in facts.frames.items()}
    frames = {
        name: f.filter(pl.col("flight_id").is_in(flights)) if "flight_id" in f.columns else f
        for name, f in frames.items()
    }
    frames |= {name: frames[name].clear() for name in ("alerts", "messages", "maintenance", "design", "gaps")}
    unknown = pl.lit(None, dtype=pl.Float64)
    ranking = frames["ranking"].with_columns(
        unknown.alias(c) for c in ("rul_flights", "rul_low", "rul_high", "p_event_50", "cc_p_event_50")
    )
    frames["ranking"] = ranking.with_columns(
        diagnoses=pl.lit(None, dtype=pl.String), raised_at=None, urgency=pl.lit("none"), hx_fouling_sd=unknown
    )
    twin = facts.twin.filter(tail=tail).filter(pl.col("flight_id").is_in(flights))
    return replace(facts, frames=frames, twin=twin, segment=facts.segment.clear(), card={}, dsm=None)


@pytest.mark.parametrize("n", [1, 5])
def test_a_few_flights_of_one_aircraft(facts, read, n):
    found = read(page(first_flights(facts, n)))
    sound(found)
    text = "".join(found.words)
    assert "Nothing to do tonight. 2 packs watched" in text
    assert "Not calibrated yet" in text


def repeated(facts: Facts, times: int) -> Facts:
    """The same fleet many times over, under other registrations."""

    def copies(frame: pl.DataFrame) -> pl.DataFrame:
        if "tail" not in frame.columns:
            return frame
        return pl.concat(
            frame.with_columns(tail=pl.format("T{}-{}", pl.lit(i), pl.col("tail").str.slice(-3))) for i in range(times)
        )

    return replace(facts, frames={name: copies(f) for name, f in facts.frames.items()}, twin=copies(facts.twin))


def test_fifty_aircraft_stay_below_five_megabytes(facts):
    whole = page(repeated(facts, 25))
    assert whole.count('<article class="card"') + whole.count("<article id=") >= 100
    assert len(whole.encode()) < 5_000_000


def test_a_hostile_fleet_stays_in_its_place(facts, read, hostile, sample_page):
    def poison(frame: pl.DataFrame) -> pl.DataFrame:
        kept = {"gap", "urgency", "parameter", "severity", "scope", "kind", "action", "component"}
        texts = [c for c, t in frame.schema.items() if t == pl.String and c not in kept]
        return frame.with_columns(pl.concat_str(pl.col(c).fill_null(""), pl.lit(hostile)).alias(c) for c in texts)

    frames = {name: poison(f) for name, f in facts.frames.items()}
    bad = replace(facts, frames=frames, twin=poison(facts.twin), card={hostile: {hostile: hostile}, "list": [hostile]})
    html = page(bad)
    found, plain = read(html), read(sample_page)
    assert found.tags.count("script") == 1
    assert "img" not in found.tags
    assert set(found.tags) <= set(plain.tags) | {"ul"}
    assert not [name for _, name, _ in found.attributes if name.startswith("on")]
    assert "\u202e" not in html
    assert "\x00" not in html
