"""`plgrim link`: the process between the robot's router and the base's."""

from __future__ import annotations

from typing import Annotated

import typer

from plgrim.commands.options import ConfigFile


def link(
    config_file: ConfigFile = None,
    base: Annotated[
        str | None, typer.Option(help="The base's router, as tls/base:7447 (default: link.endpoint).")
    ] = None,
) -> None:
    """Run the link to the base station, on the robot, until Ctrl-C."""
    from plgrim.commands.options import put
    from plgrim.config import load_config
    from plgrim.link.process import run_link
    from plgrim.logs import configure_logs
    from plgrim.runtime.process import die_with_parent, stop_on_signals

    die_with_parent()
    configure_logs("link")
    overrides: dict[str, object] = {}
    put(overrides, "link.endpoint", base)
    put(overrides, "link.host", None if base is None else "robot")
    config = load_config(config_file, overrides)
    with stop_on_signals() as stop:
        run_link(config, stop)


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(link)
