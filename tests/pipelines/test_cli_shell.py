"""What the shell sees of the command: help to choose from, completion, and what this installation can do."""

import importlib.metadata

import pytest
from typer.testing import CliRunner

from pipelines.cli import load_extensions
from pipelines.cli.base import ORDER, app


def hdt(*words: str, **env: str) -> str:
    done = CliRunner().invoke(app, list(words), env=env, prog_name="hdt")
    assert done.exit_code == 0, done.output
    return done.output


def test_help_lists_every_command_in_order_and_cuts_no_sentence():
    load_extensions()
    listed = hdt("--help", COLUMNS="80").partition("Commands:")[2]
    names = [line.split()[0] for line in listed.strip().splitlines()]
    assert names == [*ORDER, *sorted(set(names) - set(ORDER))]
    groups = {g.name for g in app.registered_groups}
    assert {c.name or c.callback.__name__ for c in app.registered_commands} | groups == set(names)
    assert "..." not in listed


def test_it_says_its_version():
    assert hdt("--version").strip() == importlib.metadata.version("hybrid-digital-twin")


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("hdt ni", ["nightly"]),
        ("hdt b", ["backfill", "benchmark"]),
        ("hdt nightly --dry", ["--dry-run"]),
        ("hdt report --o", ["--out"]),
    ],
)
def test_the_shell_completes_commands_and_options(typed, offered):
    place = str(len(typed.split()) - 1)
    assert hdt(_HDT_COMPLETE="complete_bash", COMP_WORDS=typed, COMP_CWORD=place).split() == offered


@pytest.mark.parametrize(
    ("shell", "script"), [("bash", "complete -o default"), ("zsh", "compdef"), ("fish", "complete")]
)
def test_the_shell_is_told_how_to_complete(shell, script):
    assert script in hdt(_HDT_COMPLETE=f"source_{shell}")
