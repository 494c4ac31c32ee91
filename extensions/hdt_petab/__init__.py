"""Estimation problems as PEtab files, and back."""

from hdt_petab.files import read_petab, write_petab

__all__ = ["read_petab", "write_petab"]
