"""A router of its own for each test, on a port of its own, and processes that never outlive their test."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from plgrim.config import Config, RouterConfig, RuntimeConfig, load_config
from plgrim.runtime.process import child_environment
from plgrim.runtime.router import run_router
from plgrim.runtime.zenoh_session import Link, connect
from tests.runtime.helpers import REPOSITORY, Start


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("PLGRIM_")]:
        if name not in ("PLGRIM_CACHE_DIR", "PLGRIM_DATA_DIR"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture
def free_port() -> int:
    """A loopback port that nobody listens on."""
    return _free_port()


@pytest.fixture
def endpoint() -> str:
    """A loopback endpoint whose port is free."""
    return f"tcp/127.0.0.1:{_free_port()}"


@pytest.fixture
def config(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Config:
    """A configuration for this test alone; child processes get it from the environment."""
    monkeypatch.setenv("PLGRIM_ROUTER", endpoint)
    monkeypatch.setenv("PLGRIM_RUNTIME__HEALTH_PERIOD_S", "0.1")
    monkeypatch.setenv("PLGRIM_RUNTIME__ROUTER_TIMEOUT_S", "20")
    monkeypatch.setenv("PLGRIM_RUNTIME__BACKOFF_S", "0.05")
    monkeypatch.setenv("PLGRIM_RUNTIME__RESTARTS", "2")
    monkeypatch.setenv("PLGRIM_RUNTIME__MAX_CONSECUTIVE_ERRORS", "3")
    loaded = load_config()
    assert isinstance(loaded.router, RouterConfig)
    assert isinstance(loaded.runtime, RuntimeConfig)
    return loaded


@pytest.fixture
def router(config: Config) -> Iterator[None]:
    """A router in a thread of this process."""
    stop = threading.Event()
    thread = threading.Thread(target=run_router, args=(config, stop))
    thread.start()
    yield
    stop.set()
    thread.join()


@pytest.fixture
def link(config: Config, router: None) -> Iterator[Link]:
    """A client of the test's router."""
    with connect(config.router, config.robot, threading.Event(), 20.0) as connected:
        yield connected


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a process, by arguments of `python`; killed with its group at the end of the test."""
    processes: list[subprocess.Popen[str]] = []

    def run(*arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=REPOSITORY,
            env=child_environment(os.environ),  # the kernel ends it when this process is killed
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        processes.append(process)
        return process

    yield run
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stdout:
            process.stdout.close()
