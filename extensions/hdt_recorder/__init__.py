"""Flight recorders' own files: described by types of aircraft, decoded, taken in like files of the contract."""
