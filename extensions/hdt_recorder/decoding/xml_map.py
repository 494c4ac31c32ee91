"""Parameter maps in XML by ARINC 647A (FRED), for ARINC 717 and ARINC 767.

Where the standard's text leaves a choice: the first component of a parameter is its least significant, a table is read
with straight lines between its points, and a value is timed by its place in the frame. A conversion that is described
in words, or by a predefined equation, is not applied: the parameter is listed, with the reason why it has no value.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

from hdt_recorder.decoding.coding import Coding, Kind, LookupTable, Polynomial, Step, cut_digits
from hdt_recorder.decoding.layout import (
    BITS,
    Counter,
    Frame767,
    Map717,
    Map767,
    MapError,
    Parameter,
    ParameterMap,
    Place,
    Sample,
    lay_out,
    sample_at,
    word_bits,
)

T = TypeVar("T")
KINDS: dict[str, Kind] = {
    "Unsigned Binary": "binary", "Signed Binary": "binary", "BCD": "bcd", "Floating Point": "float",
    "ASCII": "characters",
}  # fmt: skip


def read_xml(text: bytes) -> ParameterMap:
    """Read a map from the bytes of an XML file.

    Raises
    ------
    MapError
        Names the parameter or element that can't be read.
    """
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise MapError("a parameter map declares no document type and no entities")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, LookupError, ValueError) as error:
        raise MapError(f"no XML: {error}") from None
    for element in root.iter():
        element.tag = element.tag.rsplit("}", 1)[-1]
    try:
        if (frame := root.find("FRED717")) is not None:
            return _map_717(frame)
        if (frame := root.find("FRED767")) is not None:
            return _map_767(frame)
    except MapError:
        raise
    except (ValueError, ZeroDivisionError) as error:
        raise MapError(f"the frame: {error}") from None
    raise MapError("neither FRED717 nor FRED767 in the XML")


def _text(element: ET.Element, path: str, default: str | None = None) -> str:
    text = element.findtext(path)
    if text is None and default is None:
        raise MapError(f"{element.tag} {element.findtext('Name', '')}: no {path}")
    return (text if text is not None else str(default)).strip()


def _number(element: ET.Element, path: str, default: str | None = None) -> int:
    return int(_text(element, path, default))


def _fraction(element: ET.Element) -> float:
    return _number(element, "Numerator") / _number(element, "Denominator", "1")


def _map_717(root: ET.Element) -> Map717:
    head = root.find("Subframe")
    if head is None:
        raise MapError("FRED717: no Subframe")
    if _number(head, "Bits_Per_Word") != BITS:
        raise MapError(f"Subframe: {_text(head, 'Bits_Per_Word')} bits a word; {BITS} can be read")
    seconds = head.find("Seconds_Per_Subframe")
    layout = Map717(
        _number(head, "Words_Per_Subframe"),
        {},
        sync_words=tuple(int(c.text or "", 2) for c in head.iterfind("Sync_Pattern/Sync_Code")),
        subframe_s=_fraction(seconds) if seconds is not None else 1.0,
    )
    if len(layout.sync_words) != _number(head, "Subframes_Per_Frame"):
        message = f"Subframe: {len(layout.sync_words)} sync codes for {_text(head, 'Subframes_Per_Frame')} subframes"
        raise MapError(message)
    elements = {_text(e, "Name"): e for e in root.iterfind("Parameter717")}
    counters = {_text(c, "Superframe_Parameter", "") for e in elements.values() for c in e.iterfind("Component")} - {""}
    name = min(counters, default="")
    counter = _read_element(elements[name], lambda e: _counter(e, layout)) if name in elements else None
    layout = replace(layout, counter=counter)
    parameters = {n: _read_element(e, lambda e: _parameter_717(e, layout, name)) for n, e in elements.items()}
    return replace(layout, parameters=parameters)


def _read_element(element: ET.Element, read: Callable[[ET.Element], T]) -> T:
    try:
        return read(element)
    except (ValueError, IndexError, KeyError) as error:
        raise MapError(f"parameter {element.findtext('Name')}: {error}") from None


def _places(component: ET.Element) -> list[list[Place]]:
    """Return places of one component by frame of the superframe, in order of time.

    Several lists of subframes or of bits belong to one word each.
    """
    words = [int(w.text or "") for w in component.iterfind("Word_Numbers/Word_Num")]
    subframes = [
        [int(s.text or "") for s in g.iterfind("Subframe_Num")] for g in component.iterfind("Subframe_Numbers")
    ]
    bits = [
        (_number(b, "OneBasedIntRange_Start"), _number(b, "OneBasedIntRange_End")) for b in component.iterfind("Bits")
    ]
    cycles = [int(c.text or "") for c in component.iterfind("Superframe_Cycles/Cycle_Num")]
    for lists in (subframes, bits):
        if len(lists) not in {1, len(words)}:
            raise ValueError(f"{len(lists)} lists for {len(words)} words")
    each = [Place(s, word, *bits[i % len(bits)]) for i, word in enumerate(words) for s in subframes[i % len(subframes)]]
    each.sort(key=lambda p: (p.subframe, p.word))
    return [[replace(p, frame=c + 1) for p in each] for c in sorted(cycles)] if cycles else [each]


def _samples(element: ET.Element, layout: Map717) -> tuple[Sample, ...]:
    components = list(element.iterfind("Component"))
    overlaps = [_number(c, "Overlap_Bits", "0") for c in components]
    places = [[p for frame in _places(c) for p in frame] for c in components]
    subframes = len(layout.sync_words)
    return tuple(
        sample_at(parts, overlaps, layout.words, subframes, layout.subframe_s) for parts in zip(*places, strict=True)
    )


def _counter(element: ET.Element, layout: Map717) -> Counter:
    (sample,) = _samples(element, layout)
    return Counter(sample.pieces[0])


def _parameter_717(element: ET.Element, layout: Map717, counter: str) -> Parameter:
    samples = _samples(element, layout)
    bits = _number(element, "Range/Raw_Range/IntRange_End").bit_length()
    bits = min(bits, word_bits(samples[0])) or word_bits(samples[0])
    superframes = {_text(c, "Superframe_Parameter", "") for c in element.iterfind("Component")} - {""}
    cycle = 1 << layout.counter.piece.bits if superframes and layout.counter else 1
    rate_hz = len(samples) / (cycle * len(layout.sync_words) * layout.subframe_s)
    parameter = replace(_meaning(element, bits), samples=samples, rate_hz=rate_hz, cycle=cycle)
    if superframes - {counter}:
        return replace(parameter, unreadable=f"superframe counter {min(superframes)} is not the map's, {counter}")
    return parameter


def _meaning(element: ET.Element, bits: int) -> Parameter:
    """Return all of a parameter but its samples."""
    kind = _text(element, "Range/Data_Type")
    is_signed = kind == "Signed Binary"
    texts = {
        i: (pair.text or "").strip()
        for pair in element.iterfind("Range/Text_Conversion/Range_Text_Pair")
        for i in range(int(pair.get("min", "0")), min(int(pair.get("max", "0")), 65535) + 1)
    }
    widths = [int(d) for d in _text(element, "Range/BCD_Format", "")] or [4] * (bits // 4)
    if KINDS[kind] == "characters":
        width = 7 if bits % 8 and not bits % 7 else 8
        widths = [width] * (bits // width)
    coding = Coding(
        "discrete" if texts else KINDS[kind], bits=bits - is_signed, sign=bits - 1 if is_signed else None,
        steps=tuple(_steps(element)), digits=cut_digits(widths) if KINDS[kind] in ("bcd", "characters") else (),
        texts=texts,
    )  # fmt: skip
    words = [*element.iterfind("Range/Conversion_Step/Conversion_Description")]
    words += [*element.iterfind("Range/Conversion_Step/Predefined_Equation")]
    lowest, highest = (element.findtext(f"Operational_Range/RealRange_{end}") for end in ("Start", "End"))
    return Parameter(
        _text(element, "Name"), coding, (), 0.0, unit=_text(element, "Units", ""),
        description=_text(element, "Comments", ""), lowest=float(lowest) if lowest else None,
        highest=float(highest) if highest else None,
        unreadable=f"its conversion is told in words: {' '.join((words[0].text or '').split())}" if words else "",
    )  # fmt: skip


def _steps(element: ET.Element) -> Iterator[Step]:
    for step in element.iterfind("Range/Conversion_Step"):
        if powers := {int(p.get("index", "0")): float(p.text or "") for p in step.iterfind("Poly_Coeff/Coeff_Pair")}:
            yield Polynomial(tuple(powers.get(i, 0.0) for i in range(max(powers) + 1)))
        for pairs, index in (
            ("Integer_Real_Table/Integer_Real_Pair", "index"),
            ("Real_Real_Table/Real_Real_Pair", "real_index"),
        ):
            if points := sorted((float(p.get(index, "")), float(p.text or "")) for p in step.iterfind(pairs)):
                yield LookupTable(*zip(*points, strict=True))


def _map_767(root: ET.Element) -> Map767:
    meanings = {
        _text(e, "Name"): _read_element(e, lambda e: _meaning(e, _number(e, "Number_of_Bits")))
        for e in root.iterfind("Parameter767")
    }
    frames = {}
    parameters = {}
    for frame in root.iterfind("Frame"):
        number = _number(frame, "Frame_ID")
        rate = frame.find("Recording_Rate")
        names = [(n.text or "").strip() for n in frame.iterfind("Parameter_List/Name_Ref")]
        if undefined_names := [n for n in names if n not in meanings]:
            raise MapError(f"frame {number}: no parameter {undefined_names[0]}")
        rate_hz = _fraction(rate) if rate is not None else None
        of_frame, size = lay_out([meanings[n] for n in names], number, rate_hz)
        parameters.update({p.name: p for p in of_frame})
        frames[number] = Frame767(number, _text(frame, "Frame_Title", ""), size, rate_hz)
    return Map767(frames, parameters)
