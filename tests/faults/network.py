"""Two hosts on one machine: network namespaces joined by one link that can be slow, lossy, or cut.

Needs root and Linux; `require_network` skips visibly without. Rates by `tbf`, cuts and losses by iptables (`netem` is
missing in some kernels). The monotonic clock is the same on both, so that latencies can be measured across the link.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import psutil
import pytest

from plgrim.runtime.process import child_environment
from tests.runtime.helpers import REPOSITORY

ROBOT, BASE = "robot", "base"
BASE_ADDRESS = "10.77.0.2"
_ADDRESS = {ROBOT: "10.77.0.1", BASE: BASE_ADDRESS}


def _run(*command: str, check: bool = True) -> None:
    subprocess.run(command, check=check, capture_output=True, text=True, timeout=30)


def require_network() -> None:
    """Skip when this machine cannot make network namespaces."""
    if os.geteuid() != 0:
        pytest.skip("needs root for network namespaces")
    name = f"plgrim-probe-{os.getpid()}"
    try:
        _run("ip", "netns", "add", name)
        _run("ip", "netns", "exec", name, "iptables", "-L", "-n")
        _run("ip", "netns", "del", name)
    except (OSError, subprocess.SubprocessError) as error:
        pytest.skip(f"no network namespaces or iptables here: {error}")


def remove_left_behind() -> None:
    """Remove the namespaces of runs that were killed: no process with the id in their names is alive."""
    listed = subprocess.run(["ip", "netns", "list"], check=True, capture_output=True, text=True, timeout=30)
    for line in listed.stdout.splitlines():
        name = line.split()[0] if line.split() else ""
        found = re.fullmatch(r"plgrim-(?:probe-)?(\d+)(?:-\w+)?", name)
        if found is not None and not psutil.pid_exists(int(found[1])):
            _run("ip", "netns", "del", name, check=False)


class Network:
    """The two hosts; a context manager that kills what runs on them and removes them."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._spaces = {host: f"plgrim-{os.getpid()}-{host}" for host in (ROBOT, BASE)}
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Network:
        remove_left_behind()
        for host, space in self._spaces.items():
            _run("ip", "netns", "add", space)
            self.on(host, "ip", "link", "set", "lo", "up")
        robot, base = self._spaces[ROBOT], self._spaces[BASE]
        _run(
            "ip",
            "link",
            "add",
            "radio",
            "netns",
            robot,
            "type",
            "veth",
            "peer",
            "name",
            "radio",
            "netns",
            base,
        )
        for host, address in _ADDRESS.items():
            self.on(host, "ip", "address", "add", f"{address}/24", "dev", "radio")
            self.on(host, "ip", "link", "set", "radio", "up")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGTERM)
        for process in self._processes:
            try:
                process.wait(15.0)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        for space in self._spaces.values():
            _run("ip", "netns", "del", space, check=False)

    def address(self, host: str) -> str:
        """The host's address on the link."""
        return _ADDRESS[host]

    def command(self, host: str, *command: str) -> list[str]:
        """A command line that runs on a host."""
        return ["ip", "netns", "exec", self._spaces[host], *command]

    def on(self, host: str, *command: str, check: bool = True) -> None:
        """Run a command on a host to its end."""
        _run(*self.command(host, *command), check=check)

    def start(self, host: str, environment: Mapping[str, str], *arguments: str) -> subprocess.Popen[bytes]:
        """Start a Python program on a host; its output goes to a log of its own."""
        log = self._logs / f"{host}-{len(self._processes)}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                self.command(host, sys.executable, *arguments),
                cwd=REPOSITORY,
                env={**child_environment({**os.environ, **environment}), "PYTHONPATH": str(REPOSITORY)},
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._processes.append(process)
        return process

    def rate(self, mbit_per_s: float) -> None:
        """Let the link carry so much each way, with a queue of 0.4 s as radios have."""
        for host in self._spaces:
            self.on(
                host, "tc", "qdisc", "replace", "dev", "radio", "root", "tbf", "rate", f"{mbit_per_s}mbit",
                "burst", "16kb", "latency", "400ms",
            )  # fmt: skip

    def cut(self) -> None:
        """Nothing comes through any more, and nobody is told."""
        for host in self._spaces:
            self.on(host, "iptables", "-I", "INPUT", "-i", "radio", "-j", "DROP")

    def join(self) -> None:
        """End a cut."""
        for host in self._spaces:
            self.on(host, "iptables", "-D", "INPUT", "-i", "radio", "-j", "DROP")

    def lose(self, share: float) -> None:
        """Lose this share of the packets each way, at random, from now on."""
        for host in self._spaces:
            self.on(
                host, "iptables", "-A", "INPUT", "-i", "radio", "-m", "statistic", "--mode", "random",
                "--probability", f"{share}", "-j", "DROP",
            )  # fmt: skip


@contextmanager
def cut_off(network: Network) -> Iterator[None]:
    """A cut for as long as the block lasts."""
    network.cut()
    try:
        yield
    finally:
        network.join()
