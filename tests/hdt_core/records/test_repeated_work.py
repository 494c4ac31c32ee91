"""Work that the maintenance log lists twice is one job."""

import numpy as np
import polars as pl
import pytest
from worn_positions import CLEAN, RENEWED, WORN, departure, fly, judge, log, messages_after

from hdt_core.records.recoveries import as_known


@pytest.mark.parametrize(("messages", "verdict"), [((), "repeated"), ((RENEWED + 2,), "logged")])
def test_second_entry_needs_a_message(messages, verdict):
    """Work that is listed twice is one job, unless a message came between."""
    verdicts = judge(fly(WORN), log((1, RENEWED), (1, RENEWED + 3)), messages_after(*messages))

    assert verdicts["verdict"].to_list() == ["logged", verdict]


def test_wash_repeats_no_replacement():
    entries = pl.concat([log((1, RENEWED)), log((1, RENEWED + 3), action="CLEANED")])

    assert judge(fly(WORN), entries)["verdict"].to_list() == ["logged", "logged"]


def test_second_entry_on_clean_part_is_repeated():
    assert judge(fly(CLEAN), log((1, RENEWED), (1, RENEWED + 3)))["verdict"].to_list() == ["logged", "repeated"]


@pytest.mark.parametrize(("later", "verdict"), [(90, "repeated"), (91, "logged")])
def test_work_is_logged_again_within_a_month(later, verdict):
    clean = np.full(200, 0.02)

    assert judge(fly(clean), log((1, RENEWED), (1, RENEWED + later)))["verdict"].to_list() == ["logged", verdict]


def test_undone_work_is_not_repeated():
    """The loss falls too slowly for a recovery."""
    slow = np.linspace(0.3, 0.01, 80)
    loss = np.concatenate([np.full(30, 0.3), slow, np.full(20, 0.01)])

    assert judge(fly(loss), log((1, 25), (1, 112)))["verdict"].to_list() == ["not_seen", "logged"]


def test_moved_work_is_repeated_where_it_was_done():
    """Not at the position of the log, where the second entry stands alone."""
    work = judge(fly(WORN, CLEAN), log((2, RENEWED), (2, RENEWED + 5)))

    assert work["verdict"].to_list() == ["elsewhere", "logged"]


def test_message_of_other_aircraft_is_none():
    messages = messages_after(RENEWED + 2).with_columns(tail=pl.lit("T-2"))

    work = judge(fly(WORN), log((1, RENEWED), (1, RENEWED + 3)), messages)

    assert work["verdict"].to_list() == ["logged", "repeated"]


def test_repeated_work_never_counted():
    entries = as_known(judge(fly(WORN), log((1, RENEWED), (1, RENEWED + 3))))

    assert entries["counts_from"].to_list() == [departure(RENEWED)]
