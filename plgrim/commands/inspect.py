"""`plgrim status`, `healthcheck`, `topics`: how a system is, and what is on the wire."""

from __future__ import annotations

import json
import os
import sys
import threading
import urllib.error
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from plgrim.commands.options import ConfigFile

if TYPE_CHECKING:
    from plgrim.config import Config


def status(
    url: Annotated[str | None, typer.Option(help="Of the status service, as http://127.0.0.1:8080.")] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(help="File with a token, where reading needs one; default: status.tokens_file."),
    ] = None,
    config_file: ConfigFile = None,
) -> None:
    """Print the status of a running mission as JSON."""
    from plgrim.config import load_config
    from plgrim.errors import PlgrimError
    from plgrim.missions import status_page
    from plgrim.status_client import get_json, own_secret, secret_of, tls_context

    if url is not None and not url.startswith(("http://", "https://")):
        raise typer.BadParameter(f"--url: {url!r} is no address: give one as http://127.0.0.1:8080")
    config = load_config(config_file)
    address = (url or status_page(config)).rstrip("/")
    try:
        # A token of this host's own service goes to no other address.
        secret = secret_of(token_file) if token_file else "" if url else own_secret(config)
        context = None if url else tls_context(config)
        answer = json.dumps(get_json(f"{address}/api/v1/status", context, secret), indent=2)
    except (OSError, ValueError) as error:
        raise PlgrimError(
            f"no status at {address}: {error}; is the mission running (`plgrim up`)?"
        ) from error
    _print(answer)


def _print(text: str) -> None:
    """Print; a reader that has seen enough (`plgrim status | head`) is no error."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains when it ends


def healthcheck(
    service: Annotated[str, typer.Argument(help="A service, link, recorder, or router.")],
    config_file: ConfigFile = None,
    timeout: Annotated[float, typer.Option(help="Wall seconds.")] = 3.0,
) -> None:
    """Ask a running service end to end whether it makes progress; exit 0 when it does."""
    from plgrim.config import load_config
    from plgrim.security.access import RECORDER
    from schemas.topics import LINK, SERVICES

    known = (*SERVICES, LINK, RECORDER, "router")
    if service not in known:
        raise typer.BadParameter(f"no service {service!r}; there are {', '.join(known)}")
    config = load_config(config_file)
    try:
        reason = _status_trouble(config) if service == "status" else _trouble(config, service, timeout)
    except (OSError, ValueError) as error:
        reason = str(error)
    print(f"{service}: {reason or 'healthy'}")
    sys.exit(1 if reason else 0)


def _status_trouble(config: Config) -> str:
    from plgrim.missions import status_page
    from plgrim.status_client import StatusRefusedError, get_json, tls_context

    try:
        get_json(f"{status_page(config)}healthz", tls_context(config))
    except urllib.error.HTTPError as error:
        return f"answers {error.code}"
    except StatusRefusedError as error:
        return str(error)
    return ""


def _trouble(config: Config, service: str, timeout_s: float) -> str:
    """Why a service is not healthy, or nothing."""
    from plgrim.errors import NoRouterError
    from plgrim.recording.session import recorder_instance
    from plgrim.runtime.health import ask_health
    from plgrim.runtime.zenoh_session import connect
    from plgrim.security.access import RECORDER
    from plgrim.security.exposure import check_client

    check_client(config)
    try:
        with connect(config.router, config.robot, threading.Event(), timeout_s) as link:
            if service == "router":
                return ""
            own = recorder_instance(config) if service == RECORDER else config.link.instance(service)
            health = ask_health(link, service, timeout_s, own)
    except NoRouterError as error:
        return str(error)
    if health is None:
        return "does not answer"
    return "" if health.ready else f"not ready: {health.last_error or 'starting'}"


def topics() -> None:
    """Print the table of topics as Markdown."""
    print(topic_table())


def topic_table() -> str:
    """The table of topics as Markdown; derived from schemas/topics.py."""
    from schemas.topics import TOPICS

    rows = ["| topic | message | read by | period | queue | at most | stale after | link | what |"]
    rows.append("|-|-|-|-|-|-|-|-|-|")
    for topic in TOPICS:
        cells = [
            f"`{topic.name}`",
            topic.message.__name__,
            " ".join(topic.readers) or "the result",
            _span(topic.period_ns) or "on events",
            "all" if topic.keep_all else "latest",
            f"{topic.max_bytes // 1024} KiB",
            _span(topic.stale_after_ns) or "never",
            "yes" if topic.crosses_link else "no",
            topic.says,
        ]
        rows.append(f"| {' | '.join(cells)} |")
    rows.append(
        "| `<service>/health` | StageHealth | status | 0.5 s | latest | 16 KiB | 3 s | yes | health of each service |"
    )
    return "\n".join(rows)


def _span(span_ns: int) -> str:
    return f"{span_ns / 1e9:g} s" if span_ns else ""


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    for command in (status, healthcheck, topics):
        app.command()(command)
