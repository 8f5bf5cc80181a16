"""The command line: `plgrim COMMAND`. Errors that the user can mend are one line and an exit code of their own."""

from __future__ import annotations

import sys

import typer

from plgrim.commands import evaluate, feed, inspect, missions, operator, services
from plgrim.errors import PlgrimError

application = typer.Typer(
    name="plgrim",
    help="Autonomous exploration of unknown environments: a mission, its services, and how they are.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)
for room in (missions, operator, services, feed, evaluate, inspect):
    room.register(application)


def app() -> None:
    """Entry point: runs the command; a PlgrimError becomes its text on standard error and its exit code."""
    try:
        application()
    except PlgrimError as error:
        print(f"plgrim: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
