"""What a recorder delivers otherwise than one reading a row is noted once, with the first file of it."""

import pytest

from tests.support.small_catalog import OWN, catalog

AIRCRAFT = {"operator": OWN["operator"], "tail": OWN["tail"]}
FIRST = "T-1_20240301_01"
SECOND = "T-1_20240302_01"


@pytest.mark.parametrize("reason", ["not_fitted", "lower_rate", "one_channel"])
def test_channel_note_has_first_file(reason):
    channel = OWN | {"source": "acms", "signal": "hx_out_k", "reason": reason, "n_readings": 20}
    delivery = AIRCRAFT | {"delivered": 20, "loaded": 20, "quarantined": 0, "duplicate": 0}
    con = catalog(
        legs_channels=[channel | {"flight_id": f} for f in (SECOND, FIRST)],
        raw_deliveries=[delivery | {"flight_id": f, "file": f"{f}.csv"} for f in (SECOND, FIRST)],
    )

    notes = con.execute("select file, scope, column_name from quarantine where reason = ?", [reason]).fetchall()

    assert notes == [(f"{FIRST}.csv", "note", "hx_out_k")]
