"""Units that recorders write, in those that the code reckons in."""

POUND_KG = 0.45359237
"""Pound. [kg] (NIST SP 811, appendix B)"""
PSI_PA = 6894.757293168361
"""Pound-force per square inch. [Pa] (the same)"""
FOOT_M = 0.3048
"""Foot. [m] (the same)"""
ZERO_CELSIUS_K = 273.15
"""Zero of the Celsius scale. [K] (the same)"""
