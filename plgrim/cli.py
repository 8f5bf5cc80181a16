"""The command line: `plgrim COMMAND`. Errors that the user can mend are one line and an exit code of their own."""

from __future__ import annotations

import sys

import typer

from plgrim.commands import (
    certs,
    doctor,
    evaluate,
    feed,
    foxglove,
    inspect,
    link,
    missions,
    operator,
    record,
    report,
    services,
)
from plgrim.commands.examples import add_examples
from plgrim.errors import PlgrimError

application = typer.Typer(
    name="plgrim",
    help="Autonomous exploration of unknown environments: a mission, its services, and how they are.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
for room in (
    missions,
    operator,
    services,
    link,
    doctor,
    record,
    report,
    foxglove,
    feed,
    evaluate,
    inspect,
    certs,
):
    room.register(application)
add_examples(application)


def app() -> None:
    """Entry point: runs the command; a PlgrimError becomes its text on standard error and its exit code."""
    try:
        application()
    except PlgrimError as error:
        print(f"plgrim: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except (FileExistsError, NotADirectoryError, PermissionError) as error:
        if error.filename is None:
            raise
        mend = "it must be a folder that can be written: name another with --out"
        print(f"plgrim: {error.filename}: {error.strerror}: {mend}", file=sys.stderr)
        sys.exit(2)
