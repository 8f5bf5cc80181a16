"""`plgrim foxglove`: a running system or a recording, live in Foxglove."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from plgrim.commands.options import ConfigFile


def foxglove(
    host: Annotated[
        str, typer.Option(help="Where to listen, on this host alone: there is no authentication.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the WebSocket.")] = 8765,
    recording: Annotated[
        Path | None, typer.Option(help="Show this recording instead of a running system.")
    ] = None,
    speed: Annotated[
        float, typer.Option(min=0.01, help="Of a recording: mission seconds a wall second.")
    ] = 1.0,
    config_file: ConfigFile = None,
) -> None:
    """Serve a running system, or a recording, to Foxglove until Ctrl-C (extra: foxglove)."""
    from plgrim.config import load_config
    from plgrim.logs import configure_logs
    from plgrim.recording.foxglove_view import FoxgloveServer, show_live, show_recording
    from plgrim.runtime.process import stop_on_signals
    from plgrim.security.exposure import check_listen

    configure_logs("foxglove")
    config = load_config(config_file)
    check_listen(host, config)
    server = FoxgloveServer(host, port)
    print(
        f"Foxglove: open connection ws://{host}:{server.port}, layout docs/foxglove_layout.json", flush=True
    )
    try:
        with stop_on_signals() as stop:
            if recording is None:
                show_live(config, server, stop)
            else:
                show_recording(recording, server, stop, speed, lambda text: print(text, file=sys.stderr))
    finally:
        server.close()


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(foxglove)
