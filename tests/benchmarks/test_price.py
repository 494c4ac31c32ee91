"""The price of avoided messages, on lives whose answer is known."""

from datetime import UTC, date, datetime, timedelta

import polars as pl
import pytest

from benchmarks.price import as_of, choose_limit, price

START = datetime(2024, 1, 1, tzinfo=UTC)


def life(number: int, flights: int, *, failed: bool, left_after: int = 0) -> pl.DataFrame:
    """One flight a day; the loss is the flight's number over a hundred."""
    flight = pl.int_range(flights, eager=True)
    left = (flights - flight + left_after).cast(pl.Float64)
    days = [START + timedelta(days=k) for k in range(flights)]
    return pl.DataFrame(
        {"life": number, "departed_at": days, "remaining": left, "failed": failed, "loss": flight / 100}
    )


FAILED = [life(number, 10 * number, failed=True) for number in range(1, 11)]


def test_limit_avoids_eight_of_ten():
    limit = choose_limit(pl.concat(FAILED), "loss")

    # of the lives of 30 to 100 flights, the shortest has a loss of .2 ten flights before its message
    assert limit == pytest.approx(0.2)


def test_price_counts_avoided_messages():
    rows = pl.concat(FAILED).with_columns(passed=pl.col("loss") >= 0.2)

    cost = price(rows)

    assert cost.avoided == pytest.approx(0.8)
    assert cost.given_up_flights == pytest.approx(45.0)


@pytest.mark.parametrize(("left_after", "unneeded"), [(280, 1.0), (279, 0.0)])
def test_renewal_is_unneeded_from_300_flights(left_after, unneeded):
    spared = life(11, 40, failed=False, left_after=left_after)
    rows = pl.concat([FAILED[9], spared]).with_columns(passed=pl.col("loss") >= 0.2)

    assert price(rows).unneeded == unneeded


@pytest.mark.parametrize(("day", "failed"), [(date(2024, 1, 31), True), (date(2024, 1, 30), False)])
def test_message_counts_from_its_day(day, failed):
    record = as_of(FAILED[2], day)

    assert record["failed"].all() == failed
    assert record["remaining"].to_list()[0] == record.height
