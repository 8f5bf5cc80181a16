"""The Zenoh router of a host: a Python process with a session in router mode (a stock zenohd does as well)."""

from __future__ import annotations

import socket
import threading

import zenoh

from plgrim.config import RouterConfig
from plgrim.errors import PlgrimError, PortTakenError
from plgrim.logs import get_logger
from plgrim.runtime.zenoh_session import open_session


def host_and_port(endpoint: str) -> tuple[str, int] | None:
    """Host and port of a TCP-like endpoint (`tcp/127.0.0.1:7457`); None for others (unix sockets)."""
    protocol, _, address = endpoint.partition("/")
    address = address.split("?")[0].split("#")[0]
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls", "ws") or not port.isdigit():
        return None
    return host.strip("[]"), int(port)


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


def page_address(host: str, port: int) -> str:
    """Address of the page as a person on this host opens it, wherever it listens."""
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1"
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def run_router(config: RouterConfig, stop: threading.Event) -> None:
    """Route until `stop` is set. Raises PortTakenError."""
    check_endpoint_free(config.endpoint)
    try:
        session = open_session(config, "router", stop, 0.0)
    except zenoh.ZError as error:
        if "in use" in str(error):
            raise PortTakenError(f"{config.endpoint} is taken: choose another with PLGRIM_ROUTER") from error
        raise PlgrimError(f"the router cannot listen on {config.endpoint}: {str(error)[:300]}") from error
    get_logger().info("router listens", endpoint=config.endpoint)
    try:
        while not stop.wait(0.5):
            pass
    finally:
        session.close()  # type: ignore[no-untyped-call]
