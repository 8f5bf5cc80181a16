"""Routers in threads, and sessions with a certificate."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil

from plgrim.config import Config, RouterConfig
from plgrim.deployment import Role
from plgrim.link.config import LinkConfig
from plgrim.runtime.router import run_router
from plgrim.runtime.zenoh_session import Link, connect
from tests.runtime.helpers import eventually


def free_port() -> int:
    """A loopback port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def secured(robot: str, certificates: Path, role: Role = "all", **router: Any) -> Config:
    """A configuration whose router listens with TLS on a free loopback port."""
    settings = {"endpoint": f"tls/127.0.0.1:{free_port()}", "certificates": str(certificates), **router}
    host = LinkConfig.model_validate({"host": "" if role == "all" else role})
    return Config(robot=robot, router=RouterConfig.model_validate(settings), link=host)


def listens(port: int) -> bool:
    """Whether this very process listens on a port."""
    return any(
        c.status == psutil.CONN_LISTEN and c.laddr.port == port
        for c in psutil.Process().net_connections("tcp")
    )


@contextmanager
def routing(config: Config) -> Iterator[None]:
    """A router in a thread of this process, listening."""
    stop = threading.Event()
    thread = threading.Thread(target=run_router, args=(config, stop))
    thread.start()
    try:
        for endpoint in (config.router.endpoint, *config.router.listen):
            port = int(endpoint.rpartition(":")[2])
            eventually(lambda port=port: listens(port), f"the router listens on {port}")  # type: ignore[misc]
        yield
    finally:
        stop.set()
        thread.join()


def joined(config: Config, process: str, timeout_s: float = 20.0) -> Link:
    """A session as a process. Raises NoRouterError."""
    return connect(config.router, config.robot, threading.Event(), timeout_s, process)
