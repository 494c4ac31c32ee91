"""The same frame in every format of a parameter map gives the same values; a map that can't be read says where."""

import io
import zipfile

import numpy as np
import pytest
from recordings import DATA, DEMO_717, DEMO_767, frames_717, frames_767, pack, random_raw, raw_767, read, vec

from hdt_recorder.decoding.coding import LookupTable, Polynomial, Segments
from hdt_recorder.decoding.layout import MapError
from hdt_recorder.decoding.plain_map import read_csv, read_toml
from hdt_recorder.decoding.vec_map import read_vec
from hdt_recorder.decoding.xml_map import read_xml

TOML, CSV, XML = ((DATA / f"demo_717.{form}").read_text() for form in ("toml", "csv", "xml"))


def row(name: str, kind: str, msb: int, bits: int, **more: str) -> str:
    """Line 1 of a `.par`, and the lines below it."""
    fields = {"sign": "", "offset": "", "computation": "", "format": "6.0", "unit": "", "below": "", **more}
    head = [name, f"what {name} is", kind, "A/1/00", "//", "0", fields["sign"], str(msb), str(bits), "2", "N"]
    head += [fields["offset"], fields["computation"], *["0", "1", "-90000", "90000", "DECIMAL"], "", ""]
    head += [fields["format"], fields["unit"], "ABC", "2009-01-01", "1", "Float", ""]
    return "\n".join(["1|" + "\t".join(head), *fields["below"].split(";"), "12|-1", "13|" + name])


PAR = "\n".join([
    "// 1|Parameter Name",
    row("ALTITUDE", "BNR LINEAR (A*X)", 28, 17, sign="29", computation="Resol=1", unit="ft"),
    row("PITCH", "BNR LINEAR (A*X)", 28, 9, sign="29", computation="Resol=.17578125"),
    row("FLOW", "BNR SEGMENTS", 28, 12, below="2|1\t0\t.001\t0;2|2\t1000\t.002\t-1"),
    row("MODE", "PACKED BITS", 3, 3, below="6|0\tOFF;6|1\tLOW;6|2\tNORMAL;6|5\tHIGH"),
    row("FREQUENCY", "BCD", 29, 15, offset="100", format="6.2", below="5|1\t29\t3;5|2\t26\t4;5|3\t22\t4;5|4\t18\t4"),
    row("UTC", "UTC", 28, 17),
    row("CITY", "CHARACTER", 32, 32, below="5|1\t32\t8;5|2\t24\t8;5|3\t16\t8;5|4\t8\t8"),
    row("ODD", "SOMETHING NEW", 12, 12),
    row("SMALL", "BNR LINEAR (A*X)", 28, 12, sign="29", computation="Resol=.5"),
    row("ON_GROUND", "COMPUTED ON GROUND", 32, 32),
])  # fmt: skip
FRA = "\n".join([
    "// 1|Frame Type",
    "1|S\t64\t12\t247\t5B8\tA47\tDB8\t1\t2\t12\t12\t0\t\t\t\t\t\t",
    "3|1\t3\t13\t8\t8",
    "2|ALTITUDE\t1\t4\t1\t4\t6\t6\t29\tImposed\t\t\t\t",
    "2|ALTITUDE\t2\t4\t1\t3\t12\t12\t23\tImposed\t\t\t\t",
    "2|PITCH\t1\t16\t1\t6\t12\t10\t29\tImposed\t\t\t\t",
    "2|FLOW\t1\t2\t2\t7\t12\t12\t28\tImposed\t\t\t\t",
    "2|MODE\t1\t4\t1\t8\t4\t3\t3\tImposed\t\t\t\t",
    "2|FREQUENCY\t1\t1\t2\t10\t3\t3\t29\tImposed\t\t\t\t",
    "2|FREQUENCY\t2\t1\t2\t9\t12\t12\t26\tImposed\t\t\t\t",
    "2|UTC\t1\t1\t4\t12\t5\t5\t28\tImposed\t\t\t\t",
    "2|UTC\t2\t1\t4\t11\t12\t12\t23\tImposed\t\t\t\t",
    *(f"4|CITY\t{p}\t16\t1\t{f}\t8\t8\t{b}\t\t\t" for p, f, b in ((1, 1, 32), (2, 2, 24), (3, 3, 16), (1, 4, 8))),
    "2|ODD\t1\t4\t1\t30\t12\t12\t12\tImposed\t\t\t\t",
    "2|SMALL\t1\t4\t1\t31\t12\t1\t29\tImposed\t\t\t\t",
    "2|SMALL\t2\t4\t1\t31\t11\t8\t24\tImposed\t\t\t\t",
])  # fmt: skip


