"""`plgrim run SERVICE` and `plgrim router`: one process of the system."""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from plgrim.commands.options import ConfigFile


def run(
    service: Annotated[str, typer.Argument(help="riskmap, irm, gcp, lcp, reconciler, mission, sim, status")],
    config_file: ConfigFile = None,
) -> None:
    """Run one service in this process until Ctrl-C."""
    from plgrim.registry import STAGES
    from plgrim.runtime.process import die_with_parent, stop_on_signals

    die_with_parent()
    if service not in (*STAGES, "status"):
        raise typer.BadParameter(f"no service {service!r}; there are {', '.join((*STAGES, 'status'))}")
    with stop_on_signals() as stop:
        _run(service, config_file, stop)
    _leave()


def _run(service: str, config_file: Path | None, stop: threading.Event) -> None:
    from plgrim.config import load_config
    from plgrim.logs import configure_logs

    configure_logs(service)
    config = load_config(config_file)
    if service == "status":
        from plgrim.runtime.status_service import run_status

        run_status(config, stop)
    else:
        from plgrim.runtime.live import run_stage

        run_stage(service, config, stop)


def spare() -> None:
    """Be the supervisor's spare: load everything, then wait to be told which service to become."""
    from plgrim.logs import configure_logs
    from plgrim.runtime.process import Interrupted, die_with_parent, interruptible, stop_on_signals
    from plgrim.runtime.spare import wait_for_order, warm_up

    die_with_parent()
    configure_logs("spare")
    with stop_on_signals() as stop:
        try:
            with interruptible(stop):
                warm_up()
        except Interrupted:
            _leave()
        service = wait_for_order(stop)
        if service is not None:
            _run(service, None, stop)
    _leave()


def _leave() -> None:
    """End at once, all being closed: taking apart what numba has compiled can keep a busy machine for seconds."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def router(
    config_file: ConfigFile = None,
    listen: Annotated[
        str | None, typer.Option(help="Endpoint, as tcp/127.0.0.1:7457 (default: router.endpoint).")
    ] = None,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print its configuration, for a stock zenohd too, and end.")
    ] = False,
) -> None:
    """Run the Zenoh router of this host until Ctrl-C."""
    from plgrim.commands.options import put
    from plgrim.config import load_config
    from plgrim.logs import configure_logs
    from plgrim.runtime.process import die_with_parent, stop_on_signals
    from plgrim.runtime.router import router_settings, run_router

    die_with_parent()
    configure_logs("router")
    overrides: dict[str, object] = {}
    put(overrides, "router.endpoint", listen)
    config = load_config(config_file, overrides)
    if print_config:
        print(json.dumps(router_settings(config), indent=2))
        return
    with stop_on_signals() as stop:
        run_router(config, stop)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(run)
    app.command()(router)
    app.command(hidden=True)(spare)
