"""A child process of the supervisor: how it is started, what is known of it, and how it is ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from plgrim.config import environment_overrides
from plgrim.logs import get_logger
from plgrim.runtime.process import child_environment
from plgrim.runtime.pulse import VARIABLE, clear_pulse
from schemas.operation import StageHealth
from schemas.topics import LINK

ROUTER = "router"
SPARE = "spare"
Command = Callable[[str], list[str]]


def plgrim_command(service: str) -> list[str]:
    """The command line of a child."""
    return [
        sys.executable,
        "-m",
        "plgrim",
        *([service] if service in (ROUTER, LINK, SPARE) else ["run", service]),
    ]


@dataclass(slots=True)
class Child:
    """One process: how it is, and when it was restarted (monotonic seconds).

    failures: ends in a row of which each came soon after the start. ready_s: since when this very process is ready.
    failed: why it is not started any more; empty while it is.
    """

    name: str
    log: Path
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    restart_at_s: float | None = None
    restarts: deque[float] = field(default_factory=deque)
    restarted: int = 0
    failures: int = 0
    health: StageHealth | None = None
    heard_s: float = 0.0
    ready_s: float | None = None
    failed: str = ""

    @property
    def ready(self) -> bool:
        """Whether this very process has said that it is ready."""
        return bool(
            self.process and self.health and self.health.ready and self.health.pid == self.process.pid
        )

    def tail(self, lines: int = 12) -> str:
        """The last lines of its log."""
        try:
            return "\n".join(self.log.read_text(encoding="utf-8", errors="replace").splitlines()[-lines:])
        except OSError:
            return ""


def environment_of(config_file: Path, pulse: Path | None) -> dict[str, str]:
    """The environment of a child, which reads its whole configuration from a file."""
    environment = child_environment(os.environ)
    for variable in environment_overrides(os.environ):  # they are in the file, under the command line's
        environment.pop(variable, None)
    environment["PLGRIM_CONFIG"] = str(config_file)
    environment.pop(VARIABLE, None)
    if pulse is not None:
        environment[VARIABLE] = str(pulse)
    return environment


def new_pulse(path: Path) -> Path | None:
    """An empty pulse for a new process; None, logged, when the disk takes none."""
    try:
        clear_pulse(path)
    except OSError as error:
        get_logger().warning("no pulse", file=str(path), error=str(error))
        return None
    return path


def spawn(
    command: list[str], log: Path, environment: Mapping[str, str], stdin: int
) -> subprocess.Popen[bytes]:
    """A process in a session of its own, which writes to `log`; to nowhere when the disk takes no more."""
    try:
        output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    except OSError as error:
        get_logger().warning("no log", file=str(log), error=str(error))
        output = os.open(os.devnull, os.O_WRONLY)
    try:
        return subprocess.Popen(
            command,
            stdin=stdin,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=dict(environment),
            start_new_session=True,
        )
    finally:
        os.close(output)


def end(children: list[Child], grace_s: float) -> None:
    """Ask them to end, wait, and kill what does not end in time."""
    running = {child.name: child.process for child in children if child.process}
    for process in running.values():
        if process.poll() is None:
            process.terminate()
    deadline = time.monotonic() + grace_s
    for name, process in running.items():
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            get_logger().warning("did not end in time: killed", child=name)
        signal_group(process, signal.SIGKILL)  # also what it may have started
        process.wait()
    for child in children:
        child.process = None


def signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Signal the process group that the child leads (`start_new_session`)."""
    try:
        os.killpg(process.pid, number)
    except (ProcessLookupError, PermissionError):
        return
