"""The Zenoh router of a host: a Python process with a session in router mode (a stock zenohd does as well)."""

from __future__ import annotations

import os
import socket
import threading
from typing import Any

import zenoh

from plgrim.config import Config
from plgrim.errors import PlgrimError, PortTakenError
from plgrim.hosts import SECURE, host_and_port, protocol
from plgrim.logs import get_logger
from plgrim.runtime.pulse import Pulse
from plgrim.runtime.zenoh_session import many_receivers, open_config, session_config
from plgrim.security.access import ROUTER, every_topic
from plgrim.security.exposure import check_router
from plgrim.security.policy import router_access

_LOOK_S = 0.5
"""Between two looks at the certificates, and two beats of the pulse for the supervisor."""
_MAX_SESSIONS = 128
_FRAMING_BYTES = 1024 * 1024


def check_port_free(host: str, port: int, mend: str) -> None:
    """Raise PortTakenError when somebody listens there. mend: what the user can do, for the text."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise PortTakenError(
                f"port {port} on {host} cannot be used ({error.strerror}): {mend}"
            ) from error


def check_endpoint_free(endpoint: str) -> None:
    """Raise PortTakenError when another program, such as another router, listens on the endpoint."""
    place = host_and_port(endpoint)
    if place is not None:
        check_port_free(
            *place,
            "is another router running? Stop it, or choose another port with router.endpoint in the configuration "
            "or PLGRIM_ROUTER=tcp/127.0.0.1:PORT",
        )


def page_address(host: str, port: int, secure: bool = False) -> str:
    """Address of the page as a person on this host opens it, wherever it listens. secure: it serves HTTPS."""
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1"
    place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    return f"{'https' if secure else 'http'}://{place}/"


def router_settings(config: Config) -> dict[str, Any]:
    """Zenoh's configuration of this host's router; as JSON5 also that of a stock zenohd. Raises ConfigError."""
    check_router(config)
    settings = session_config(config.router, "router", ROUTER)
    settings["transport"]["unicast"]["max_sessions"] = _MAX_SESSIONS
    settings["transport"]["link"]["rx"] = {"max_message_size": largest_message_bytes()}
    endpoints = [config.router.endpoint, *config.router.listen]
    if any(protocol(endpoint) in SECURE for endpoint in endpoints):
        settings["access_control"] = router_access(config)
    return settings


def largest_message_bytes() -> int:
    """More than any message on the wire has."""
    return max(topic.max_bytes for topic in every_topic()) + _FRAMING_BYTES


def run_router(config: Config, stop: threading.Event) -> None:
    """Route until `stop` is set; open anew when the certificates on the disk change.

    Raises ConfigError, PortTakenError.
    """
    settings = router_settings(config)
    many_receivers()
    endpoints = [config.router.endpoint, *config.router.listen]
    for endpoint in endpoints:
        check_endpoint_free(endpoint)
    pulse = Pulse.of_environment()
    while not stop.is_set():
        seen = _certificates_seen(settings)
        session = _open(config, settings, stop)
        get_logger().info("router listens", endpoints=endpoints, access_control="access_control" in settings)
        try:
            pulse.expect(_LOOK_S)
            while not stop.wait(_LOOK_S) and seen == _certificates_seen(settings):
                pulse.beat()
                pulse.stepped()
        finally:
            session.close()  # type: ignore[no-untyped-call]
        if not stop.is_set():
            get_logger().info("the certificates have changed: all connections begin anew")


def _open(config: Config, settings: dict[str, Any], stop: threading.Event) -> zenoh.Session:
    try:
        return open_config(settings, config.router, stop, 0.0)
    except zenoh.ZError as error:
        places = ", ".join([config.router.endpoint, *config.router.listen])
        if "in use" in str(error):
            raise PortTakenError(f"{places} is taken: choose another with PLGRIM_ROUTER") from error
        raise PlgrimError(f"the router cannot listen on {places}: {str(error)[:300]}") from error


def _certificates_seen(settings: dict[str, Any]) -> list[tuple[int, int]]:
    """Changes when somebody writes the certificate, the key or the trusted issuers."""
    tls = settings["transport"]["link"].get("tls", {})
    seen = []
    for value in tls.values():
        try:
            status = os.stat(value) if isinstance(value, str) else None
        except OSError:
            continue
        if status is not None:
            seen.append((status.st_ino, status.st_mtime_ns))
    return seen
