"""What every live service shares, stage or not: session, one instance only, heartbeat, answer to health checks."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from types import TracebackType

import zenoh

from plgrim.config import Config
from plgrim.errors import AlreadyRunningError
from plgrim.logs import get_logger
from plgrim.runtime.clock import MissionClock
from plgrim.runtime.health import HealthMonitor, Heartbeat, query_key, token_key
from plgrim.runtime.keeper import next_epoch
from plgrim.runtime.mailbox import Outbox
from plgrim.runtime.pulse import Pulse
from plgrim.runtime.watchdog import Watchdog
from plgrim.runtime.zenoh_session import Link, connect
from plgrim.security.exposure import check_client
from schemas.contract import Output, Stamp
from schemas.operation import StageHealth
from schemas.topics import health_topic


class LiveService:
    """A service's life on the wire; a context manager.

    mailbox_report, knows: what was refused and is missing, and the newest message of each input, for the heartbeat
    (called from its thread). epoch: wall-clock ms at the start; it grows from life to life. Where a service has an
    instance at the base and one on the robot, each writes keys of its own (`LinkConfig.instance`). Raises
    NoRouterError, AlreadyRunningError.
    """

    def __init__(
        self, name: str, config: Config, stop: threading.Event, monitor: HealthMonitor | None = None
    ) -> None:
        self.name = name
        self.config = config
        self.clock = MissionClock.of(config.clock, config.runtime.state_dir)
        self.epoch = next_epoch(config.runtime, config.robot, name, time.time_ns() // 1_000_000)
        self.monitor = monitor or HealthMonitor(name, pulse=Pulse.of_environment())
        self.mailbox_report: Callable[[Stamp], tuple[dict[str, int], list[str]]] = lambda _: ({}, [])
        self.knows: Callable[[], dict[str, tuple[int, int]]] = dict
        check_client(config, name)
        self.link: Link = connect(config.router, config.robot, stop, config.runtime.router_timeout_s, name)
        self._outbox = Outbox(config.robot, name, self.epoch)
        self._last = b""
        self.link.instance = config.link.instance(name)
        self._path = f"{self.link.instance}/{name}".lstrip("/")
        try:
            self._refuse_second_instance()
            self.link.answer(query_key(config.robot, self._path), self._answer)
        except BaseException:
            self.link.close()
            raise
        pulse = self.monitor.pulse
        ends_after_s = config.runtime.stuck_after_s if config.runtime.watchdog else 0.0
        self._watchdog = None if pulse.supervised else Watchdog(pulse, ends_after_s)
        self._heartbeat = Heartbeat(config.runtime.health_period_s, self._beat)

    def __enter__(self) -> LiveService:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._heartbeat.stop()
        if self._watchdog is not None:
            self._watchdog.stop()
        self.link.close()

    def _refuse_second_instance(self) -> None:
        """Look for another one before and after declaring a token.

        Whoever finds one that was there first gives way; of two that start at the same moment the smaller key stays.
        No clock decides this: one that was set back must not make the newcomer the older one.
        """
        robot = self.config.robot
        everyone = token_key(robot, self._path, "*")
        for attempt in range(2):  # the token of a process that was just killed may live for a moment
            others = self.link.tokens(everyone)
            if not others:
                break
            if attempt == 0:
                time.sleep(0.5)
        else:
            raise self._already_running(others[0])
        mine = token_key(robot, self._path, f"{time.time_ns():020d}-{os.getpid()}")
        self.link.token(mine)
        earlier = [key for key in self.link.tokens(everyone) if key < mine]
        if earlier:
            raise self._already_running(earlier[0])

    def _already_running(self, key: str) -> AlreadyRunningError:
        pid = key.rpartition("-")[2]
        return AlreadyRunningError(
            f"{self.name} of robot {self.config.robot!r} is already running (process {pid}) at this router: stop it "
            "first, or give this one another robot name with PLGRIM_ROBOT"
        )

    def health(self) -> StageHealth:
        """The health message of this moment."""
        now = self.clock.now_ns()
        dropped, waiting_for = self.mailbox_report(now)
        return self.monitor.report(now, dropped, waiting_for)

    def _beat(self) -> None:
        self.monitor.pulse.beat()
        if self._watchdog is not None:
            self._watchdog.beat(self.monitor.ready)
        topic = health_topic(self.name)
        try:
            self._last = self._outbox.pack(Output(topic, self.health()), self.clock.now_ns(), self.knows())
            self.link.publish(topic, self._last)
        except (zenoh.ZError, ValueError) as error:
            get_logger().warning("heartbeat failed", error=str(error))

    def _answer(self) -> bytes:
        return self._last
