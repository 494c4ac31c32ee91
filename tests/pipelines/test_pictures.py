"""What a night shows of itself in Dagster: the packs most in need, and the deepest loss before a replacement."""

import base64
import datetime as dt
import re

import polars as pl
import pytest

from hdt_core.tables import TABLES
from pipelines.report.pictures import night_figures, night_pictures
from pipelines.report.plots import around_replacement

START = dt.datetime(2024, 3, 1, 6, tzinfo=dt.UTC)
REPLACED = 40
OWN = {"operator": "AAA", "pack": 1}


def frame(table: str, rows: list[dict]) -> pl.DataFrame:
    return TABLES[table].schema.conform(pl.DataFrame(rows, infer_schema_length=None))


def flights(tail: str, loss_per_flight: float) -> list[dict]:
    """A flight a day; a new exchanger on day `REPLACED`."""
    losses = [loss_per_flight * (n if n <= REPLACED else n - REPLACED) for n in range(80)]
    fixed = {"hx_fouling_sd": 0.01, "hx_out_sensor_minus_twin_k": 0.0}
    return [
        OWN | fixed | {"tail": tail, "flight_id": f"{tail}_{n}", "departed_at": START + dt.timedelta(days=n),
                      "hx_fouling": loss, "hx_fouling_flight": loss, "hx_out_sensor_minus_dsm_k": 20 * loss}
        for n, loss in enumerate(losses)
    ]  # fmt: skip


@pytest.fixture
def night() -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    tails = {f"T-{k}": 0.001 * k for k in range(1, 9)}
    prognoses = [
        OWN | {"tail": t, "component": "HX", "departed_at": START, "p_event_50": 50 * v} for t, v in tails.items()
    ]
    day = (START + dt.timedelta(days=REPLACED)).date()
    work = [OWN | {"tail": t, "component": "HX", "action": "REPLACED", "done_on": day} for t in tails]
    return (
        frame("features", [f for t, v in tails.items() for f in flights(t, v)]),
        frame("prognoses", prognoses),
        frame("raw_maintenance", work),
    )


def names(figure) -> list[str]:
    return [a.get_title() for a in figure.axes if a.get_visible()]


def test_the_six_packs_most_in_need_are_drawn_worst_first(night):
    figures = night_figures(*night)
    worst = [f"T-{k} pack 1" for k in (8, 7, 6, 5, 4, 3)]
    assert names(figures["health_over_flights"]) == names(figures["outlet_residuals"]) == worst
    assert names(figures["figure_16"]) == ["Figure 16: T-8 pack 1, exchanger replaced 2024-04-10"]


def test_a_picture_keeps_its_size_whatever_the_fleet_flew(night):
    features, prognoses, maintenance = night
    later = pl.concat([features.with_columns(pl.col("departed_at") + pl.duration(days=80 * k)) for k in range(30)])
    for picture in night_pictures(later, prognoses, maintenance).values():
        match = re.fullmatch(r"!\[figure\]\(data:image/png;base64,(.*)\)", picture.md_str)
        assert base64.b64decode(match[1]).startswith(b"\x89PNG")
        assert len(picture.md_str) < 60_000


def test_flights_are_counted_from_the_first_after_the_replacement(night):
    features, _, maintenance = night
    shares = features.with_columns(ua_share=1.0 - pl.col("hx_fouling_flight"))
    work, rows = around_replacement(shares, maintenance)
    assert work["tail"] == "T-8"
    first = rows.filter(n=0)
    assert first["departed_at"].item() == START + dt.timedelta(days=REPLACED + 1)
    assert rows["n"].to_list() == list(range(-REPLACED - 1, 80 - REPLACED - 1))


def test_a_night_without_flights_shows_nothing(night):
    assert night_pictures(*(f.clear() for f in night)) == {}
