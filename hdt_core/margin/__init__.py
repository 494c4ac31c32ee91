"""The margin that is left: what flights demand of exchanger and compressor, against what they can still give."""
