"""CoolProp, loaded when a test first asks it: that takes two seconds of every test process."""

from pkgutil import resolve_name


def PropsSI(*question: float | str) -> float:  # noqa: N802 - its own name
    """A property of a fluid in a state, as CoolProp's function of this name has it."""
    return float(resolve_name("CoolProp.CoolProp:PropsSI")(*question))
