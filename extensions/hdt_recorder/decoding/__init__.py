"""From the bytes of a flight recorder to parameters: ARINC 717 and ARINC 767, and printed ACMS reports.

Functions from bytes to arrays: no files, no other room of the house. `frames_717` and `frames_767` find the frames in
a recording, `vec_map`, `xml_map` and `plain_map` read where a parameter lies, `values` turns bits into values, `fit`
tells whether a map belongs to a recording, and `decode` puts them together.
"""
