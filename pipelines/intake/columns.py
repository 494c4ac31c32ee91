"""Declare the recorder's columns: name in the contract, name and scale in SI, possible values."""

from dataclasses import dataclass
from math import pi

POUND_KG = 0.45359237
PSI_PA = 6894.757293168361
ZERO_CELSIUS_K = 273.15

KEYS = ("flight_id", "report_time", "pack")
PHASE = "phase_code"
AIRPORTS = ("origin", "destination")
WORDS = (PHASE, *AIRPORTS)
"""Columns of text that may be missing for an operator, or empty."""


@dataclass(frozen=True, slots=True)
class Column:
    """One signal: SI value = recorded * scale + offset; a recorded value outside `low`..`high` is not stored.

    The span is what any airliner's sensor can show, noise about zero included: frozen, drifting and spiked values
    within it are stored, and assessed by flight later.
    """

    name: str
    si_name: str
    low: float
    high: float
    scale: float = 1.0
    offset: float = 0.0


SIGNAL_COLUMNS = (
    Column("altitude_ft", "altitude_m", -2_000, 60_000, 0.3048),
    Column("mach", "mach", -0.1, 1.2),
    Column("tat_degc", "tat_k", -110, 80, offset=ZERO_CELSIUS_K),
    Column("pt_psia", "total_pressure_pa", -2, 25, PSI_PA),
    Column("hx_in_degc", "hx_in_k", -110, 350, offset=ZERO_CELSIUS_K),
    Column("hx_out_degc", "hx_out_k", -110, 280, offset=ZERO_CELSIUS_K),
    Column("ram_door_pct", "ram_door_open", -10, 110, 0.01),
    Column("pack_flow_lbpm", "pack_flow_kg_s", -20, 600, POUND_KG / 60.0),
    Column("ram_out_degc", "ram_out_k", -110, 280, offset=ZERO_CELSIUS_K),
    Column("cc_speed_rpm", "cc_speed_rad_s", -500, 120_000, pi / 30.0),
    Column("cc_in_degc", "cc_in_k", -110, 120, offset=ZERO_CELSIUS_K),
    Column("cc_in_psia", "cc_in_pa", -2, 40, PSI_PA),
    Column("cc_out_degc", "cc_out_k", -110, 400, offset=ZERO_CELSIUS_K),
    Column("cc_out_psia", "cc_out_pa", -2, 100, PSI_PA),
    Column("cc_flow_lbpm", "cc_flow_kg_s", -20, 600, POUND_KG / 60.0),
    Column("vda_pos", "vda_counts", -100, 70_000),
)
SIGNAL_NAMES = tuple(c.name for c in SIGNAL_COLUMNS)
"""Any of these may be missing for an operator; the keys may not."""
CORE_NAMES = SIGNAL_NAMES[:8]
"""Signals that nearly every operator records; two missing and as many unknown names mean renamed columns."""
SI_NAMES = tuple(c.si_name for c in SIGNAL_COLUMNS)


@dataclass(frozen=True, slots=True)
class Contract:
    """Columns of a kind of file."""

    keys: tuple[str, ...]
    """Required columns."""
    words: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ()
    """Columns of numbers; of these and `words` any but a key may be missing."""
    core: tuple[str, ...] = ()
    """Columns that nearly every file has."""
    extra: tuple[str, ...] = ()
    """Columns whose absence is never a sign of renaming."""

    @property
    def optional(self) -> tuple[str, ...]:
        """Columns that may be missing, unless they seem renamed."""
        return tuple(n for n in (*self.words, *self.numbers) if n not in self.keys)


PACK_FILES = Contract(KEYS, WORDS, ("pack", *SIGNAL_NAMES), CORE_NAMES)
"""Files of the pack by the data contract."""
