"""Commands end in one line where the disk is full, and print on any terminal."""

import io
import json
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import pytest
from command import hdt
from nights import empty_home

from pipelines.cli import main
from pipelines.cli.night import print_ranking
from pipelines.report.words import wrap
from pipelines.storage.publication import publish


@contextmanager
def file_limit(limit: int) -> Iterator[None]:
    """Let no file of this process grow beyond a limit [bytes]."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def text_on_terminal(*words: str, encoding: str) -> str:
    """Return what a command prints on a terminal of an encoding."""
    terminal = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    with patch.object(sys, "argv", ["hdt", *words]), patch.object(sys, "stdout", terminal):
        with pytest.raises(SystemExit):
            main()
        terminal.flush()
    return terminal.buffer.getvalue().decode(encoding)


@pytest.mark.parametrize(
    ("form", "limit"), [("parquet", 10), ("csv", 10), ("duckdb", 100), ("duckdb", 50_000), ("duckdb", 500_000)]
)
def test_full_disk_ends_an_export(tmp_path, form, limit):
    empty_home(tmp_path / "home")

    with file_limit(limit):
        done = hdt("export", "--home", tmp_path / "home", "--format", form, "--out", tmp_path / "out")

    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_text_is_escaped_in_ascii(tmp_path):
    empty_home(tmp_path)

    text = text_on_terminal("query", "--home", str(tmp_path), "select 'é 😀' as name", encoding="ascii")

    assert r"| \u00e9 \ud83d\ude00" in text


@pytest.mark.parametrize("width", range(16, 24))
def test_no_line_begins_with_percent(width):
    lines = wrap("message 27 % by 2024-07-15", width, indent=4).splitlines()

    assert any("27 %" in line for line in lines)
    assert {line[:4] for line in lines} == {"    "}


def test_home_without_packs_prints_ranking(tmp_path, capsys):
    empty_home(tmp_path)
    publish(tmp_path)

    print_ranking(tmp_path)

    assert "flights left (90 %)" in capsys.readouterr().out


def test_json_stays_json_in_ascii(tmp_path):
    home = tmp_path / "é"
    empty_home(home)

    text = text_on_terminal("doctor", "--json", "--landing", str(tmp_path), "--home", str(home), encoding="ascii")

    assert any(str(home) in check["says"] for check in json.loads(text))
