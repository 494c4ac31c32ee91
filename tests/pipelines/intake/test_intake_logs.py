"""The classes of bad input in messages, maintenance and the fleet list."""

import pytest

from pipelines.intake.logs import read_fleet, read_maintenance, read_messages

MESSAGE = "message_time,flight_id,pack,code,text\n"
WORK = "done_on,pack,component,action,finding,reference\n"
AIRCRAFT = "operator,tail,msn,delivered_on,packs\n"
LOGS = [
    ("messages", MESSAGE + '2024-05-02T18:51:18Z,LX-AAA_20240502_03,1,21-52-HXTEMP,"HOT, HIGH"\n', None),
    ("messages", MESSAGE, None),
    ("maintenance", WORK.strip(), None),
    ("fleet", AIRCRAFT, "no_rows"),
    ("messages", MESSAGE + "yesterday,?,9,,\n", "unreadable_time"),
    ("messages", MESSAGE + "2061-05-02T18:51:18Z,,1,21-52-HXTEMP,\n", "future_time"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,X,1,21-52-HXTEMP,\n", "bad_flight_id"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,LX-AAB_20240502_03,1,21-52,\n", "flight_id_contradicts_path"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,9,21-52-HXTEMP,\n", "bad_pack"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,1,=cmd(),\n", "bad_code"),
    ("maintenance", WORK + "2024-05-03,3,HX,REPLACED,,\n", "bad_pack"),
    ("maintenance", WORK + "1900-01-01,1,HX,REPLACED,,\n", "too_early"),
    ("messages", MESSAGE + "1900-05-02T18:51:18Z,,1,21-52-HXTEMP,\n", "too_early"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,3,21-52-HXTEMP,\n", "bad_pack"),
    ("maintenance", WORK + "1999-01-01,1,HX,REPLACED,FOULED,WO1\n", None),
    ("maintenance", WORK + "2024-05-03,,RAM_DOOR,INSPECTED,,\n", None),
    ("maintenance", WORK + "2024-05-03T14:20:00Z,1,HX,REPLACED,,\n", None),
    ("maintenance", WORK + "2024-05-03T14:20,1,HX,REPLACED,,\n", "time_without_zone"),
    ("maintenance", WORK + "2061-05-03T14:20:00Z,1,HX,REPLACED,,\n", "future_time"),
    ("maintenance", WORK + "03.05.2024,1,HX,REPLACED,,\n", "unreadable_time"),
    ("maintenance", WORK + "2061-05-03,1,HX,REPLACED,,\n", "future_time"),
    ("maintenance", WORK + "2024-05-03,1,WING,REPLACED,,\n", "bad_code"),
    ("maintenance", WORK + "2024-05-03,1,HX\n", "wrong_field_count"),
    ("maintenance", "when,what\n2024-01-01,changed something\n", "missing_columns"),
    ("maintenance", "", "empty_file"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,2014-06-01,2\n", None),
    ("fleet", AIRCRAFT + "AQX,../etc,40000,2014-06-01,2\n", "bad_key"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,1,2014-06-01,2\nAQX,LX-AAA,1,2015-06-01,2\n", "bad_key"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,soon,2\n", "unreadable_time"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,2014-06-01,many\n", "bad_pack"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "content", "reason"), LOGS, ids=[f"{k} {r} {i}" for i, (k, _, r) in enumerate(LOGS)])
def test_class_of_log(kind, content, reason, deliver, now):
    path = "fleet.csv" if kind == "fleet" else f"AQX/LX-AAA/{kind}.csv"
    read = {"messages": read_messages, "maintenance": read_maintenance, "fleet": read_fleet}[kind]
    log = read(deliver({path: content.encode()})[0], now)
    assert log.quarantine["reason"].to_list() == ([reason] if reason else [])
    assert log.n_delivered == log.rows.height + log.n_duplicate + log.quarantine["n_rows"].sum()


def test_rows_that_stand_twice_in_a_log_count_once(deliver, now):
    row = "2024-05-03,1,HX,REPLACED,FOULED,WO1\n"
    content = WORK + 3 * row
    log = read_maintenance(deliver({"AQX/LX-AAA/maintenance.csv": content.encode()})[0], now)
    assert (log.rows.height, log.n_duplicate, log.n_delivered) == (1, 2, 3)


def test_a_log_of_work_gives_a_day_or_a_time_of_day(deliver, now):
    lines = ["2024-05-03", "2024-05-04T00:30:00+02:00", "2024-05-04T14:20:00Z"]
    content = WORK + "".join(f"{line},1,HX,REPLACED,FOULED,WO{k}\n" for k, line in enumerate(lines))
    rows = read_maintenance(deliver({"AQX/LX-AAA/maintenance.csv": content.encode()})[0], now).rows.sort("reference")
    assert [str(day) for day in rows["done_on"]] == ["2024-05-03", "2024-05-03", "2024-05-04"]
    assert [at and f"{at:%d %H:%M}" for at in rows["done_at"]] == [None, "03 22:30", "04 14:20"]


def test_the_fleet_list_says_which_packs_there_are_and_since_when(deliver, now):
    fleet = b"operator,tail,packs,delivered_on\nAQX,LX-AAA,3,2014-06-01\n"
    content = WORK + "2024-05-03,3,HX,REPLACED,FOULED,WO1\n2013-05-03,1,HX,CLEANED,,WO2\n2024-05-04,4,HX,CLEANED,,WO3\n"
    files = deliver({"fleet.csv": fleet, "AQX/LX-AAA/maintenance.csv": content.encode()})
    log = read_maintenance(next(f for f in files if f.kind == "maintenance"), now)
    assert log.rows["pack"].to_list() == [1, 3]
    reasons = dict(log.quarantine.select("reason", "column_name").iter_rows())
    assert reasons == {"bad_pack": "pack", "before_delivery": "done_on"}
    assert "2013-05-03" in log.quarantine.filter(reason="before_delivery")["detail"].item()
