"""Stage residuals: sensor against model against twin."""

from hdt_core.tables.base import Table, count, flight_key, number, operator_key, pack_key, tail_key, text


class Residuals(Table):
    """One signal's residual over a flight: flight, pack, signal, kind."""

    operator = operator_key()
    tail = tail_key()
    flight_id = flight_key()
    pack = pack_key()
    component = text("HX or CC", nullable=False)
    signal = text("signal compared", nullable=False, primary_key=True)
    kind = text("sensor_minus_dsm, dsm_minus_twin or sensor_minus_twin", nullable=False, primary_key=True)
    mean = number("mean over the flight's samples, in `unit`")
    sd = number("standard deviation over the samples, in `unit`", low=0)
    rms = number("root mean square, in `unit`", low=0)
    unit = text("unit of the signal", nullable=False)
    n = count("samples")
