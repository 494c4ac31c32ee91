"""What the night says of a log of which most lines are refused."""

import pytest
from small_catalog import OWN, START, catalog

from pipelines.intake.faults import REASONS, refused_logs

LOG = "AAA/T-1/messages.csv"
PLACE = {"file": LOG, "operator": OWN["operator"], "tail": OWN["tail"], "received_at": START}


@pytest.mark.parametrize(
    ("reasons", "why"),
    [
        (["bad_pack"] * 3 + ["unreadable_time"] * 4, "4 unreadable time, 3 bad pack"),
        (["bad_pack"] * 7, REASONS["bad_pack"].sentence),
    ],
    ids=["several", "one"],
)
def test_refused_log_names_each_reason(reasons, why):
    counts = {"delivered": 8, "loaded": 1, "quarantined": 7, "duplicate": 0}
    refused = [{"row": n, "reason": reason, "scope": "row", "n_rows": 1} for n, reason in enumerate(reasons)]
    con = catalog(raw_records_deliveries=[PLACE | counts], raw_records_quarantine=[PLACE | row for row in refused])

    assert refused_logs(con) == [f"{LOG}: 7 of 8 lines refused: {why}"]
