"""The table of what a flight demands of the parts, independent of their wear."""

from hdt_core.tables.base import DatedLegTable, Table, count, flag, number, text

_IS_AT = "ln conductance ratio at which the outlet, door full open, is"
_DELIVERS = "ln of the least diameter over equation (6)'s that delivers"
_HARD = "of the flow asked in a fifth of the cruise, at the highest speed"
_HOT = "of the flow asked in its middle, were it hot and high, at the highest speed"


class _ExchangerDemand(Table):
    """Demand of a flight on the exchanger, independent of its wear."""

    high_n = count("samples above 15,000 ft behind it")
    held_k = number("level the controller holds the hot outlet at, median of the high samples", "K")
    held_status = text("flight, pack or unknown: whose level that is", nullable=False)
    full_open_share = number("share of the high samples with the ram door full open", "-", 0, 1)
    overheat_p20_k = number("hottest fifth of the high samples: outlet above its level, door full open", "K", 0)
    overheat_p50_k = number("hotter half of the high samples: outlet above its level, door full open", "K", 0)
    hx_margin_design_k = number("margin of a clean pack at the reference cruise", "K")
    hx_margin_target_k = number("what the flight's own target adds to it", "K")
    hx_margin_flow_k = number("what the flight's flow and inlet temperature add", "K")
    hx_margin_ambient_k = number("what the air outside adds", "K")
    hx_margin_blockage_k = number("what a blocked ram side adds; null without a ram outlet probe", "K")
    critical_ln_ratio_p20_minus_20k = number(f"{_IS_AT} 20 K below its level in a fifth of the high samples")
    critical_ln_ratio_p20_minus_10k = number(f"{_IS_AT} 10 K below its level in a fifth of the high samples")
    critical_ln_ratio_p20_0k = number(f"{_IS_AT} at its level in a fifth of the high samples")
    critical_ln_ratio_p20_5k = number(f"{_IS_AT} 5 K above its level in a fifth of the high samples")
    critical_ln_ratio_p20_10k = number(f"{_IS_AT} 10 K above its level in a fifth of the high samples")
    critical_ln_ratio_p50_minus_20k = number(f"{_IS_AT} 20 K below its level in half of them")
    critical_ln_ratio_p50_minus_10k = number(f"{_IS_AT} 10 K below its level in half of them")
    critical_ln_ratio_p50_0k = number(f"{_IS_AT} at its level in half of them")
    critical_ln_ratio_p50_5k = number(f"{_IS_AT} 5 K above its level in half of them")
    critical_ln_ratio_p50_10k = number(f"{_IS_AT} 10 K above its level in half of them")
    critical_ln_ratio_hot_day_minus_20k = number(f"{_IS_AT} 20 K below its level on the standard's hot day")
    critical_ln_ratio_hot_day_minus_10k = number(f"{_IS_AT} 10 K below its level on the standard's hot day")
    critical_ln_ratio_hot_day_0k = number(f"{_IS_AT} at its level on the standard's hot day")
    critical_ln_ratio_hot_day_5k = number(f"{_IS_AT} 5 K above its level on the standard's hot day")
    critical_ln_ratio_hot_day_10k = number(f"{_IS_AT} 10 K above its level on the standard's hot day")


class CompressorDemand(Table):
    """Demand of a flight on the compressor, independent of its wear."""

    cc_flow_asked_kg_s = number("flow asked of the compressor, by speed and diffuser, median in cruise", "kg/s")
    cc_speed_limit_met = flag("the compressors' highest speed is known to be their limit", nullable=True)
    critical_ln_diameter_p20_60pct = number(f"{_DELIVERS} 60 % {_HARD}")
    critical_ln_diameter_p20_80pct = number(f"{_DELIVERS} 80 % {_HARD}")
    critical_ln_diameter_p20_100pct = number(f"{_DELIVERS} 100 % {_HARD}")
    critical_ln_diameter_p20_120pct = number(f"{_DELIVERS} 120 % {_HARD}")
    critical_ln_diameter_p20_150pct = number(f"{_DELIVERS} 150 % {_HARD}")
    cc_widest_share_p20 = number(f"share {_HARD}, that the widest diffuser known delivers")
    critical_ln_diameter_hot_high_60pct = number(f"{_DELIVERS} 60 % {_HOT}")
    critical_ln_diameter_hot_high_80pct = number(f"{_DELIVERS} 80 % {_HOT}")
    critical_ln_diameter_hot_high_100pct = number(f"{_DELIVERS} 100 % {_HOT}")
    critical_ln_diameter_hot_high_120pct = number(f"{_DELIVERS} 120 % {_HOT}")
    critical_ln_diameter_hot_high_150pct = number(f"{_DELIVERS} 150 % {_HOT}")
    cc_widest_share_hot_high = number(f"share {_HOT}, that the widest diffuser known delivers")


class FeaturesMargin(DatedLegTable, _ExchangerDemand, CompressorDemand):
    """Demand of a flight on exchanger and compressor, independent of their wear: flight, pack."""
