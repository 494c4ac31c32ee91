"""A panic of Polars' engine is no `Exception`, so nobody catches it: here it becomes one."""

from collections.abc import Iterator
from contextlib import contextmanager

from polars.exceptions import PanicException


class PanicError(RuntimeError):
    """Polars came to a state it holds impossible, for what the data held."""


@contextmanager
def panics_as_errors() -> Iterator[None]:
    """Let a panic inside the block be caught as other errors are."""
    try:
        yield
    except PanicException as panic:
        raise PanicError(str(panic)) from None


def first_line(error: BaseException) -> str:
    """An error in one line: its type and how its message begins."""
    return f"{type(error).__name__}: {str(error).splitlines()[0][:200]}" if str(error) else type(error).__name__


def message_of(error: BaseException) -> str:
    """The first line of an error's message, of a library whose messages say what kind they are."""
    return str(error).strip().splitlines()[0]
