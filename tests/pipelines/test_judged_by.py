"""A file is judged by its aircraft's line, type, map and layouts: read again when one changes, and only then."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from spoils import column, field

from hdt_core.tables import TABLES
from pipelines.intake.ingest import ingest_flights
from pipelines.intake.landing import list_landing
from pipelines.intake.logs import read_fleet, read_messages
from pipelines.intake.scan import scan
from pipelines.lineage import STAGE
from pipelines.resources import FrameIO, PartitionScope
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store
from pipelines.versions import find_stale_cells

GOOD = Path(__file__).parents[1] / "data/dirty/landing/AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
CSV, OTHER = (f"AQX/{tail}/acms/{tail}_20240525_04.csv" for tail in ("LX-AAA", "LX-AAB"))
HEAD = "operator,tail,msn,delivered_on,packs\n"
RIGHT = HEAD + "AQX,LX-AAA,1,2014-06-01,2\nAQX,LX-AAB,2,2014-06-01,2\n"
ONE_PACK = RIGHT.replace("2014-06-01,2\nAQX", "2014-06-01,1\nAQX")
NOW = datetime(2026, 1, 1, tzinfo=UTC)
N = 42  # rows of the flight, half of each pack


class Zone:
    """A landing zone of two aircraft, and what the raw stage made of it."""

    def __init__(self, root: Path) -> None:
        self.landing = root / "landing"
        self.store = Store(root / "home")
        self.ledger = Ledger(root / "home")
        for path, content in {CSV: GOOD.read_bytes(), OTHER: GOOD.read_bytes().replace(b"LX-AAA", b"LX-AAB")}.items():
            (self.landing / path).parent.mkdir(parents=True)
            (self.landing / path).write_bytes(content)

    def night(self, fleet: str | None) -> list[str]:
        """Tails whose flight was read in a night with this fleet list; None: there is no list."""
        file = self.landing / "fleet.csv"
        file.unlink(missing_ok=True) if fleet is None else file.write_text(fleet)
        scan(self.landing, self.ledger)
        cells = find_stale_cells(self.ledger, STAGE["raw"]).rows()
        for operator, tail, flight, _ in cells:
            aircraft = (operator, tail)
            intake = ingest_flights(self.landing, self.store, self.ledger, aircraft, [flight])
            frames = {t: TABLES[t].schema.create_empty() for t in STAGE["raw"].tables}
            frames |= {"raw_snapshots": intake.rows, "raw_deliveries": intake.deliveries}
            frames["raw_quarantine"] = intake.quarantine
            io = FrameIO(self.store, self.ledger)
            scope = PartitionScope({aircraft: [flight]})
            for table in STAGE["raw"].tables:
                io.store_frame(table, scope, frames[table])
        return [tail for _, tail, *_ in cells]

    def rows(self) -> dict[tuple[str, int], int]:
        """Stored rows by tail and pack."""
        counted = self.store.read_table("raw_snapshots").group_by("tail", "pack").len().rows()
        return {(tail, pack): n for tail, pack, n in counted}

    def reasons(self) -> set[str]:
        return set(self.store.read_table("raw_quarantine")["reason"])


ALL = {(tail, pack): N // 2 for tail in ("LX-AAA", "LX-AAB") for pack in (1, 2)}


@pytest.fixture
def zone(tmp_path) -> Zone:
    return Zone(tmp_path)


def test_pack_returns_with_right_line(zone):
    assert sorted(zone.night(ONE_PACK)) == ["LX-AAA", "LX-AAB"]
    assert ("LX-AAA", 2) not in zone.rows()
    assert zone.night(RIGHT) == ["LX-AAA"]
    assert zone.rows() == ALL
    assert zone.reasons() == set()
    assert zone.night(RIGHT) == []


def test_wrong_line_removes_no_row(zone):
    zone.night(RIGHT)
    assert zone.night(ONE_PACK) == ["LX-AAA"]
    assert zone.rows() == ALL
    assert zone.reasons() == {"fewer_packs"}
    (zone.landing / CSV).write_bytes(column("mach", lambda v: v + 0.001)(GOOD.read_bytes()))
    assert zone.night(ONE_PACK) == ["LX-AAA"]
    assert zone.rows() == ALL
    assert zone.night(RIGHT) == ["LX-AAA"]
    assert (zone.rows(), zone.reasons()) == (ALL, set())


def test_wrong_line_spares_vanished_file(zone):
    zone.night(RIGHT)
    zone.night(ONE_PACK)
    (zone.landing / CSV).unlink()
    assert zone.night(ONE_PACK.replace("AQX,LX-AAA,1,2014-06-01,1", "AQX,LX-AAA,1,2014-06-01,3")) == []
    zone.night(RIGHT)
    assert zone.rows() == ALL


def test_corrected_line_drops_extra_pack(zone):
    (zone.landing / CSV).write_bytes(field(1, "pack", b"3")(GOOD.read_bytes()))
    zone.night(RIGHT)
    clean = zone.rows()
    zone.night(RIGHT.replace("2014-06-01,2\nAQX", "2014-06-01,4\nAQX"))
    assert zone.rows()["LX-AAA", 3] == 1
    zone.night(RIGHT)
    assert zone.rows() == clean
    assert zone.reasons() == {"bad_pack"}


UNCHANGED = {
    "no list": None,
    "an empty file": "",
    "a header alone": HEAD,
    "no list but noise": "\x00\x01\x02",
    "semicolons": RIGHT.replace(",", ";"),
    "a line gone": HEAD + "AQX,LX-AAB,2,2014-06-01,2\n",
    "a line garbled": RIGHT.replace("AQX,LX-AAA,1,2014-06-01,2", "AQX,LX-AAA,1,soon,many"),
    "another msn": RIGHT.replace("AQX,LX-AAA,1,", "AQX,LX-AAA,77,"),
    "another day of delivery": RIGHT.replace("2014-06-01", "2015-07-02"),
    "another operator's aircraft": RIGHT + "BZR,A9-BAB,3,2014-06-01,1\n",
    "a second line of an aircraft": RIGHT + "AQX,LX-AAA,1,2014-06-01,1\n",
    "a type that nothing describes": RIGHT.replace("packs\n", "packs,type\n").replace(",2\n", ",2,NONE\n"),
}


@pytest.mark.parametrize("packs", [2, 3])
@pytest.mark.parametrize("wrong", UNCHANGED.values(), ids=UNCHANGED.keys())
def test_unrelated_line_rereads_nothing(zone, wrong, packs):
    """Of a usual aircraft, and of one whose line gives other packs than is usual."""
    right = RIGHT.replace("2014-06-01,2\n", f"2014-06-01,{packs}\n")
    zone.night(right)
    assert zone.night(wrong and wrong.replace("-01,2", f"-01,{packs}").replace("-02,2", f"-02,{packs}")) == []
    assert zone.night(right) == []
    assert (zone.rows(), zone.reasons()) == (ALL, set())


def test_listed_aircraft_loses_its_note(zone):
    zone.night(UNCHANGED["a line gone"])
    assert zone.reasons() == {"unknown_tail"}
    assert zone.night(RIGHT) == ["LX-AAA"]
    assert (zone.rows(), zone.reasons()) == (ALL, set())


def test_first_of_two_lines_counts(zone):
    (zone.landing / "fleet.csv").write_text(HEAD + "AQX,LX-AAA,9,2014-06-01,2\nAQX,LX-AAA,9,2014-06-01,1\n")
    (file,) = (f for f in list_landing(zone.landing).files if f.kind == "fleet")
    log = read_fleet(file, NOW)
    assert log.rows.select("msn", "packs").rows() == [("9", 2)]
    assert log.quarantine.select("row", "reason").rows() == [(3, "bad_key")]
    assert "line 2 counts" in log.quarantine["detail"].item()


TYPE = 'type = "{name}"\nmap = "map.toml"\nreports = "{name}.layouts"\n[pack]\nmach = "M"\n'


def digests(zone: Zone) -> dict[str, str]:
    scan(zone.landing, zone.ledger)
    return {path: record.digest for path, record in zone.ledger.file_records().items() if path.startswith("AQX/LX-AAA")}


CHANGES = {
    "type": (lambda z: z.landing.joinpath("fleet.csv").write_text(TYPED.replace("ONE", "TWO")),
             {"recorder", "reports"}),
    "description": (lambda z: append(z.landing / "types/ONE.toml", "# a word\n"), {"recorder", "reports"}),
    "map": (lambda z: append(z.landing / "types/map.toml", "more"), {"recorder"}),
    "layouts": (lambda z: append(z.landing / "types/ONE.layouts", "more"), {"reports"}),
    "packs": (lambda z: z.landing.joinpath("fleet.csv").write_text(TYPED.replace(",2,ONE", ",1,ONE")),
              {"acms", "recorder", "messages.csv", "maintenance.csv"}),
    "delivered_on": (lambda z: z.landing.joinpath("fleet.csv").write_text(TYPED.replace("2014", "2015")),
                     {"maintenance.csv"}),
    "msn": (lambda z: z.landing.joinpath("fleet.csv").write_text(TYPED.replace("LX-AAA,1", "LX-AAA,5")), set()),
}  # fmt: skip
TYPED = HEAD.replace("packs", "packs,type") + "AQX,LX-AAA,1,2014-06-01,2,ONE\n"


def append(path: Path, text: str) -> None:
    path.write_text(path.read_text() + text)


@pytest.mark.parametrize(("change", "folders"), CHANGES.values(), ids=CHANGES.keys())
def test_digest_covers_what_judges_file(zone, change, folders):
    (zone.landing / "types").mkdir()
    for name in ("ONE", "TWO"):
        (zone.landing / f"types/{name}.toml").write_text(TYPE.format(name=name))
        (zone.landing / f"types/{name}.layouts").write_text(name)
    (zone.landing / "types/map.toml").write_text("one")
    (zone.landing / "fleet.csv").write_text(TYPED)
    for name in ("recorder/LX-AAA_20240525_05.dat", "reports/a.dat", "messages.csv", "maintenance.csv"):
        (zone.landing / "AQX/LX-AAA" / name).parent.mkdir(exist_ok=True)
        (zone.landing / "AQX/LX-AAA" / name).write_text("x")
    before = digests(zone)
    assert digests(zone) == before
    change(zone)
    after = digests(zone)
    assert {path.split("/")[2] for path in before if before[path] != after[path]} == folders


def test_log_keeps_its_stored_packs(zone):
    """A message of pack 2 is none of an aircraft with one pack, unless it is stored."""
    content = "message_time,flight_id,pack,code,text\n2024-05-02T18:51:18Z,,2,21-52-HXTEMP,\n"
    (zone.landing / "AQX/LX-AAA/messages.csv").write_text(content)
    (zone.landing / "fleet.csv").write_text(ONE_PACK)
    (file,) = (f for f in list_landing(zone.landing).files if f.kind == "messages")
    assert read_messages(file, NOW).rows.height == 0
    assert read_messages(replace(file, packs_stored=2), NOW).rows.height == 1
