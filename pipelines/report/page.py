"""The page: what to do first, then the evidence, then how far to trust it."""

from collections.abc import Sequence
from datetime import timedelta
from importlib import resources
from pathlib import Path
from typing import Any

import polars as pl
from markupsafe import Markup

from pipelines.report import charts, intake, tracks
from pipelines.report.answers import answers
from pipelines.report.facts import Facts, read_facts
from pipelines.report.figures import figures
from pipelines.report.headline import headline
from pipelines.report.templating import policy, render
from pipelines.report.thresholds import thresholds
from pipelines.storage.files import replacing
from pipelines.words import _

CLOSED_DAYS = 180  # alerts closed longer ago are history: the catalog has them


def write_report(home: Path, target: Path, units: str = "si", with_thresholds: bool = False) -> None:
    """Write the page over the catalog in `home` to `target`: same catalog, same bytes.

    It opens in a system of units, `si` or `us`, and is in the language spoken (`pipelines.words.speaking`). How alerts
    would have fared at other thresholds takes some three seconds for every aircraft.
    """
    tried = thresholds(home) if with_thresholds else ()
    with replacing(target.resolve()) as temporary:
        temporary.write_text(page(read_facts(home), units, tried), encoding="utf-8")


def page(facts: Facts, units: str = "si", thresholds: Sequence[dict[str, Any]] = ()) -> str:
    """The whole document, opened in a system of units (of `units.SYSTEMS`), with rows of `thresholds` if asked for."""
    drawn, data = figures(facts), _data(facts)
    for k, chart in enumerate(c for f in drawn for c in f["charts"]):
        chart["name"] = f"figure-{k}"
        data["charts"] |= {f"figure-{k}-{system}": chart[system] for system in ("si", "us") if system in chart}
    scripts = [charts.chart_script(), _asset("page.js")] if data["charts"] else [_asset("page.js")]
    until = facts.until()
    return render(
        "report.html",
        title=_("Fleet health") + (f", {until:%Y-%m-%d}" if until else ""),
        units=units,
        policy=policy(*scripts),
        scripts=[Markup(s) for s in scripts],
        data=data,
        tonight=headline(facts),
        ranking=facts["ranking"].to_dicts(),
        alerts=_alerts(facts),
        drawn=data["charts"].keys(),
        recent=lambda row: tracks.recent(facts, row),
        components=facts["components"].to_dicts(),
        hit_rates={r["diagnosis"]: r for r in facts["hit_rates"].to_dicts()},
        thresholds=thresholds,
        gaps=intake.gaps(facts),
        quarantine=facts["quarantine"].to_dicts(),
        deliveries=facts["deliveries"].row(0, named=True),
        filter_yield=intake.filter_yield(facts),
        design=facts["design"].filter(pl.col("scope") != "tail").to_dicts(),
        figures=drawn,
        card=facts.card,
    )


def _data(facts: Facts) -> dict[str, Any]:
    """What the browser draws from."""
    drawn: dict[str, Any] = tracks.pack_tracks(facts) | tracks.unit_tracks(facts)
    return {"charts": drawn, "track": charts.track(), "fleet": tracks.fleet_band(facts)} if drawn else {"charts": {}}


def _alerts(facts: Facts) -> dict[str, Any]:
    """Open alerts in the ranking's order, those closed lately, and how many there are beside."""
    rows, until = facts["alerts"], facts.until()
    closed = rows.filter(pl.col("closed_at").is_not_null())
    late = closed.filter(pl.col("closed_at") >= until - timedelta(days=CLOSED_DAYS)) if until else closed
    return {
        "n": rows.height,
        "open": [a | {"answers": answers(facts, a)} for a in rows.filter(pl.col("closed_at").is_null()).to_dicts()],
        "closed": late.to_dicts(),
        "older": closed.height - late.height,
        "days": CLOSED_DAYS,
    }


def _asset(name: str) -> str:
    return (resources.files("pipelines.report") / name).read_text(encoding="utf-8")
