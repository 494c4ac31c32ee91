"""Margins: the demand of flights on exchanger and compressor, against the capacity that is left."""
