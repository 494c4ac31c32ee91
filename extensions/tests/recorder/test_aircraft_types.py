"""Type descriptions: those that come with the project, and what is said of one with an error."""

import zipfile

import pytest

from hdt_recorder import recorder_rows
from hdt_recorder.aircraft_types import PACK, AircraftTypeError, read_type
from hdt_recorder.coverage import coverage_of
from hdt_recorder.types_of_zone import packaged_files, types_of
from pipelines.intake.landing import list_landing

DEEP = f"x = {'[' * 20_000}{']' * 20_000}"
TYPE = "type = 'T'\nmap = 'm.toml'\n[pack]\nmach = { parameter = 'MACH', %s }\n"
B787 = next(f for f in packaged_files() if f.stem == "b787_767")
ERRORS = {
    ("hx_in_degc =", "hx_inn_degc ="): "x.toml line 17: [pack] hx_inn_degc: no such column; hx_in_degc is near",
    ("units = 4", "units = 3"): "x.toml line 34: [CAC] speed_rpm: 4 parameters for 3 units",
    ('unit = "mbar"', 'unit = "bar"'): "x.toml line 16: [pack] pt_psia: unit 'bar'; there are psia, mbar",
    ('unit = "mbar"', "lowest = true"): "x.toml line 16: [pack] pt_psia: lowest is a number, not True",
    ("[component.CAC]", "[component.CAX]"): "no component CAX has a record of its own; there are HXT, CAC",
    ('map = "b787.vec"', 'map = "../b787.vec"'): "x.toml line 4: map: ../b787.vec leads out of the folder",
    ('mach = "MACH"', "mach = 3"): "x.toml line 14: [pack] mach: a parameter's name, or a list of them, one a unit",
    ("packs = 2", 'packs = "two"'): "x.toml line 5: packs: a number from 1 to 4, not 'two'",
    ('type = "B787-767"', ""): "x.toml: type: missing; it is a text",
    ('minute = "UTC_MIN"', ""): "x.toml line 7: clock: hour, minute, second come together",
    ("vda_pos", "mach"): "[absent] pack.mach: no such column, or one that is described above",
    ('title = "', "title = "): "x.toml: no TOML:",
}


@pytest.mark.parametrize("change", ERRORS)
def test_type_error_names_its_place(tmp_path, change):
    file = tmp_path / "x.toml"
    assert change[0] in B787.read_text()
    file.write_text(B787.read_text().replace(*change, 1))
    with pytest.raises(AircraftTypeError) as error:
        read_type(file)
    assert ERRORS[change] in str(error.value)


@pytest.mark.parametrize(
    ("file", "name", "covered"),
    [
        ("b787_767", "hx_fouling", ("recorded", "", "")),
        ("b787_767", "cac_efficiency_loss", ("recorded", "", "")),
        ("b787_767", "hx_h_hot_w_k", ("not_recorded", "ram_out_degc", "no sensor")),
        ("a330_717", "hxt_loss", ("recorded", "", "")),
        ("a330_717", "hx_fouling", ("not_recorded", "ram_door_pct, pack_flow_lbpm", "not recorded")),
    ],
)
def test_type_coverage_names_missing_columns(file, name, covered):
    (path,) = (f for f in packaged_files() if f.stem == file)
    assert {row[1]: row[2:] for row in coverage_of(read_type(path))}[name] == covered


def test_recorder_unit_becomes_unit_of_column():
    (pressure,) = (s for s in read_type(B787).stations[PACK] if s.column == "pt_psia")
    assert pressure.scale * 1013.25 == pytest.approx(14.696, abs=1e-3)


@pytest.fixture
def zone(tmp_path):
    """Two aircraft: one of a type whose map is lacking, one of an unknown type; and a bad description."""
    folder = tmp_path / "types"
    folder.mkdir()
    (folder / "good.toml").write_text('type = "MINE"\nmap = "m.toml"\n[pack]\nmach = "M"\n')
    (folder / "bad.toml").write_text('type = "BAD"\nmap = "m.toml"\n[pack]\nmach = 1\n')
    (tmp_path / "fleet.csv").write_text("operator,tail,packs,type\nAAA,T1,2,MINE\nAAA,T2,2,OTHER\n")
    return tmp_path


def test_bad_type_costs_no_other(zone):
    types = types_of(zone)
    assert types.by_name["MINE"].stations[PACK][0].parameters == ("M", "M")
    assert types.fault_of("AAA", "T1") == "good.toml names the map m.toml: not there"
    fault = "fleet.csv gives the aircraft the type OTHER, known are A330-717, B787-767, MINE"
    assert fault in types.fault_of("AAA", "T2")


def test_recording_of_unknown_type_is_refused(zone):
    recording = zone / "AAA/T2/recorder/T2_20240101_01.dat"
    recording.parent.mkdir(parents=True)
    recording.write_bytes(b"?")
    reasons = dict(list_landing(zone).quarantine.select("file", "reason").rows())
    assert reasons == {"types/bad.toml": "bad_type", "AAA/T2/recorder/T2_20240101_01.dat": "unknown_type"}


def test_outside_links_are_not_followed(tmp_path):
    outside = tmp_path / "outside"
    zone = tmp_path / "zone"
    outside.mkdir()
    (zone / "types").mkdir(parents=True)
    (outside / "t.toml").write_text('type = "OUT"\nmap = "m.toml"\n[pack]\nmach = "M"\n')
    (zone / "types/linked.toml").symlink_to(outside / "t.toml")
    (zone / "types/own.toml").write_text('type = "OWN"\nmap = "m.toml"\n[pack]\nmach = "M"\n')
    (outside / "m.toml").write_text("x")
    (zone / "types/m.toml").symlink_to(outside / "m.toml")
    types = types_of(zone)
    assert "OUT" not in types.by_name
    assert types.faults["own.toml"] == "own.toml line 2: map: m.toml leads out of the folder"


def test_bloated_archive_is_not_unpacked(tmp_path, monkeypatch):
    (tmp_path / "types").mkdir()
    (tmp_path / "types/t.toml").write_text('type = "T"\nmap = "maps/m.toml"\n[pack]\nmach = "M"\n')
    (tmp_path / "types/maps").mkdir()
    (tmp_path / "types/maps/m.toml").write_text("")
    (tmp_path / "fleet.csv").write_text("operator,tail,packs,type\nAAA,T-1,2,T\n")
    path = tmp_path / "AAA/T-1/recorder/T-1_20240101_01.zip"
    path.parent.mkdir(parents=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("flight.dat", bytes(3 << 20))
    monkeypatch.setattr(recorder_rows, "MOST_BYTES", 1 << 20)
    (file,) = (f for f in list_landing(tmp_path).files if f.is_recording)
    _, n_rows, (fault,) = recorder_rows.recorder_rows(file, PACK)
    assert (n_rows, fault.reason) == (0, "too_large")


SPANS = (
    "lowest = nan", "highest = inf", "highest = 1" + "0" * 400, "lowest = true", "lowest = 'x'", "rate_hz = 0",
    "rate_hz = -1", "lowest = 1, highest = 0",
)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((text, r"\.toml") for text in (DEEP, "x = \ud800", "=", f"x = {'9' * 5_000}")),
        *((TYPE % entry, r"type\.toml line 4: \[pack\] mach") for entry in SPANS),
    ],
)
def test_broken_type_takes_one_line(tmp_path, text, message):
    (tmp_path / "type.toml").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(AircraftTypeError, match=message):
        read_type(tmp_path / "type.toml")