def archive(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        return {name: file.read(name) for name in file.namelist()}


VEC = read_vec(archive(vec(par=PAR, fra=FRA)))
RAW = random_raw(DEMO_717, np.random.default_rng(11), 64)
RECORDING = pack(frames_717(DEMO_717, RAW, first_count=0))


def texts(series) -> list:
    return [series.text.names[c] for c in series.text.codes]


@pytest.mark.parametrize(
    ("layout", "names", "more"),
    [
        (VEC, "ALTITUDE PITCH FLOW MODE UTC", "ODD SMALL SMALL.whole CITY CITY.whole FREQUENCY FREQUENCY.whole"),
        (read_xml(XML.encode()), "ALTITUDE PACK_TEMP MODE WEIGHT", "TWICE RUDDER Frame_Counter"),
        (read_csv(CSV), " ".join(set(DEMO_717.parameters) - {"FLOW"}), ""),
    ],
    ids=["vec", "xml", "csv"],
)
def test_map_formats_read_same_values(layout, names, more):
    ours = read(RECORDING)
    theirs = read(RECORDING, layout)
    assert {n.replace(" ", "_") for n in layout.parameters} == {*names.split(), *more.split()}
    for name in names.split():
        assert theirs[name].valid.all(), name
        if ours[name].value is not None:
            np.testing.assert_allclose(theirs[name].value, ours[name].value, err_msg=name)
        if ours[name].text is not None:
            assert texts(theirs[name]) == texts(ours[name])
        assert theirs[name].parameter.rate_hz == ours[name].parameter.rate_hz


def test_vec_numbers_are_listed_or_whole():
    series = read(RECORDING, VEC)
    ours = read(RECORDING)["FREQUENCY"]
    np.testing.assert_allclose(series["FREQUENCY"].value, 100 * (ours.value - 100))
    np.testing.assert_allclose(series["FREQUENCY.whole"].value, ours.value)
    assert texts(series["FREQUENCY"]) == texts(ours)


def test_vec_texts_are_listed_or_whole():
    series = read(RECORDING, VEC)
    ours = texts(read(RECORDING)["CITY"])
    assert texts(series["CITY.whole"]) == ours
    # the export numbers parts 1 to 3, so that the fourth letter is listed as a sample of its own
    assert texts(series["CITY"]) == [x for c in ours for x in (c[:3] + "\0", "\0\0\0" + c[3])]


def test_vec_number_extends_its_sign():
    """Recorded are the sign and bits 24 to 17 of 28 to 17: the four between are the sign again."""
    series = read(RECORDING, VEC)
    raw = frames_717(DEMO_717, RAW, first_count=0).reshape(-1, 64)[:, 30] >> 3
    small = np.where(raw >= 256, raw - 512.0, raw)
    np.testing.assert_allclose(series["SMALL.whole"].value, 0.5 * small)
    np.testing.assert_allclose(series["SMALL"].value, 0.5 * np.where(raw >= 256, (raw - 256.0) - 4096.0, raw))


def test_garbled_map_is_read_or_refused():
    """Characters lost, doubled or changed: the map is refused with a reason, or decodes into numbers."""
    readers = {
        TOML: read_toml,
        CSV: read_csv,
        XML: lambda t: read_xml(t.encode()),
        FRA: lambda t: read_vec({"a.par": PAR.encode("utf-16"), "a.fra": t.encode("utf-16")}),
        PAR: lambda t: read_vec({"a.par": t.encode("utf-16"), "a.fra": FRA.encode("utf-16")}),
    }
    refused = 0
    for n, (text, reader) in enumerate(readers.items()):
        for seed in range(60):
            try:
                series = read(RECORDING, reader(garble(text, np.random.default_rng([seed, n]))))
            except MapError:
                refused += 1
            else:
                assert all(s.value is None or np.isfinite(s.value[s.valid]).all() for s in series.values())
    assert 60 < refused < 300


def garble(text: str, rng: np.random.Generator) -> str:
    chars = list(text)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(len(chars)))
        size = int(rng.integers(1, 8))
        match rng.integers(5):
            case 0:
                del chars[at : at + size]
            case 1:
                chars[at] = chr(rng.integers(32, 127))
            case 2:
                chars[at:at] = str(rng.integers(-5, 99999))
            case 3:
                chars[at:at] = chars[: 40 * size][-40:]
            case _:
                chars[int(rng.choice([i for i, c in enumerate(chars) if c.isdigit()]))] = str(rng.integers(10))
    return "".join(chars)


def test_parameters_without_formula_are_listed():
    """What only a person can convert."""
    assert "Teledyne Synchro" in read_xml(XML.encode()).parameters["RUDDER"].unreadable
    assert "SOMETHING NEW" in VEC.parameters["ODD"].unreadable
    assert {"RUDDER", "ODD"}.isdisjoint({*read(RECORDING, VEC), *read(RECORDING, read_xml(XML.encode()))})


@pytest.mark.parametrize(
    ("conversion", "expected"),
    [
        (Polynomial((1.0, 0.0, 2.0)), [3.0, 1.0, 1.5, 9.0, 19.0]),
        (Segments((0.0, 2.0), (1.0, 3.0), (0.0, -4.0)), [np.nan, 0.0, 0.5, 2.0, 5.0]),
        (LookupTable((0.0, 1.0, 2.0), (0.0, 10.0, 0.0)), [np.nan, 0.0, 5.0, 0.0, np.nan]),
    ],
)
def test_conversion_follows_its_formula(conversion, expected):
    np.testing.assert_allclose(conversion(np.array([-1.0, 0.0, 0.5, 2.0, 3.0])), expected)


