"""Convert a panic of Polars' engine, which is no `Exception`, into one that can be caught."""

from collections.abc import Iterator
from contextlib import contextmanager

from polars.exceptions import PanicException


class PanicError(RuntimeError):
    """Polars panicked on the data."""


@contextmanager
def panics_as_errors() -> Iterator[None]:
    """Raise a panic inside the block as a `PanicError`."""
    try:
        yield
    except PanicException as panic:
        raise PanicError(str(panic)) from None


def first_line(error: BaseException) -> str:
    """Format an error in one line: its type and the start of its message."""
    return f"{type(error).__name__}: {str(error).splitlines()[0][:200]}" if str(error) else type(error).__name__


def message_of(error: BaseException) -> str:
    """Return the first line of an error's message; for libraries whose messages name the kind of error."""
    return str(error).strip().splitlines()[0]
