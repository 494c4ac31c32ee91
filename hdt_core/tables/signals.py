"""The recorder's signals, shared by snapshots, logs and samples."""

from hdt_core.tables.base import Table, flight_key, number, operator_key, pack_key, tail_key


class Signals(Table):
    """The recorder's signals in SI, without spans: a spike is a recorded value."""

    altitude_m = number("pressure altitude", "m")
    mach = number("Mach number", "-")
    tat_k = number("total air temperature (paper Table 3, no. 1)", "K")
    total_pressure_pa = number("total air pressure (no. 2)", "Pa")
    hx_in_k = number("heat exchanger hot-side inlet (no. 3)", "K")
    hx_out_k = number("heat exchanger hot-side exit (no. 4)", "K")
    ram_door_open = number("ram air inlet door, share open (no. 7)", "-")
    pack_flow_kg_s = number("pack mass flow (no. 8)", "kg/s")
    ram_out_k = number("ram air leaving the heat exchanger, where the sensor is fitted", "K")
    cc_speed_rad_s = number("centrifugal compressor shaft speed", "rad/s")
    cc_in_k = number("compressor inlet temperature", "K")
    cc_in_pa = number("compressor inlet pressure", "Pa")
    cc_out_k = number("compressor exit temperature", "K")
    cc_out_pa = number("compressor exit pressure", "Pa")
    cc_flow_kg_s = number("compressor inlet mass flow", "kg/s")
    vda_counts = number("variable diffuser actuator position", "counts")


SIGNALS = list(Signals.columns())


class SampleTable(Signals):
    """A table of samples: a leg begins the key."""

    operator = operator_key()
    tail = tail_key()
    flight_id = flight_key()
    pack = pack_key()
