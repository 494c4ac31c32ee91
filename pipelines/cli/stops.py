"""Stop a run on Ctrl-C or SIGTERM: in order for short commands, at once for a night."""

import atexit
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STOPS = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S = 1.0


class StoppedError(BaseException):
    """A stop signal, outside `Exception` so that nothing handles it as an error; `code` is the exit code."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


@contextmanager
def stop_in_order() -> Iterator[None]:
    """Raise `StoppedError` on Ctrl-C and SIGTERM within the block, so that unfinished files are removed."""

    signals: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        raise StoppedError(number)

    try:
        with _handled(stop):
            yield
    except BaseException:
        if signals:  # an interrupted library raises an error of its own
            raise StoppedError(signals[0]) from None
        raise


@contextmanager
def stop_at_once(report: Callable[[], None]) -> Iterator[None]:
    """End this process and its workers on Ctrl-C and SIGTERM within the block, with exit code 130 or 143.

    Nothing is cleaned up: a night may be killed at any moment. A thread ends the process, because Dagster installs
    handlers that drop signals between two steps, and Python runs none before a computation in C returns.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    previous = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)  # the handler in C writes to it at once
    watcher = threading.Thread(target=_watch, args=(reader, report), daemon=True)
    watcher.start()
    try:
        with _handled(lambda number, frame: None):
            yield
    finally:
        signal.set_wakeup_fd(previous)
        os.close(writer)
        watcher.join()
        os.close(reader)


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in STOPS}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _watch(reader: int, report: Callable[[], None]) -> None:
    while number := os.read(reader, 1):
        if number[0] in STOPS:
            _end(128 + number[0], report)


def _end(code: int, report: Callable[[], None]) -> None:
    """End workers and process; exit handlers release the workers' semaphores, else their tracker warns."""
    threading.Timer(_PATIENCE_S, os._exit, (code,)).start()
    try:
        for worker in multiprocessing.active_children():
            worker.kill()
        report()
        atexit._run_exitfuncs()
    finally:
        os._exit(code)
