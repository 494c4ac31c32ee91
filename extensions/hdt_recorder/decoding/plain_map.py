"""Parameter maps that a person writes: TOML, or a CSV with a parameter a line; `docs/howto-recorder.md` shows both."""

import csv
import io
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hdt_core.loading import parse_toml
from hdt_recorder.decoding.coding import Coding, Polynomial, Segments, Step, cut_digits
from hdt_recorder.decoding.layout import (
    SYNC_WORDS,
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

KINDS = ("binary", "bcd", "discrete", "characters", "utc", "float")
FRAMES_PER_SUPERFRAME = 16
PLACE_KEYS = {"subframe", "word", "bits", "superframe", "frame", "size"}
VALUE_KEYS = {"kind", "signed", "scale", "offset", "segments", "digits", "decimals", "texts", "lowest", "highest"}
KEYS = {"name", "unit", "description", *PLACE_KEYS, *VALUE_KEYS}


def read_toml(text: str) -> ParameterMap:
    """Read a map from TOML. Raises `MapError`, which names the parameter and what is wrong with it."""
    try:
        document = parse_toml(text)
    except ValueError as error:
        raise MapError(str(error)) from None
    return _build(document)


def read_csv(text: str) -> ParameterMap:
    """Read a map from CSV: lines that begin with `#` are the head, in TOML; then a header and a line a parameter."""
    lines = text.splitlines()
    try:
        head = parse_toml("\n".join(line[1:] for line in lines if line.startswith("#")))
    except ValueError as error:
        raise MapError(f"the lines that begin with #: {error}") from None
    rows = csv.DictReader(io.StringIO("\n".join(line for line in lines if not line.startswith("#"))), strict=True)
    try:
        entries = [{k: _cell(k, v) for k, v in row.items() if k and v} for row in rows]
    except (csv.Error, ValueError) as error:
        raise MapError(f"line {rows.line_num} below the head: {error}") from None
    return _build({**head, "parameter": entries})


def _cell(key: str, text: str) -> Any:
    """Parse a cell as TOML has it: lists are separated by spaces, parts by `+`, texts by `;`."""
    return _CELLS.get(key, str)(text)


def _yes(text: str) -> bool:
    if text.lower() not in {"yes", "no", "true", "false"}:
        raise ValueError(f"signed is yes or no, not {text!r}")
    return text.lower() in {"yes", "true"}


def _numbers(text: str) -> list[list[int]]:
    return [[int(x) for x in part.split()] for part in text.split("+")]


_CELLS: dict[str, Callable[[str], Any]] = {
    "bits": lambda text: text.split("+"),
    "digits": lambda text: [int(x) for x in text.split()],
    "texts": lambda text: dict(pair.split("=", 1) for pair in text.split(";")),
    "signed": _yes,
    **dict.fromkeys(("superframe", "subframe", "word"), _numbers),
    **dict.fromkeys(("frame", "size", "decimals"), int),
    **dict.fromkeys(("scale", "offset", "lowest", "highest"), float),
}


def _build(document: dict[str, Any]) -> ParameterMap:
    form = document.get("format")
    try:
        if form == "ARINC 717":
            return _map_717(document)
        if form == "ARINC 767":
            return _map_767(document)
    except KeyError as error:
        raise MapError(f"no {error.args[0]} in the head") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise MapError(f"the head: {error}") from None
    raise MapError(f"format = {form!r}; it is 'ARINC 717' or 'ARINC 767'")


def _map_717(document: dict[str, Any]) -> Map717:
    words = int(document["words_per_second"])
    syncs = tuple(int(s, 16) for s in document["sync_words"]) if "sync_words" in document else SYNC_WORDS
    counter = None
    if "counter" in document:
        try:
            counter = Counter(
                _samples(document["counter"], words, len(syncs))[0].pieces[0], int(document["counter"].get("first", 0))
            )
        except (KeyError, ValueError, TypeError) as error:
            raise MapError(f"counter: {error}") from None
    parameters: dict[str, Parameter] = {}
    frames = int(document.get("frames_per_superframe", FRAMES_PER_SUPERFRAME))
    for entry in _entries(document):
        parameter = _read_parameter(entry, lambda e: _parameter_717(e, Map717(words, {}, counter, syncs), frames))
        _add(parameters, parameter)
    return Map717(words, parameters, counter, syncs)


def _entries(document: dict[str, Any]) -> list[dict[str, Any]]:
    entries = document.get("parameter", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise MapError("parameters stand below [[parameter]]")
    return entries


def _add(parameters: dict[str, Parameter], parameter: Parameter) -> None:
    if parameter.name in parameters:
        raise MapError(f"parameter {parameter.name}: defined twice")
    parameters[parameter.name] = parameter


def _read_parameter(entry: dict[str, Any], read: Any) -> Parameter:
    name = entry.get("name", "without a name")
    if strange := sorted(set(entry) - KEYS):
        raise MapError(f"parameter {name}: no key {strange[0]}; there are {', '.join(sorted(KEYS))}")
    try:
        parameter: Parameter = read(entry)
    except KeyError as error:
        raise MapError(f"parameter {name}: no {error.args[0]}") from None
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise MapError(f"parameter {name}: {error}") from None
    return parameter


def _parameter_717(entry: dict[str, Any], layout: Map717, frames: int) -> Parameter:
    subframes = len(layout.sync_words)
    cycle = max(frames, 1) if "superframe" in entry else 1
    samples = _samples(entry, layout.words, subframes)
    if cycle > 1 and (layout.counter is None or max(p.frame for s in samples for p in s.pieces) >= frames):
        raise ValueError(f"a superframe needs a counter in the head, and frames from 1 to {frames}")
    rate_hz = len(samples) / (cycle * subframes)
    return replace(_meaning(entry, word_bits(samples[0])), samples=samples, cycle=cycle, rate_hz=rate_hz)


def _samples(entry: dict[str, Any], words: int, subframes: int) -> tuple[Sample, ...]:
    """Return a sample per frame, subframe and word; of parts, the least significant comes first.

    Parts are lists within a list; `bits` holds one range, or one a part.
    """
    values = {"superframe": [0], **entry}
    ranges = values["bits"] if isinstance(values["bits"], list) else [values["bits"]]
    lists = [_parts(values[key]) for key in ("superframe", "subframe", "word")]
    count = max(len(ranges), *map(len, lists))
    if any(len(each) not in {1, count} for each in (ranges, *lists)):
        raise ValueError(f"{count} parts, but not as many superframes, subframes, words or bits")
    parts = [_places(ranges[i % len(ranges)], *(each[i % len(each)] for each in lists)) for i in range(count)]
    return tuple(sample_at(place, [0] * count, words, subframes, 1.0) for place in zip(*parts, strict=True))


def _parts(value: Any) -> list[list[int]]:
    values = value if isinstance(value, list) else [value]
    return values if values and isinstance(values[0], list) else [values]


def _places(bits: Any, frames: list[int], subframes: list[int], words: list[int]) -> list[Place]:
    low, _, high = str(bits).partition("-")
    return [Place(s, w, int(low), int(high or low), f) for f in frames for s in subframes for w in words]


def _map_767(document: dict[str, Any]) -> Map767:
    frames: dict[int, Frame767] = {}
    parameters: dict[str, Parameter] = {}
    entries = list(document.get("parameter", ()))
    for kind in document["frames"]:
        number = int(kind["number"])
        rate_hz = kind.get("rate_hz")
        meanings = [
            _read_parameter(e, lambda e: _meaning(e, int(e["size"]))) for e in entries if e.get("frame") == number
        ]
        of_frame, size = lay_out(meanings, number, rate_hz)
        for parameter in of_frame:
            _add(parameters, parameter)
        frames[number] = Frame767(number, kind.get("title", ""), size, rate_hz)
    if orphans := [e for e in entries if e.get("frame") not in frames]:
        raise MapError(f"parameter {orphans[0].get('name')}: no frame {orphans[0].get('frame')} in the head")
    return Map767(frames, parameters, document.get("revision", ""))


def _meaning(entry: dict[str, Any], bits: int) -> Parameter:
    kind = entry.get("kind", "binary")
    is_signed = bool(entry.get("signed", False))
    if kind not in KINDS:
        raise ValueError(f"no kind {kind}; there are {', '.join(KINDS)}")
    usual = 4 if kind == "bcd" else 8
    widths = [int(w) for w in entry.get("digits", ())] or [usual] * (bits // usual)
    if kind in ("bcd", "characters") and (sum(widths) > bits or not widths):
        raise ValueError(f"digits of {sum(widths)} bits in a word of {bits}")
    coding = Coding(
        kind, bits=bits - is_signed, sign=bits - 1 if is_signed else None, steps=_steps(entry),
        digits=cut_digits(widths) if kind in ("bcd", "characters") else (), decimals=int(entry.get("decimals", 0)),
        base=float(entry.get("offset", 0.0)) if kind == "bcd" else 0.0,
        texts={int(k): str(v) for k, v in entry.get("texts", {}).items()},
    )  # fmt: skip
    lowest, highest = (None if entry.get(k) is None else float(entry[k]) for k in ("lowest", "highest"))
    unit = entry.get("unit", "")
    description = entry.get("description", "")
    return Parameter(entry["name"], coding, (), 0.0, unit, description, lowest=lowest, highest=highest)


def _steps(entry: dict[str, Any]) -> tuple[Step, ...]:
    """Return steps from `scale` and `offset`, or from `segments` of (from, scale, offset)."""
    if "segments" in entry:
        starts, scales, offsets = zip(*sorted(tuple(map(float, s)) for s in entry["segments"]), strict=True)
        return (Segments(starts, scales, offsets),)
    scale = float(entry.get("scale", 1.0))
    offset = float(entry.get("offset", 0.0))
    return (Polynomial((offset, scale)),) if (scale, offset) != (1.0, 0.0) else ()
