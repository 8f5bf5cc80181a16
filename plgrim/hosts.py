"""Endpoints of Zenoh: which of them leave this host, and which are encrypted."""

from __future__ import annotations

from schemas.hosts import is_loopback

_TCP_LIKE = ("tcp", "tls", "ws", "quic", "udp")
SECURE = ("tls", "quic")
"""Protocols of endpoints that are encrypted, and authenticated on both sides."""


def protocol(endpoint: str) -> str:
    """Of an endpoint: `tls` of `tls/base:7447`."""
    return endpoint.partition("/")[0]


def host_and_port(endpoint: str) -> tuple[str, int] | None:
    """Host and port of a TCP-like endpoint (`tcp/127.0.0.1:7457`); None for others (unix sockets)."""
    kind, _, address = endpoint.partition("/")
    address = address.split("?")[0].split("#")[0]
    host, _, port = address.rpartition(":")
    if kind not in _TCP_LIKE or not port.isdigit():
        return None
    return host.strip("[]"), int(port)


def options(endpoint: str) -> list[str]:
    """Names of the options behind an endpoint: `enable_mtls` of `tls/base:7447#enable_mtls=false`."""
    _, _, given = endpoint.partition("#")
    return [one.partition("=")[0].strip() for one in given.split(";") if one.strip()]


def is_local(endpoint: str) -> bool:
    """Whether an endpoint stays on this host: loopback, or a unix socket."""
    place = host_and_port(endpoint)
    return protocol(endpoint) == "unixsock-stream" if place is None else is_loopback(place[0])
