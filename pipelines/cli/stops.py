"""How a long run ends when it is asked to: at once, whatever it is at."""

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
    """Someone asked this process to stop; no error that anything may handle. `code` is what to exit with."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


@contextmanager
def ends_in_order() -> Iterator[None]:
    """Within the block Ctrl-C and SIGTERM raise `StoppedError`: what was being written is tidied away."""

    asked: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        raise StoppedError(number)

    try:
        with _handled(stop):
            yield
    except BaseException:
        if asked:  # a library that was interrupted says so in words of its own
            raise StoppedError(asked[0]) from None
        raise


@contextmanager
def ends_at_once(say: Callable[[], None]) -> Iterator[None]:
    """Within the block Ctrl-C and SIGTERM end this process and its workers, with exit code 130 or 143.

    Nothing is tidied away: a night is made to be killed. It is a thread that ends the process, for Dagster puts
    handlers of its own in place that swallow what comes between two steps, and none of Python's runs before a
    computation in C is over.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    woken = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)  # written to by the handler in C, at once
    watcher = threading.Thread(target=_watch, args=(reader, say), daemon=True)
    watcher.start()
    try:
        with _handled(lambda number, frame: None):
            yield
    finally:
        signal.set_wakeup_fd(woken)
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


def _watch(reader: int, say: Callable[[], None]) -> None:
    while told := os.read(reader, 1):
        if told[0] in STOPS:
            _end(128 + told[0], say)


def _end(code: int, say: Callable[[], None]) -> None:
    """Let go of what the system keeps for us: unless the semaphores of workers are, their tracker complains."""
    threading.Timer(_PATIENCE_S, os._exit, (code,)).start()
    try:
        for worker in multiprocessing.active_children():
            worker.kill()
        say()
        atexit._run_exitfuncs()
    finally:
        os._exit(code)
