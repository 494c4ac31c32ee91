"""Processor time of Dagster's bookkeeping in a night.

Two nights, one with Dagster and one without, differ by a tenth, and so does the same night from one quarter of an hour
to the next. So a night's processor time is taken apart within it: what passes in runs, less what passes in the assets'
own functions and in storing and marking what they return.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from dagster._core.execution.plan import compute_generator

from pipelines.orchestration import runs
from pipelines.resources import FrameIO


class Clock:
    """Accumulator of processor seconds; nested intervals count once."""

    def __init__(self) -> None:
        self.seconds, self._within = 0.0, 0

    @contextmanager
    def ticking(self) -> Iterator[None]:
        """Accumulate the time of the block."""
        began, self._within = time.process_time(), self._within + 1
        try:
            yield
        finally:
            self._within -= 1
            self.seconds += 0.0 if self._within else time.process_time() - began

    def of(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function to accumulate its time."""

        @wraps(function)
        def counted(*args: Any, **kwargs: Any) -> Any:
            with self.ticking():
                return function(*args, **kwargs)

        return counted

    def of_each(self, function: Callable[..., Iterator[Any]]) -> Callable[..., Iterator[Any]]:
        """Wrap a generator function to accumulate the time of each item."""

        @wraps(function)
        def counted(*args: Any, **kwargs: Any) -> Iterator[Any]:
            iterator = self.of(function)(*args, **kwargs)
            while True:
                with self.ticking():
                    try:
                        one = next(iterator)
                    except StopIteration:
                        return
                yield one

        return counted


@contextmanager
def bookkeeping() -> Iterator[Callable[[], float]]:
    """Processor seconds of Dagster's bookkeeping so far, as a function."""
    within, own = Clock(), Clock()
    whole = [(runs.Runner, "_run"), (runs.Runner, "register"), (runs, "open_instance")]
    ours = [(FrameIO, "keep")]
    with ExitStack() as patched:
        for clock, methods in ((within, whole), (own, ours)):
            for owner, name in methods:
                patched.enter_context(patch.object(owner, name, clock.of(getattr(owner, name))))
        invoked = own.of_each(compute_generator.invoke_compute_fn)
        patched.enter_context(patch.object(compute_generator, "invoke_compute_fn", invoked))
        yield lambda: within.seconds - own.seconds
