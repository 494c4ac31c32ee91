"""The `hdt` command in this process: what a terminal would show of it, without a second of imports."""

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from subprocess import CompletedProcess
from unittest.mock import patch

from pipelines.cli import main


def command_line(*words: object) -> list[str]:
    """The command for a process of its own."""
    return [sys.executable, "-c", "from pipelines.cli import main; main()", *map(str, words)]


def hdt(*words: object) -> CompletedProcess[str]:
    """Run a command: its exit code and what it printed."""
    code = 0
    command = ["hdt", *map(str, words)]
    with (
        patch.object(sys, "argv", command),
        redirect_stdout(io.StringIO()) as out,
        redirect_stderr(io.StringIO()) as err,
    ):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return CompletedProcess(command, code, out.getvalue(), err.getvalue())
