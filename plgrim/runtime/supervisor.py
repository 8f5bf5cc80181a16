"""Starts the router and the services as processes, restarts what crashes, and ends all of it in order.

Children are new processes (never forks: Zenoh does not survive one) in sessions of their own, so that Ctrl-C reaches
the supervisor alone; the kernel kills them when the supervisor dies. Each writes its log into the run folder.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from plgrim.config import Config, environment_overrides, write_config
from plgrim.errors import FATAL_EXIT_CODES, PlgrimError, ServiceFailedError
from plgrim.logs import get_logger
from plgrim.runtime.process import child_environment
from plgrim.runtime.router import check_endpoint_free
from plgrim.runtime.zenoh_session import Link, connect
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import Topic
from schemas.errors import MessageError
from schemas.operation import StageHealth
from schemas.topics import LINK, SERVICES, health_topic

ROUTER = "router"
Command = Callable[[str], list[str]]


def plgrim_command(service: str) -> list[str]:
    """The command line of a child."""
    return [sys.executable, "-m", "plgrim", *([service] if service in (ROUTER, LINK) else ["run", service])]


@dataclass(slots=True)
class Child:
    """One process: how it is, and when it was restarted (monotonic seconds).

    failures: ends in a row of which each came soon after the start. ready_s: since when this very process is ready.
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


def with_fresh_state(config: Config, run_folder: Path) -> Config:
    """The configuration with an empty folder for the journals of this run: a new mission knows nothing of the last.

    `state` in the run folder, which is emptied; where the user names a folder, a new one inside.
    """
    if config.runtime.state_dir:
        state = Path(config.runtime.state_dir) / f"{time.strftime('%Y%m%dT%H%M%S')}-{os.getpid()}"
    else:
        state = run_folder / "state"
        shutil.rmtree(state, ignore_errors=True)
    runtime = config.runtime.model_copy(update={"state_dir": str(state.resolve())})
    return config.model_copy(update={"runtime": runtime})


