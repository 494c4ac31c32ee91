"""A file that is delivered again with fewer rows of a flight: what stays of its earlier version."""

import polars as pl
import pytest
from spoils import column

from pipelines.intake.faults import NO_FAULTS
from pipelines.intake.merge import compare_redelivery

CSV, COPY = (f"AQX/LX-AAA/acms/{name}.csv" for name in ("LX-AAA_20240525_04", "copy"))


@pytest.fixture
def stored(good_flight, deliver, read) -> pl.DataFrame:
    """Rows of the good flight in a file and its copy."""
    rows = read(deliver({CSV: good_flight})).rows
    return pl.concat([rows, rows.with_columns(file=pl.lit(COPY))])


def of_file(rows: pl.DataFrame, *files: str, n: int = 42) -> pl.DataFrame:
    """The first rows of some files, with another calibration of a sensor."""
    first = rows.filter(pl.int_range(pl.len()).over("file") < n, pl.col("file").is_in(files))
    return first.with_columns(pl.col("hx_out_k") + 2.0)


def test_file_without_a_good_row_changes_nothing(good_flight, deliver, read, stored):
    """Its earlier rows are taken from the store as they are."""
    refused = column("pack", lambda pack: 9)(good_flight[: good_flight.index(b"\n", 3_000) + 1])
    intake = read(deliver({CSV: refused}))

    rows, notes = compare_redelivery(intake.rows, intake.quarantine, stored.filter(file=CSV), NO_FAULTS, {})

    assert (rows.height, notes["reason"].to_list()) == (0, ["fewer_rows"])


def test_whole_file_ends_what_was_set_aside(stored):
    """While its copy is still the shorter one."""
    short = of_file(stored, CSV, COPY, n=20)
    _, aside = compare_redelivery(short, NO_FAULTS, stored, NO_FAULTS, {})

    again = pl.concat([of_file(stored, CSV), short.filter(file=COPY)])
    _, notes = compare_redelivery(again, NO_FAULTS, short, aside, {})

    assert set(notes.filter(reason="replaced_row")["file"]) == {COPY}


@pytest.mark.parametrize(("n", "n_lacking"), [(41, 1), (42, 0)])
def test_shorter_file_lacks_rows(stored, n, n_lacking):
    own = stored.filter(file=CSV)

    rows, _ = compare_redelivery(own.head(n), NO_FAULTS, own, NO_FAULTS, {})

    assert rows.height == n_lacking
