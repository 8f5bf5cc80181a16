"""The command line teaches itself: an example under every `--help`, completion, errors that name the mend."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from plgrim import cli
from plgrim.cli import application
from plgrim.commands.examples import EXAMPLES
from plgrim.config import Config
from tests.runtime.helpers import REPOSITORY


def _commands(command: Any, words: str = "") -> Iterator[tuple[str, Any]]:
    for name, below in getattr(command, "commands", {}).items():
        if hasattr(below, "commands"):
            yield from _commands(below, f"{words} {name}".strip())
        elif not below.hidden:
            yield f"{words} {name}".strip(), below


COMMANDS = dict(_commands(typer.main.get_command(application)))


@pytest.mark.parametrize("words", sorted(COMMANDS))
def test_the_help_of_every_command_shows_an_example(words: str) -> None:
    output = CliRunner().invoke(application, [*words.split(), "--help"], env={"COLUMNS": "200"}).output
    assert "Example: plgrim " in output, f"plgrim {words}: add it to plgrim/commands/examples.py"


@pytest.mark.parametrize(
    ("words", "line"),
    [(words, line) for words, lines in EXAMPLES.items() for line in lines if words in COMMANDS],
)
def test_every_example_is_a_call_that_its_command_takes(words: str, line: str) -> None:
    program, *arguments = shlex.split(line)
    given = words.split()
    assert [program, *arguments[: len(given)]] == ["plgrim", *given]
    COMMANDS[words].make_context(words, arguments[len(given) :])  # raises a usage error


@pytest.mark.parametrize(("typed", "wanted"), [("plgrim repl", "replay"), ("plgrim evaluate t", "tour")])
def test_the_shell_completes_commands(typed: str, wanted: str) -> None:
    words = typed.split()
    environment = {**os.environ, "_PLGRIM_COMPLETE": "complete_bash", "COMP_WORDS": typed}
    environment["COMP_CWORD"] = str(len(words) - 1)
    command = [sys.executable, "-c", "import sys; sys.argv[0] = 'plgrim'; from plgrim.cli import app; app()"]
    answer = subprocess.run(
        command, env=environment, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=100
    )
    assert wanted in answer.stdout.split()


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["replay", "no/such"], ["no/such", "plgrim record"]),
        (["replay", "README.md"], ["README.md", "not an MCAP file"]),
        (["replay", "x.mcap", "--stages", "gpc"], ["no stage 'gpc'", "gcp"]),
        (["report", "no/such"], ["no/such", "result folder"]),
        (["report", "docs"], ["docs", "result.json", "plgrim record"]),
        (["record", "--out", "README.md"], ["README.md", "folder"]),
        (["explore", "--out", "README.md", "--world", "maze"], ["README.md", "folder"]),
        (["feed", "README.md"], ["README.md"]),
        (["feed", "no/such.g2o"], ["no/such.g2o"]),
        (["explore", "--seed", "x"], ["--seed"]),
        (["explore", "--start", "1"], ["--start"]),
        (["doctor", "--config", "no.yaml"], ["no.yaml"]),
        (["watch", "--config", "docs"], ["docs"]),
        (["explroe"], ["explroe", "explore"]),
        (["run", "gpc"], ["gpc", "gcp"]),
        (["healthcheck", "gpc"], ["gpc", "gcp"]),
        (["status", "--url", "nowhere"], ["nowhere", "http://"]),
        (["evaluate", "missions", "--world", "maze", "--seeds", "x"], ["seeds", "1-"]),
        (["evaluate", "tour", "--world", "nowhere"], ["nowhere", "maze"]),
    ],
)
def test_wrong_files_and_values_are_named_with_what_would_be_right(
    config: Config, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    arguments: list[str], texts: list[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(REPOSITORY)
    monkeypatch.setenv("PLGRIM_RUNTIME__START_TIMEOUT_S", "0.1")
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setattr("sys.argv", ["plgrim", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.app()
    captured = capsys.readouterr()
    said = captured.out + captured.err
    assert ended.value.code not in (0, None)
    assert "Traceback" not in said
    for text in texts:
        assert text in said, said
