"""Stage residuals: sensor against model against twin."""

from hdt_core.tables.base import ComponentLegTable, count, number, text


class Residuals(ComponentLegTable):
    """One signal's residual over a flight: flight, pack, signal, kind."""

    component = text("code of the component", nullable=False)
    signal = text("signal compared", nullable=False, primary_key=True)
    kind = text("sensor_minus_dsm, dsm_minus_twin or sensor_minus_twin", nullable=False, primary_key=True)
    mean = number("mean over the flight's samples, in `unit`")
    sd = number("standard deviation over the samples, in `unit`", low=0)
    rms = number("root mean square, in `unit`", low=0)
    unit = text("unit of the signal", nullable=False)
    n = count("samples")