def test_vec_767_reads_same_values():
    def meaning(p) -> str:
        kinds = {"float": "COMPUTED ON BOARD", "binary": "BNR LINEAR (A*X)", "discrete": "DISCRETE"}
        kind = kinds.get(p.coding.kind, "BCD")
        scale = p.coding.steps[0].coefficients[1] if p.coding.steps else 1.0
        below = ";".join(f"5|{i}\t{low + n}\t{n}" for i, (low, n) in enumerate(p.coding.digits))
        sign = str(p.coding.sign + 1) if p.coding.sign else ""
        return row(p.name[:9], kind, p.coding.bits, p.coding.bits, sign=sign, computation=f"Resol={scale}", below=below)

    own = [p for p in DEMO_767.parameters.values() if p.frame_id in (3, 4)]
    orders = [f"3|{p.frame_id}\t{i}\tLong {p.name}\tX" for i, p in enumerate(own, 1)]
    short = [f"4|Long {p.name}\t{p.name[:9]}" for p in own]
    heads = ["1|647A-1\tDEMO_MAP_7", "2|3\t1 Hz\t1\t\t4\t0", "2|4\t5 Hz\t5\t1\t2\t0"]
    frd = "\n".join([*heads, *reversed(orders), *short])
    layout = read_vec(archive(vec(par="\n".join(map(meaning, own)), frd=frd)))
    data = frames_767(DEMO_767, raw_767(5))
    ours = read(data, DEMO_767)
    theirs = read(data, layout)
    assert {f.size for f in layout.frames.values()} == {DEMO_767.frames[n].size for n in (3, 4)}
    for p in own:
        np.testing.assert_allclose(theirs[p.name[:9]].value, ours[p.name].value)


READERS = {TOML: read_toml, XML: lambda text: read_xml(text.encode())}


@pytest.mark.parametrize(
    ("whole", "change", "message"),
    [
        (TOML, ("words_per_second = 64\n", ""), "no words_per_second in the head"),
        (TOML, ('"ARINC 717"', '"ARINC 573"'), "'ARINC 717' or 'ARINC 767'"),
        (TOML, ("word = 5\n", "word = 65\n"), "parameter PACK_TEMP: subframe 1 word 65 bits 1-12 is outside the frame"),
        (TOML, ('kind = "utc"', 'kind = "clock"'), "parameter UTC: no kind clock"),
        (TOML, ('unit = "kg/s"', 'units = "kg/s"'), "parameter FLOW: no key units"),
        (TOML, ('bits = ["1-12", "1-12", "1-8"]', 'bits = ["1-12", "1-12", "1-9"]'), "parameter COMPUTED: 33 bits"),
        (TOML, ('name = "MODE"', 'name = "VALVE"'), "parameter VALVE: defined twice"),
        (TOML, ('name = "MODE"\n', ""), "parameter without a name: no name"),
        (TOML, ("[[4], [3], [2], [1]]", "[[4], [3], [2], [17]]"), "parameter CITY: a superframe needs"),
        (TOML, ("[[parameter]]", "[[parameter"), "no TOML"),
        (XML, ("<Words_Per_Subframe>64</Words_Per_Subframe>", ""), "no Words_Per_Subframe"),
        (XML, ("Signed Binary", "Signed Ternary"), "parameter ALTITUDE"),
        (XML, ("<Word_Num>5<", "<Word_Num>65<"), "parameter PACK_TEMP: subframe 1 word 65"),
        (XML, ("<Bits_Per_Word>12", "<Bits_Per_Word>16"), "16 bits a word"),
        (XML, ("</FREDFile>", ""), "no XML"),
        (XML, ("<FREDFile", "<!DOCTYPE x [<!ENTITY y 'z'>]><FREDFile"), "no entities"),
    ],
)
def test_unreadable_map_names_place(whole, change, message):
    assert change[0] in whole
    with pytest.raises(MapError, match=message.replace("[", r"\[")):
        READERS[whole](whole.replace(*change, 1))


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "no .par"),
        ({"par": PAR}, "neither .fra nor .frd"),
        ({"par": PAR, "fra": FRA.replace("\t4\t6\t6\t29", "\tx\t6\t6\t29")}, r"\.fra: line 4: invalid literal"),
        ({"par": PAR, "fra": FRA.replace("1|S\t64", "1|S\t8")}, r"\.fra: line 5|\.fra: line \d+: word"),
        ({"par": PAR.replace("\t28\t17\t", "\t28\t\t", 1), "fra": FRA}, r"\.par: line 2: ALTITUDE"),
        ({"par": PAR, "frd": "2|3\tx\tfast"}, r"\.frd: line 1"),
        ({"par": PAR, "frd": "2|3\tx\t1\t1\n3|3\t1\tNOWHERE\tX"}, "does not define NOWHERE"),
    ],
)
def test_unreadable_vec_names_place(files, message):
    with pytest.raises(MapError, match=message):
        read_vec(archive(vec(**files)))
