"""Build Dagster's page as an ASGI application, and the command of its daemon. Needs `dagster-webserver`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import dagster as dg
from dagster._core.workspace.context import WorkspaceProcessContext
from dagster._core.workspace.load_target import ModuleTarget
from dagster_webserver.app import create_app_from_workspace_process_context
from dagster_webserver.version import __version__
from starlette.types import ASGIApp


@contextmanager
def application(instance: dg.DagsterInstance, module: str, read_only: bool) -> Iterator[ASGIApp]:
    """Open the page over the definitions of a module."""
    target = ModuleTarget(module, attribute=None, working_directory=None, location_name=None)
    instance.optimize_for_webserver(statement_timeout=15_000, pool_recycle=3_600, max_overflow=20)
    with WorkspaceProcessContext(instance, target, version=__version__, read_only=read_only) as context:
        yield create_app_from_workspace_process_context(context)


def daemon_command(module: str) -> list[str]:
    """Build the command that runs schedules, sensors and queued runs of a module's definitions."""
    return [sys.executable, "-m", "dagster._daemon", "run", "-m", module]
