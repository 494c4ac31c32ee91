"""Work that the flights contradict is left out of the log; all that may have been done stays."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.components.pack import HX
from hdt_core.tracking.undone_work import without_undone

START = datetime(2024, 3, 4, tzinfo=UTC)
PACK = {"operator": "AQX", "tail": "LX-AAA", "pack": 1}
LINE = 60
NOISE = 0.01


def flights(n: int = 100) -> pl.DataFrame:
    """Four flights a day of one pack."""
    departed_at = [START + timedelta(hours=6 * k) for k in range(n)]
    return pl.DataFrame({**PACK, "departed_at": departed_at}).with_columns(pl.col("pack").cast(pl.Int32))


def log(*rows: int, action: str = "REPLACED", pack: int = 1, component: str = "HX") -> pl.DataFrame:
    """Work just before these flights."""
    done_at = [START + timedelta(hours=6 * row - 1) for row in rows]
    frame = pl.DataFrame({**PACK, "component": component, "action": action, "done_at": done_at})
    return frame.with_columns(pl.col("done_at").dt.date().alias("done_on"), pack=pl.lit(pack, pl.Int32))


def is_left_out(
    ln_loss: np.ndarray, entries: pl.DataFrame, tracked: float = 0.25, tracked_sd: float = 0.02
) -> list[bool]:
    """Of each line; with noise of single flights, and one loss tracked throughout."""
    own = flights(ln_loss.size)
    noise = NOISE * np.resize([1.0, -1.0], ln_loss.size)
    health = own.with_columns(parameter=pl.lit("hx_fouling"), value=tracked, sd=tracked_sd)
    kept = without_undone(entries, own, ln_loss + noise, health, HX)
    return [kept.filter(done_at=moment).is_empty() for moment in entries["done_at"]]


WORN = np.full(100, 0.3)
RENEWED = np.where(np.arange(100) < LINE, 0.3, 0.02)


@pytest.mark.parametrize("action", ["REPLACED", "CLEANED"])
def test_work_without_recovery_is_left_out(action):
    assert is_left_out(WORN, log(LINE, action=action)) == [True]


@pytest.mark.parametrize("line", [LINE - 10, LINE - 3, LINE, LINE + 7])
def test_work_near_a_recovery_stays(line):
    assert is_left_out(RENEWED, log(line)) == [False]


@pytest.mark.parametrize(("days", "left_out"), [(5, False), (-5, True)])
def test_late_log_stays(days, left_out):
    """Five days after the recovery it is late; five days before it is none."""
    assert is_left_out(RENEWED, log(LINE + 4 * days)) == [left_out]


@pytest.mark.parametrize(("tracked", "sd", "left_out"), [(0.25, 0.09, False), (0.12, 0.02, False), (0.16, 0.02, True)])
def test_doubtful_loss_leaves_the_log_its_word(tracked, sd, left_out):
    """A new part may be built .04 worse."""
    assert is_left_out(WORN, log(LINE), tracked, sd) == [left_out]


@pytest.mark.parametrize(("n_after", "left_out"), [(14, False), (15, True)])
def test_flights_enough_must_follow(n_after, left_out):
    assert is_left_out(np.full(LINE + n_after, 0.3), log(LINE)) == [left_out]


def test_partial_wash_stays():
    washed = np.where(np.arange(100) < LINE, 0.3, 0.15)
    assert is_left_out(washed, log(LINE, action="CLEANED")) == [False]


def test_recovery_of_earlier_work_is_no_other_works():
    """Replaced at 40, worn again by 60."""
    worn_again = np.where(np.arange(100) < 40, 0.3, np.clip(0.03 * (np.arange(100) - 40), 0.0, 0.3))
    assert is_left_out(worn_again, log(40, LINE)) == [False, True]


def test_flights_without_estimate_show_nothing():
    assert is_left_out(np.where(np.arange(100) < LINE, 0.3, np.nan), log(LINE)) == [False]


@pytest.mark.parametrize("other", [{"pack": 2}, {"component": "CC"}, {"action": "INSPECTED"}])
def test_other_work_stays(other):
    assert is_left_out(WORN, log(LINE, **other)) == [False]


def test_work_without_pack_stays():
    entries = log(LINE).with_columns(pack=pl.lit(None, pl.Int32))
    assert is_left_out(WORN, entries) == [False]
