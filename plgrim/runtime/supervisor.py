"""Starts the router and the services as processes, restarts what crashes, and ends all of it in order.

Children are new processes (never forks: Zenoh does not survive one) in sessions of their own, so that Ctrl-C reaches
the supervisor alone; the kernel kills them when the supervisor dies. Each writes its log into the run folder. A stage
that lives but makes no steps is flagged by its pulse, then killed and replaced; one that cannot be kept alive is
FAILED, and the reconciler, which hears of it, holds the robot.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

from plgrim.config import Config, write_config
from plgrim.errors import FATAL_EXIT_CODES, PlgrimError, ServiceFailedError
from plgrim.logs import get_logger
from plgrim.runtime.children import (
    ROUTER,
    Child,
    Command,
    end,
    environment_of,
    new_pulse,
    plgrim_command,
    signal_group,
    spawn,
)
from plgrim.runtime.clock import MissionClock
from plgrim.runtime.pulse import VARIABLE
from plgrim.runtime.reporter import Reporter
from plgrim.runtime.router import check_endpoint_free
from plgrim.runtime.run_folder import ClockFile, lock_run_folder, with_fresh_state
from plgrim.runtime.spare import Spare
from plgrim.runtime.watch import Watch
from plgrim.runtime.zenoh_session import Link, connect
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import Topic
from schemas.errors import MessageError
from schemas.operation import StageHealth
from schemas.topics import SERVICES, SUPERVISOR, health_topic

_LAST, _LAST_AFTER_S = "status", 10.0
"""Started when all others are ready, or so much later: the robot drives without its page, and cores are few."""
_SPARE_AFTER_S = 5.0
"""A spare warms up when all have been ready for so long: not while their first plans need the cores."""
_LONGEST_ROUND_S = 1.0
"""Between two polls; more, and the supervisor was stopped, or starved."""

__all__ = ["ROUTER", "Child", "Command", "Supervisor", "plgrim_command", "with_fresh_state"]


class Supervisor:
    """Runs the router and services; a context manager that ends them all, whatever happens.

    run_folder: gets `config.yaml` (what the children read), `logs/`, and `state/` (their journals, kept until the
    mission has ended: `finished`). resume: go on with the state that the configuration names. Call `poll` often. Raises
    AlreadyRunningError when another supervisor is at work in the folder.
    """

    def __init__(
        self,
        config: Config,
        run_folder: Path,
        services: tuple[str, ...] = SERVICES,
        command: Command = plgrim_command,
        resume: bool = False,
    ) -> None:
        self._lock_file = lock_run_folder(run_folder)  # before anything of another run is emptied
        self.config = config if resume else with_fresh_state(config, run_folder)
        self._folder = run_folder
        self._command = command
        self._log = get_logger()
        self._lock = threading.Lock()
        self._all_were_ready = False
        self.finished = False
        """Whether the mission has come to its end, and nobody will go on with its state. Set by who follows it."""
        self.link: Link | None = None
        logs = run_folder / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        self.children = {name: Child(name, logs / f"{name}.log") for name in (ROUTER, *services)}
        for child in self.children.values():
            child.log.unlink(missing_ok=True)
        self.watch = Watch(run_folder / "pulse", (ROUTER, *services))
        self._polled_s = time.monotonic()
        self._whole_s: float | None = None
        self._clock_file = ClockFile(Path(self.config.runtime.state_dir))
        self._clock = MissionClock.of(self.config.clock, self.config.runtime.state_dir)
        environment = environment_of(run_folder / "config.yaml", None)
        with_spare = self.config.runtime.spare and command is plgrim_command
        self._spare = Spare(command, logs, environment) if with_spare else None
        self._reporter: Reporter | None = None

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown()
        if kind is None and self.finished:
            shutil.rmtree(self.config.runtime.state_dir, ignore_errors=True)
        self._lock_file.close()

    def start(self) -> Link:
        """Start the router, connect to it, start the services. Raises PortTakenError, NoRouterError."""
        check_endpoint_free(self.config.router.endpoint)
        write_config(self.config, self._folder / "config.yaml")
        self._spawn(self.children[ROUTER])
        self._start_services()  # now: they load their modules while the router opens
        try:
            self.link = connect(
                self.config.router, self.config.robot, threading.Event(), 15.0, SUPERVISOR.writer
            )
        except PlgrimError:
            self._check_fatal(self.children[ROUTER])
            raise
        self._reporter = Reporter(self.link, self.config)
        for child in self._services():
            instance = self.config.link.instance(child.name)
            self.link.subscribe(health_topic(child.name), self._hear, instance=instance)
        self.watch.start()
        return self.link

    def _start_services(self) -> None:
        later = _LAST if len(self._services()) > 1 else ""
        for child in self._services():
            if child.name == later:
                child.restart_at_s = time.monotonic() + _LAST_AFTER_S
            else:
                self._spawn(child)

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
                self._all_were_ready = True
                return True
            if time.monotonic() > deadline:
                raise ServiceFailedError(
                    f"not ready after {self.config.runtime.start_timeout_s:.0f} s: {', '.join(missing)}; "
                    f"their logs are in {self._folder / 'logs'}"
                )
        return False

    def poll(self) -> None:
        """One round: restart what has ended, is silent or makes no steps; tell of it; warm up a spare.

        Raises ServiceFailedError when the router cannot be kept alive, or a service before all were ready once, or
        `runtime.hold_failed_s` after a service has FAILED.
        """
        now = time.monotonic()
        self._excuse(now)
        waiting = self.waiting_for()
        for child in self.children.values():
            if child.process is None:
                due = child.restart_at_s is not None and now >= child.restart_at_s
                if due or (waiting == [_LAST] == [child.name] and not child.restarts and not child.failed):
                    self._spawn(child)
            elif child.process.poll() is not None:
                self._ended(child, now)
            else:
                self._look_after(child, child.process, now)
        self._clock_file.write(self._clock.now_ns())
        if self._reporter is not None:
            self._reporter.tell(self.children, self.watch.flagged())
        if waiting:
            self._whole_s = None
        elif self._whole_s is None:
            self._whole_s = now
        if self._spare is not None and self._whole_s is not None and now - self._whole_s >= _SPARE_AFTER_S:
            self._spare.keep()
        self._give_up_if_held_long(now)

    def _excuse(self, now: float) -> None:
        """While the supervisor itself stood still it heard nobody: that is nobody's silence."""
        missed_s, self._polled_s = now - self._polled_s - _LONGEST_ROUND_S, now
        if missed_s <= 0.0:
            return
        with self._lock:
            for child in self.children.values():
                child.heard_s += missed_s
                child.started_s += missed_s

    def _look_after(self, child: Child, process: subprocess.Popen[bytes], now: float) -> None:
        why = self._sick(child, process, now)
        if why:
            self._log.error("killed", child=child.name, why=why)
            signal_group(process, signal.SIGKILL)

    def _sick(self, child: Child, process: subprocess.Popen[bytes], now: float) -> str:
        """Why a child that lives must be replaced; empty when it need not."""
        runtime = self.config.runtime
        silent_s = self.watch.silent_s(child.name, process.pid)
        if silent_s > runtime.silent_after_s:
            return f"no heartbeat for {silent_s:.1f} s"
        late_s = self.watch.late_s(child.name, process.pid)
        if late_s > runtime.stuck_after_s:
            return f"no step for {late_s:.1f} s"
        if self._is_unheard(child, now):
            return f"no word of its health for {now - child.heard_s:.0f} s"
        return ""

    def _is_unheard(self, child: Child, now: float) -> bool:
        if child.name == ROUTER:  # it says nothing on the wire
            return False
        with self._lock:
            heard = child.health is not None and child.process and child.health.pid == child.process.pid
            since = child.heard_s if heard else child.started_s
        limit = self.config.runtime.unresponsive_after_s
        return now - since > (limit if heard else max(limit, self.config.runtime.start_timeout_s))

    def _spawn(self, child: Child) -> None:
        pulse = new_pulse(self._folder / "pulse" / child.name)
        child.restart_at_s, child.ready_s = None, None
        child.started_s = time.monotonic()
        changes = {VARIABLE: str(pulse or "")}
        taken = (
            self._spare.take(child.name, child.log, changes) if self._spare and child.name != ROUTER else None
        )
        child.process = taken or spawn(
            self._command(child.name),
            child.log,
            environment_of(self._folder / "config.yaml", pulse),
            subprocess.DEVNULL,
        )

    def _ended(self, child: Child, now: float) -> None:
        if self._check_fatal(child):
            return
        code = child.process.returncode if child.process else None
        runtime = self.config.runtime
        child.process = None
        while child.restarts and now - child.restarts[0] > runtime.restart_window_s:
            child.restarts.popleft()
        if len(child.restarts) >= runtime.restarts:
            self._fail(
                child,
                f"{child.name} ended with {code} after {len(child.restarts)} restarts within "
                f"{runtime.restart_window_s:.0f} s. The end of {child.log}:\n{child.tail()}",
            )
            return
        # What ran well for a while does not fail at its start: no reason to keep the robot waiting for it.
        since = child.started_s if child.name == ROUTER else child.ready_s
        stable = since is not None and now - since >= runtime.stable_after_s
        child.failures = 0 if stable else child.failures + 1
        wait = min(10.0, runtime.backoff_s * 2 ** (child.failures - 1)) if child.failures else 0.0
        child.restarts.append(now)
        child.restarted += 1
        child.restart_at_s = now + wait
        self._log.warning("service ended: restarting", child=child.name, code=code, in_s=wait)

    def _check_fatal(self, child: Child) -> bool:
        """Whether it has ended with a fault that a restart cannot mend; it is FAILED then."""
        code = child.process.poll() if child.process else None
        if code not in FATAL_EXIT_CODES:
            return False
        child.process = None
        self._fail(child, f"{child.name} cannot run:\n{child.tail()}")
        return True

    def _fail(self, child: Child, why: str) -> None:
        """FAILED: not started again, and the robot holds. Raises ServiceFailedError where that is no way to go on."""
        if child.name == ROUTER or not self._all_were_ready:
            raise ServiceFailedError(why)
        child.failed, child.ready_s = why, time.monotonic()
        self._log.error("FAILED: the robot holds", child=child.name, why=why)

    @property
    def spare_warm(self) -> bool:
        """Whether the next service that dies comes back from a warm spare; True where none is kept."""
        return self._spare is None or self._spare.warm

    def failed(self) -> dict[str, str]:
        """The services that are not started any more, and why."""
        return {child.name: child.failed for child in self._services() if child.failed}

    def _give_up_if_held_long(self, now: float) -> None:
        limit = self.config.runtime.hold_failed_s
        for child in self._services():
            if child.failed and limit and child.ready_s is not None and now - child.ready_s > limit:
                raise ServiceFailedError(child.failed)

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
        self.watch.stop()
        if self._spare is not None:
            self._spare.close()
        end(list(reversed(self._services())), grace)
        if self.link is not None:
            self.link.close()
            self.link = None
        end([self.children[ROUTER]], grace)
