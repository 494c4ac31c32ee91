"""Define every fault of a delivery: a stable code, its scope, and the sentence that an engineer reads."""

from dataclasses import dataclass
from typing import Literal

Scope = Literal["file", "row", "value", "result", "note"]
"""What is not stored: the whole file, a row, one value (null in its row), a row that was computed from it, or nothing
(stored with a note)."""


@dataclass(frozen=True, slots=True)
class Reason:
    """One class of bad input."""

    scope: Scope
    sentence: str
    remedy: str


REASONS: dict[str, Reason] = {
    # the file as a whole
    "unexpected_name": Reason(
        "file", "The name fits no pattern of the landing zone.", "Rename or move the file, then deliver it again."
    ),
    "outside_landing": Reason(
        "file", "The link leads out of the landing zone, so it is not followed.", "Deliver the file itself, not a link."
    ),
    "not_a_file": Reason("file", "This is a pipe, socket or device, not a file.", "Deliver a regular file."),
    "cannot_open": Reason(
        "file", "The file could not be opened or vanished while it was read.", "Check permissions and the disk."
    ),
    "too_large": Reason(
        "file",
        "The file would need more memory than one file may take.",
        "Deliver it in parts, a month or a flight each.",
    ),
    "empty_file": Reason("file", "The file is empty.", "Deliver it again."),
    "no_rows": Reason("file", "The file has a header and no rows.", "Deliver it again if the flight was flown."),
    "not_text": Reason("file", "The content is not text.", "Check what was sent under this name."),
    "wrong_separator": Reason("file", "Fields are not separated by commas.", "Export with commas and decimal points."),
    "no_header": Reason("file", "The first line holds none of the agreed column names.", "Put the header line back."),
    "missing_columns": Reason(
        "file", "Required columns are missing or renamed.", "Use the names of the data contract."
    ),
    "repeated_column": Reason(
        "file", "A column name stands twice in the header, so it is unclear which one holds.", "Keep one of them."
    ),
    "cannot_read_parquet": Reason("file", "The Parquet file is truncated or damaged.", "Deliver it again."),
    "unknown_type": Reason(
        "file",
        "The file is a flight recorder's, and nothing says how it is to be read.",
        "Give the aircraft a type in fleet.csv, and describe the type (`hdt docs howto-recorder`).",
    ),
    "bad_type": Reason(
        "file", "The type description can't be used, or the recorder's map contradicts it.", "Correct the description."
    ),
    "map_does_not_fit": Reason(
        "file",
        "The parameter map of the type does not fit the recording, so nothing of it was decoded.",
        "Find the map of this recorder, or the type of this aircraft.",
    ),
    "no_report": Reason("file", "The file holds no printed report that is known.", "Check what was sent."),
    "cannot_process": Reason(
        "file",
        "Taking in the file failed in a way that was not foreseen; other files went on.",
        "Compare it with a good file; report the detail.",
    ),
    "wrong_type": Reason(
        "file", "A column has a type that holds no numbers, text or times.", "Write the types of the data contract."
    ),
    # a row
    "bad_bytes": Reason("row", "The row holds NUL or bytes that are not UTF-8.", "Check the transfer."),
    "wrong_field_count": Reason(
        "row", "The row has more or fewer fields than the header.", "Check the export; a cut transfer ends so."
    ),
    "bad_quoting": Reason("row", "The quotes in the row do not match.", "Check the export."),
    "cut_short": Reason("row", "The file ends inside this row or number.", "Deliver it again, whole."),
    "repeated_header": Reason("row", "The header stands again among the rows.", "Files were glued together; harmless."),
    "bad_flight_id": Reason("row", "flight_id is not <TAIL>_<YYYYMMDD>_<LEG>.", "Correct the identifier."),
    "bad_cycle_id": Reason(
        "row",
        "flight_id of a component's record is empty, longer than 40 signs, or holds others than letters, digits, _ . -",
        "Correct the identifier.",
    ),
    "flight_id_contradicts_path": Reason(
        "row",
        "flight_id disagrees with the tail of the folder or the name of the file.",
        "Deliver it under its own name.",
    ),
    "unreadable_time": Reason("row", "The time is missing or not ISO 8601.", "Write 2024-06-05T16:55:49Z."),
    "too_early": Reason(
        "row", "The day is before 1980: no recorder and no log of today begins there.", "Correct the date or the clock."
    ),
    "future_time": Reason("row", "The time lies in the future.", "Check the recorder's clock."),
    "time_contradicts_flight_id": Reason(
        "row",
        "The time is not within the flight's day or the one after it.",
        "Check the recorder's clock and the flight_id.",
    ),
    "bad_pack": Reason("row", "pack is not the number of a pack of this aircraft.", "Packs count from 1 (left)."),
    "unit_kelvin": Reason(
        "row", "Temperatures read as kelvin where degrees Celsius are agreed.", "Deliver degrees Celsius."
    ),
    "unit_kpa": Reason(
        "row", "Pressures are 6.9 times what altitude and Mach allow: kPa where psia is agreed.", "Deliver psia."
    ),
    "unit_kg_s": Reason(
        "row",
        "Flows read as kg/s where lb/min is agreed: the compressor turns, hardly any air passes.",
        "Deliver lb/min.",
    ),
    "wrong_unit": Reason(
        "row",
        "Physics holds in this flight only if the columns were written in another unit than agreed.",
        "Deliver the agreed unit.",
    ),
    "swapped_columns": Reason(
        "row",
        "Physics holds in this flight only if two columns were written in each other's place.",
        "Check the wiring and the export.",
    ),
    "conflicting_delivery": Reason(
        "row",
        "Another delivery contradicts this one of the same flight; the one with more rows is stored as a whole.",
        "Find out which is right, and deliver it again under the name of the one that is stored.",
    ),
    "replaced_row": Reason(
        "row",
        "An earlier version of this file held the row; the later one lacks it and gives other values elsewhere.",
        "Deliver the file whole.",
    ),
    "bad_code": Reason("row", "A code is missing or not one of those agreed.", "Use the codes of the data contract."),
    "bad_cost": Reason("file", "The cost table can't be used, so no cost is given.", "Correct the key that is named."),
    "bad_key": Reason("row", "The operator or tail is missing, malformed or listed twice.", "Correct the list."),
    "report_without_head": Reason(
        "row",
        "The head of a printed report can't be read: aircraft, date and time are not known.",
        "Read the recorder again, if it can be.",
    ),
    "other_aircraft": Reason(
        "row", "The head of a printed report names another aircraft.", "Deliver it in that aircraft's folder."
    ),
    # a value
    "not_a_number": Reason(
        "value", "Text, NaN or infinity stands where a number belongs.", "Leave the field empty when there is no value."
    ),
    "out_of_range": Reason(
        "value", "The value is outside what the quantity can physically be.", "Check the sensor and the unit."
    ),
    "unknown_phase": Reason(
        "value", "phase_code is none of TO CL CR DS AP GR.", "Leave it empty when it is not known."
    ),
    "unknown_airport": Reason(
        "value", "origin or destination is no ICAO airport code.", "Write four capital letters, or leave it empty."
    ),
    # a result
    "breaks_declaration": Reason(
        "result",
        "A row computed from this flight breaks the declaration of its table, so it is not stored.",
        "Look at what the flight recorded; report it.",
    ),
    # a note
    "tail_of_two_operators": Reason(
        "note", "The same tail flies for two operators on the same days.", "Find out which of the folders is right."
    ),
    "unknown_tail": Reason("note", "The aircraft is not in fleet.csv.", "Add it to the fleet list."),
    "fewer_packs": Reason(
        "note",
        "fleet.csv gives the aircraft fewer packs than are stored of this file; what is stored stays.",
        "Correct the line in fleet.csv.",
    ),
    "flight_id_from_column": Reason(
        "note",
        "The file name is not a flight_id; the flight was taken from the column.",
        "Name the file after its flight.",
    ),
    "before_delivery": Reason(
        "note", "The work is dated before the aircraft was delivered.", "Correct the date, here or in fleet.csv."
    ),
    "extra_columns": Reason("note", "Columns outside the data contract were left aside.", "Nothing, or agree on them."),
    "other_spelling": Reason(
        "note",
        "Column names differ from the contract in case or spaces; they were accepted.",
        "Use the names of the data contract.",
    ),
    "other_encoding": Reason(
        "note", "The text is UTF-16 or starts with a byte order mark; it was converted.", "Export as plain UTF-8."
    ),
    "fewer_rows": Reason(
        "note", "The file came again with fewer rows of a flight than before.", "Deliver it again, whole."
    ),
    "clock_jump": Reason(
        "note",
        "Reports of one flight lie hours apart, as if the clock was set on the way.",
        "Check the recorder's clock.",
    ),
    "implausible_pressure": Reason(
        "note",
        "Over the flight, total pressure is not what the standard atmosphere gives for altitude and Mach.",
        "Check the units of all three.",
    ),
    "damaged_line": Reason(
        "note", "A line of a printed report is not as its layout has it; the report's head counts.", "Nothing."
    ),
    "unknown_report": Reason(
        "note", "No layout declares this printed report.", "Declare it, or let it be (`hdt docs howto-recorder`)."
    ),
    "recording_damaged": Reason(
        "note", "A part of the recording is damaged; what it held is null.", "Read the recorder again, if it can be."
    ),
    "time_without_zone": Reason(
        "note", "Times carry no zone; they were taken as UTC, as the contract says.", "Write Z at the end."
    ),
}


def as_markdown() -> str:
    """Render the table of reasons in `docs/bad-input.md`."""
    head = "| reason | scope | what is wrong | what to do |\n| --- | --- | --- | --- |\n"
    return head + "".join(f"| `{code}` | {r.scope} | {r.sentence} | {r.remedy} |\n" for code, r in REASONS.items())
