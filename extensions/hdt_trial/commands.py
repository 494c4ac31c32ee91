"""Commands of a shadow trial: start, seal, outcomes, verify, stamp and page."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from hdt_core.loading import read_text
from pipelines.cli.base import AsJson, HomeDir, StopError, app, err, home_folder, out

trial = typer.Typer(no_args_is_help=True, help="Record each night tamper-evidently and evaluate it.")
app.add_typer(trial, name="trial")


@trial.command("start")
def start_trial(
    home: HomeDir = None,
    declaration: Annotated[
        Path | None, typer.Option(help="TOML with the definitions, costs and rules; else the default.")
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Print the default declaration and start nothing.")] = False,
) -> None:
    """Freeze version, settings, thresholds and definitions.

    From then on each night's alerts and prognoses are sealed by `hdt nightly`.
    """
    from hdt_trial.declaration import DEFAULT
    from hdt_trial.seal import start

    if show:
        out.print(DEFAULT, markup=False, soft_wrap=True, end="")
        return
    with _one_writer(home) as where:
        entry = start(where, read_text(declaration) if declaration else DEFAULT)
    out.print(f"Trial started. Store this digest outside your organisation: {entry.digest}", soft_wrap=True)


@trial.command("seal")
def seal_trial(home: HomeDir = None) -> None:
    """Seal the current alerts and prognoses.

    `hdt nightly` does so by itself, at its end.
    """
    from hdt_trial.log import entries
    from hdt_trial.seal import declaration_of, log_folder, seal_night

    with _one_writer(home) as where:
        declaration_of(entries(log_folder(where)))
        entry = seal_night(where)
    out.print(
        f"Entry {entry.number} sealed: {entry.digest}" if entry else "The trial's nights are over; nothing was sealed."
    )


@trial.command("outcomes")
def take_outcomes(
    file: Annotated[Path, typer.Argument(help="CSV: operator, tail, pack, component, at, kind, finding, reference.")],
    home: HomeDir = None,
) -> None:
    """Seal outcomes missing from the logs: shop findings, removals, messages.

    Kind is MESSAGE, REPLACED or INSPECTED.
    """
    from hdt_trial.outcomes import seal_outcomes

    with _one_writer(home) as where:
        entry = seal_outcomes(where, file)
    out.print(f"{len(entry.body['rows'])} outcomes in entry {entry.number}: {entry.digest}", soft_wrap=True)


@trial.command("stamp")
def stamp_trial(home: HomeDir = None) -> None:
    """Write a request for an RFC 3161 time stamp of the last entry.

    Store the reply beside it; `hdt trial verify --authority` checks it.
    """
    from hdt_trial.log import entries, stamp_request
    from hdt_trial.seal import log_folder

    with _one_line():
        folder = log_folder(home_folder(home))
        if not (log := entries(folder)):
            raise StopError("no trial was started here; `hdt trial start` does")
        target = stamp_request(folder, log[-1])
    out.print(f"{target}; store the authority's reply beside it as {target.with_suffix('.tsr').name}", soft_wrap=True)


@trial.command("verify")
def verify_trial(
    home: HomeDir = None,
    digest: Annotated[
        list[str] | None,
        typer.Option(help="Digest printed earlier and stored elsewhere; may be repeated."),
    ] = None,
    head: Annotated[str | None, typer.Option(help="Digest printed last; the log must end with it.")] = None,
    authority: Annotated[Path | None, typer.Option(help="Certificate of the time stamps' authority, PEM.")] = None,
) -> None:
    """Verify that no sealed entry was changed, added or removed.

    Exit code 1 if one was. A log that was replaced as a whole is detected only with a digest stored elsewhere.
    """
    from hdt_trial.log import entries, faults, stamp_faults, stamps
    from hdt_trial.seal import log_folder

    with _one_line():
        folder = log_folder(home_folder(home))
        problems = list(faults(folder, digest or (), head))
        if not problems and authority:
            problems = stamp_faults(folder, entries(folder), authority)
    for fault in problems:
        err.print(f"FAULT: {fault}", markup=False, soft_wrap=True)
    if problems:
        raise typer.Exit(1)
    log = entries(folder)
    outside = [e.number for e in log if e.digest in [d.lower() for d in (*(digest or ()), head or "")]]
    outside += [int(s.stem) for s in stamps(folder)] if authority else []
    proof = (
        f"up to entry {max(outside)} by digests stored elsewhere"
        if outside
        else "by no digest stored elsewhere: give --digest"
    )
    out.print(f"{len(log)} entries, none changed, added or removed; proved {proof}.", soft_wrap=True)


@trial.command("page")
def write_page(
    target: Annotated[Path, typer.Option("--out", help="HTML file to write.")],
    home: HomeDir = None,
    as_json: AsJson = False,
) -> None:
    """Write the summary page, which names no aircraft.

    With --json the same numbers are printed as well.
    """
    from hdt_trial.evaluation import evaluate
    from hdt_trial.log import faults
    from hdt_trial.page import page
    from hdt_trial.seal import log_folder
    from pipelines.storage.files import replacing

    with _one_line():
        where = home_folder(home)
        if fault := next(faults(log_folder(where)), None):
            raise StopError(f"{fault}; no page is written from an altered log")
        evaluation = evaluate(where)
        with replacing(target.resolve()) as temporary:
            temporary.write_text(page(evaluation), "utf-8")
    if as_json:
        out.print_json(json.dumps(evaluation.as_json()))
    else:
        out.print(f"{evaluation.nights} nights, {evaluation.flights:,} flights: {target}", soft_wrap=True)


@app.command()
def dossier(
    target: Annotated[Path, typer.Option("--out", help="HTML file to write.")],
    home: HomeDir = None,
    attach: Annotated[list[Path] | None, typer.Option(help="Text file to append in full; may be repeated.")] = None,
) -> None:
    """Write a certification dossier of the prognostic model.

    Data lineage, limits, validation, configuration, changes and known failures, as one offline page. It names aircraft.
    """
    from hdt_trial.dossier import write_dossier
    from pipelines.storage.files import replacing

    with _one_line():
        html = write_dossier(home_folder(home), attach or ())
        with replacing(target.resolve()) as temporary:
            temporary.write_text(html, "utf-8")
    out.print(f"Dossier: {target}", soft_wrap=True)


@contextmanager
def _one_writer(home: Path | None) -> Iterator[Path]:
    """Yield the home with its lock held, so that no night seals meanwhile."""
    from pipelines.orchestration.around_night import lock_home

    where = home_folder(home)
    with _one_line(), lock_home(where):
        yield where


@contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except FileExistsError as error:
        raise StopError(str(error)) from None
    except UnicodeDecodeError as error:
        raise StopError(f"the file is no text in UTF-8: {error}") from None
