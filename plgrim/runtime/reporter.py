"""Tells the others, as `supervisor/report`, which services have failed, are late, or cannot write their journals."""

from __future__ import annotations

import time
from collections.abc import Mapping

import zenoh

from plgrim.config import Config
from plgrim.logs import get_logger
from plgrim.runtime.children import ROUTER, Child
from plgrim.runtime.clock import MissionClock
from plgrim.runtime.keeper import next_epoch
from plgrim.runtime.mailbox import Outbox
from plgrim.runtime.zenoh_session import Link
from schemas.contract import SECOND_NS, Output, Stamp
from schemas.operation import SupervisorReport
from schemas.topics import SUPERVISOR

_TEXT = 1000


class Reporter:
    """Publishes once a second, and at once when something has changed."""

    def __init__(self, link: Link, config: Config) -> None:
        self._link = link
        self._clock = MissionClock.of(config.clock, config.runtime.state_dir)
        epoch = next_epoch(config.runtime, config.robot, "supervisor", time.time_ns() // 1_000_000)
        self._outbox = Outbox(config.robot, "supervisor", epoch)
        self._told: SupervisorReport | None = None
        self._due_s = 0.0

    def tell(self, children: Mapping[str, Child], flagged: Mapping[str, float]) -> None:
        """Publish the report when it is due."""
        now = time.monotonic()
        message = report(self._clock.now_ns(), children, flagged)
        same = (
            self._told is not None
            and message.model_copy(update={"stamp_ns": self._told.stamp_ns}) == self._told
        )
        if same and now < self._due_s:
            return
        self._told, self._due_s = message, now + SUPERVISOR.period_ns / SECOND_NS
        try:
            self._link.publish(
                SUPERVISOR, self._outbox.pack(Output(SUPERVISOR, message), message.stamp_ns, {})
            )
        except (zenoh.ZError, ValueError) as error:
            get_logger().warning("report not sent", error=str(error)[:200])


def report(now: Stamp, children: Mapping[str, Child], flagged: Mapping[str, float]) -> SupervisorReport:
    """The message. flagged: services that make no steps."""
    services = [child for name, child in children.items() if name != ROUTER]
    working = [child for child in services if not child.failed]
    return SupervisorReport(
        stamp_ns=now,
        failed={child.name: child.failed[:_TEXT] for child in services if child.failed},
        starting=[child.name for child in working if child.process is None or not child.ready],
        late=[child.name for child in working if child.name in flagged],
        restarts={name: child.restarted for name, child in children.items() if child.restarted},
        degraded={c.name: c.health.degraded for c in working if c.health is not None and c.health.degraded},
    )
