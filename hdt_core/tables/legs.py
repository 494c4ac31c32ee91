"""Tables of stage legs: nominal flights and samples, and reasons for the others."""

from hdt_core.tables.base import DatedLegTable, LegTable, count, flag, moment, number, text
from hdt_core.tables.signals import SampleTable


class LegsSamples(SampleTable):
    """One usable sample, without values outside a sensor's range: flight, pack, time."""

    time_utc = moment("time of the sample, the middle of an averaged window", primary_key=True)
    source = text("acms or cpl", nullable=False, primary_key=True)
    departed_at = moment("first recorded time of the flight")
    phase = text("ground, climb, cruise or descent, from altitude, Mach and time")
    nominal = flag("steady cruise, fit to calibrate from")
    monitored = flag("steady enough to judge health from, sick or not")
    n_averaged = count("seconds averaged, 1 for a snapshot")
    steady = flag("no driving signal on the move", nullable=True)
    level = flag("level flight", nullable=True)
    icing = flag("icing conditions", nullable=True)
    climb_rate_m_s = number("rate of climb", "m/s")
    n_out_of_range = count("values taken out because no sensor can show them", nullable=True)
    n_spikes = count("values taken out because the neighbours contradict them", nullable=True)
    n_frozen = count("values taken out because the sensor repeats itself", nullable=True)


class LegsVerdicts(DatedLegTable):
    """One leg as its own record shows it: flight, pack."""

    landed_at = moment("last recorded time")
    source = text("acms, cpl or both", nullable=False)
    n_snapshots = count("snapshots of the pack")
    cruise_minutes = number("time in cruise", "min", 0)
    admitted = flag("fit to calibrate from")
    reason = text("reason code, empty when admitted", nullable=False)
    n_samples = count("samples left after the sample filter")
    n_nominal = count("of these, nominal")
    n_monitored = count("of these, fit to judge health from")
    n_frozen = count("values taken out because the sensor repeats itself")


class LegsIndicators(LegTable):
    """Indicators of a leg by its own samples, against the fleet's laws: flight, pack."""

    index_level = number("conductance index, median of the leg: 0.1 less is a loss of about 10 %")
    index_n = count("samples behind it", nullable=True)
    index_unrest = number("how far a few samples in a row leave the leg's median, in standard errors", low=0)
    outlet_between_packs_k = number("exchanger outlet above the other pack's, while both doors can move", "K")
    outlet_above_law_k = number("exchanger outlet above the law the controllers hold", "K")
    inlet_minus_tat_k = number("compressor inlet above TAT", "K")
    inlet_over_total_pressure_ln = number("ln of compressor inlet over total pressure")
    pack_over_compressor_flow_ln = number("ln of pack flow over compressor flow")
    pack_flow_between_packs_ln = number("ln of pack flow over the other pack's")
    pack_flow_ln = number("ln of pack flow in kg/s")


class LegsAdmitted(DatedLegTable):
    """The final verdict on a leg, with the twin and the maintenance log at hand: flight, pack."""

    admitted = flag("fit to calibrate from")
    reason = text("reason code, empty when admitted", nullable=False)
    n_samples = count("samples left after the sample filter")
    n_nominal = count("of these, nominal")