class Supervisor:
    """Runs the router and services; a context manager that ends them all, whatever happens.

    run_folder: gets `config.yaml` (what the children read), `logs/`, and `state/` (their journals, kept only when the
    run fails). Call `poll` often; it raises ServiceFailedError when a service cannot be kept alive.
    """

    def __init__(
        self,
        config: Config,
        run_folder: Path,
        services: tuple[str, ...] = SERVICES,
        command: Command = plgrim_command,
    ) -> None:
        self.config = with_fresh_state(config, run_folder)
        self._folder = run_folder
        self._command = command
        self._log = get_logger()
        self._lock = threading.Lock()
        self.link: Link | None = None
        logs = run_folder / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        self.children = {name: Child(name, logs / f"{name}.log") for name in (ROUTER, *services)}
        for child in self.children.values():
            child.log.unlink(missing_ok=True)

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown()
        if kind is None:
            shutil.rmtree(self.config.runtime.state_dir, ignore_errors=True)

    def start(self) -> Link:
        """Start the router, connect to it, start the services. Raises PortTakenError, NoRouterError."""
        check_endpoint_free(self.config.router.endpoint)
        write_config(self.config, self._folder / "config.yaml")
        self._spawn(self.children[ROUTER])
        try:
            self.link = connect(self.config.router, self.config.robot, threading.Event(), 15.0)
        except PlgrimError:
            self._check_fatal(self.children[ROUTER])
            raise
        for child in self._services():
            instance = self.config.link.instance(child.name)
            self.link.subscribe(health_topic(child.name), self._hear, instance=instance)
            self._spawn(child)
        return self.link

    def _services(self) -> list[Child]:
        return [child for child in self.children.values() if child.name != ROUTER]

    def waiting_for(self) -> list[str]:
        """The services that are not ready."""
        with self._lock:
            return [child.name for child in self._services() if not child.ready]

    def wait_ready(self, stop: threading.Event, progress: Callable[[list[str]], None] | None = None) -> bool:
        """Wait until all services are ready; False when `stop` came first. Raises ServiceFailedError."""
        deadline = time.monotonic() + self.config.runtime.start_timeout_s
        while not stop.wait(0.1):
            self.poll()
            missing = self.waiting_for()
            if progress is not None:
                progress(missing)
            if not missing:
                return True
            if time.monotonic() > deadline:
                raise ServiceFailedError(
                    f"not ready after {self.config.runtime.start_timeout_s:.0f} s: {', '.join(missing)}; "
                    f"their logs are in {self._folder / 'logs'}"
                )
        return False

    def poll(self) -> None:
        """One round: restart what has ended or no longer gives a sign of health."""
        now = time.monotonic()
        for child in self.children.values():
            if child.process is None:
                if child.restart_at_s is not None and now >= child.restart_at_s:
                    self._spawn(child)
            elif child.process.poll() is not None:
                self._ended(child, now)
            elif child.name != ROUTER and self._is_silent(child, now):
                self._log.error(
                    "no sign of health: killed", child=child.name, after_s=round(now - child.heard_s)
                )
                _signal_group(child.process, signal.SIGKILL)

    def _is_silent(self, child: Child, now: float) -> bool:
        with self._lock:
            heard = child.health is not None and child.process and child.health.pid == child.process.pid
            since = child.heard_s if heard else child.started_s
        limit = self.config.runtime.unresponsive_after_s
        return now - since > (limit if heard else max(limit, self.config.runtime.start_timeout_s))

    def _spawn(self, child: Child) -> None:
        environment = child_environment(os.environ)
        for variable in environment_overrides(
            os.environ
        ):  # they are in config.yaml, under the command line's
            environment.pop(variable, None)
        environment["PLGRIM_CONFIG"] = str(self._folder / "config.yaml")
        child.restart_at_s, child.ready_s = None, None
        child.started_s = time.monotonic()
        with child.log.open("ab") as log:
            child.process = subprocess.Popen(
                self._command(child.name),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )

    def _ended(self, child: Child, now: float) -> None:
        self._check_fatal(child)
        code = child.process.returncode if child.process else None
        runtime = self.config.runtime
        child.process = None
        while child.restarts and now - child.restarts[0] > runtime.restart_window_s:
            child.restarts.popleft()
        if len(child.restarts) >= runtime.restarts:
            raise ServiceFailedError(
                f"{child.name} ended with {code} after {len(child.restarts)} restarts within "
                f"{runtime.restart_window_s:.0f} s. The end of {child.log}:\n{child.tail()}"
            )
        # What ran well for a while does not fail at its start: no reason to keep the robot waiting for it.
        since = child.started_s if child.name == ROUTER else child.ready_s
        stable = since is not None and now - since >= runtime.stable_after_s
        child.failures = 0 if stable else child.failures + 1
        wait = min(10.0, runtime.backoff_s * 2 ** (child.failures - 1)) if child.failures else 0.0
        child.restarts.append(now)
        child.restarted += 1
        child.restart_at_s = now + wait
        self._log.warning("service ended: restarting", child=child.name, code=code, in_s=wait)

    def _check_fatal(self, child: Child) -> None:
        code = child.process.poll() if child.process else None
        if code in FATAL_EXIT_CODES:
            child.process = None
            raise ServiceFailedError(f"{child.name} cannot run:\n{child.tail()}")

    def _hear(self, topic: Topic[Message], payload: bytes) -> None:
        try:
            message, _ = decode(payload, topic.message, topic.max_bytes)
        except MessageError as error:
            self._log.warning("health message refused", reason=str(error))
            return
        if isinstance(message, StageHealth) and message.service in self.children:
            with self._lock:
                child = self.children[message.service]
                child.health, child.heard_s = message, time.monotonic()
                if child.ready_s is None and child.ready:
                    child.ready_s = child.heard_s

    def shutdown(self) -> None:
        """End the services, last started first, then the router; kill what does not end in time."""
        grace = self.config.runtime.stop_timeout_s
        _end(list(reversed(self._services())), grace)
        if self.link is not None:
            self.link.close()
            self.link = None
        _end([self.children[ROUTER]], grace)


def _end(children: list[Child], grace_s: float) -> None:
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
        _signal_group(process, signal.SIGKILL)  # also what it may have started
        process.wait()
    for child in children:
        child.process = None


def _signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Signal the process group that the child leads (`start_new_session`)."""
    try:
        os.killpg(process.pid, number)
    except (ProcessLookupError, PermissionError):
        return
