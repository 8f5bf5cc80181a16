"""The link process: it sits on the robot between the robot's router and the base's, and settles who is obeyed.

Threads: one a subscription (at either router), one a lane to send, this one to step leases and report.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter

import zenoh

from plgrim.config import Config
from plgrim.errors import ConfigError
from plgrim.link.arbiter import Arbiter, ToPublish, note_robot
from plgrim.link.budget import Meter
from plgrim.link.in_step import Seen
from plgrim.link.lease import STANDBY
from plgrim.link.relay import Relay
from plgrim.link.routes import LANES, down, lane_of, up_plain
from plgrim.link.uplink import Meters, Uplink, Wanted
from plgrim.logs import get_logger
from plgrim.runtime.mailbox import Mailbox, Outbox, SharedDecoder
from plgrim.runtime.service import LiveService
from plgrim.runtime.zenoh_session import many_receivers
from plgrim.security.exposure import check_link
from schemas.base import Message
from schemas.contract import SECOND_NS, Output, Stamp, Topic
from schemas.operation import LinkReport
from schemas.topics import LINK, LINK_REPORT

_TICK_S = 0.1
_MOST_UNSAID = 512
"""Messages for the robot that may wait; far more than come while a session stands still."""
_STEP_S = 0.5
"""What the supervisor is told: a busy machine may make it late, a stopped one is found all the same."""


def run_link(config: Config, stop: threading.Event) -> None:
    """Run the link until `stop`. Raises ConfigError, NoRouterError (the robot's own), AlreadyRunningError."""
    if not config.link.endpoint or config.link.host != "robot":
        raise ConfigError(
            "link: this host has no link: set link.host to robot and link.endpoint to the base's router, as "
            "tls/base:7447"
        )
    check_link(config)
    many_receivers()
    with LiveService(LINK, config, stop) as service:
        LinkProcess(service).run(stop)


class LinkProcess:
    """Both sides and the arbiters between them. Nothing on the robot's side ever waits for the base's."""

    def __init__(self, service: LiveService) -> None:
        self._service = service
        config = service.config
        self._link_config = config.link
        self._lock = threading.Lock()
        self._seen = Seen()
        self._arbiters = {
            name: Arbiter.of(name, config.robot, config.link, self._seen, service.epoch)
            for name in config.link.leased
        }
        silent_ns = config.link.ns("silent_after_s")
        self._relay = Relay(config.robot, tuple(up_plain(config.link)), service.epoch, silent_ns)
        self._sent_down = Mailbox(config.robot, tuple(down(config.link)))
        self._outbox = Outbox(config.robot, LINK, service.epoch)
        self._meters = Meters(Meter(), Meter())
        self._dropped: Counter[str] = Counter()
        self._unsaid: queue.Queue[tuple[Topic[Message], bytes] | None] = queue.Queue(_MOST_UNSAID)
        self._uplinks = {
            lane: Uplink(lane, config, self._wanted(lane), self._from_base, self._meters) for lane in LANES
        }

    def _wanted(self, lane: str) -> Wanted:
        plain = [("", topic) for topic in up_plain(self._link_config)]
        leased = [("base", topic) for arbiter in self._arbiters.values() for topic in arbiter.topics]
        return [(instance, topic) for instance, topic in (*plain, *leased) if lane_of(topic) == lane]

    def run(self, stop: threading.Event) -> None:
        """Subscribe, dial the base, and step until `stop`."""
        link = self._service.link
        for topic in down(self._link_config):
            link.subscribe(topic, self._from_robot)
        for arbiter in self._arbiters.values():
            for topic in arbiter.topics:
                link.declare(topic)
                link.subscribe(topic, self._from_standby, instance=STANDBY)
        self._service.mailbox_report = self._health_report
        self._service.monitor.expect(_STEP_S)
        self._service.monitor.ready = True
        get_logger().info("ready", base=self._link_config.endpoint, at_base=list(self._link_config.at_base))
        speaker = threading.Thread(target=self._speak, name="to the robot", daemon=True)
        speaker.start()
        for uplink in self._uplinks.values():
            uplink.start()
        try:
            self._step_until(stop)
        finally:
            self._say(None)
            for uplink in self._uplinks.values():
                uplink.stop()

    def _step_until(self, stop: threading.Event) -> None:
        report_ns = 0
        while not stop.wait(_TICK_S):
            monitor, now_ns = self._service.monitor, time.monotonic_ns()
            monitor.step_began()
            self._tick(now_ns)
            if now_ns - report_ns >= SECOND_NS:
                report_ns = now_ns
                self._publish_report(now_ns)
            monitor.step_ended()

    def _tick(self, now_ns: int) -> None:
        stamp = self._service.clock.now_ns()
        for arbiter in self._arbiters.values():
            with self._lock:
                before = arbiter.lease.holder
                self._publish(arbiter.tick(now_ns, stamp))
            if arbiter.lease.holder != before:
                self._tell(arbiter)

    def _tell(self, arbiter: Arbiter) -> None:
        lease = arbiter.lease
        get_logger().warning("lease granted", stage=arbiter.service, to=lease.holder, epoch=lease.epoch)

    def _from_robot(self, topic: Topic[Message], payload: bytes) -> None:
        """What crosses: noted, and handed to its lane. What no reader would take does not cross, and is counted."""
        now_ns, read = time.monotonic_ns(), SharedDecoder()
        with self._lock:
            accepted = self._sent_down.accept(topic, payload, now_ns, read)
            self._sent_down.stepped()
            if accepted:
                message, envelope = read(payload, topic.message, topic.max_bytes)
                note_robot(self._seen, topic, message, envelope, now_ns)
        if accepted:
            self._uplinks[lane_of(topic)].offer(topic, payload, message)

    def _from_standby(self, topic: Topic[Message], payload: bytes) -> None:
        self._arbitrate(STANDBY, topic, payload)

    def _from_base(self, instance: str, topic: Topic[Message], payload: bytes) -> None:
        if instance:
            self._arbitrate(instance, topic, payload)
            return
        with self._lock:  # as in `_arbitrate`: in the order of their sequence numbers
            sealed = self._relay.receive(topic, payload, time.monotonic_ns())
            if sealed is not None:
                self._publish([(topic, sealed)])

    def _arbitrate(self, instance: str, topic: Topic[Message], payload: bytes) -> None:
        arbiter = self._arbiters[topic.writer]
        stamp = self._service.clock.now_ns()
        with self._lock:  # handed over under the lock: in the order of their sequence numbers
            before = arbiter.lease.holder
            self._publish(arbiter.receive(instance, topic, payload, time.monotonic_ns(), stamp))
        if arbiter.lease.holder != before:
            self._tell(arbiter)

    def _publish(self, found: ToPublish) -> None:
        for topic, payload in found:
            if not self._say((topic, payload)):
                self._dropped[f"{topic.name}:not_sent"] += 1

    def _say(self, what: tuple[Topic[Message], bytes] | None) -> bool:
        try:
            self._unsaid.put_nowait(what)
        except queue.Full:
            return False
        return True

    def _speak(self) -> None:
        """Publish on the robot, in order. A thread of its own, without a lock: `put` waits while the router waits for
        this process to read, and who reads must not wait for `put`; else both stand still until one closes the session.
        """
        while (what := self._unsaid.get()) is not None:
            topic, payload = what
            try:
                self._service.link.publish(topic, payload)
            except zenoh.ZError as error:
                self._dropped[f"{topic.name}:not_sent"] += 1
                get_logger().warning("not sent", topic=topic.name, error=str(error)[:200])

    def _drops(self) -> dict[str, int]:
        found = Counter(self._dropped)
        with self._lock:
            for arbiter in self._arbiters.values():
                found.update(arbiter.dropped)
            found.update(self._relay.dropped)
            found.update(self._sent_down.dropped)
        for uplink in self._uplinks.values():
            found.update(uplink.counts()[1])
        return dict(sorted(found.items()))

    def _health_report(self, now: Stamp) -> tuple[dict[str, int], list[str]]:
        del now
        waiting = [] if all(uplink.connected for uplink in self._uplinks.values()) else ["base"]
        return self._drops(), waiting

    def report(self, now_ns: int) -> LinkReport:
        """How the link is. now_ns: local monotonic clock."""
        dropped = self._drops()
        arbiters = self._arbiters
        with self._lock:
            return LinkReport(
                stamp_ns=self._service.clock.now_ns(),
                connected=all(uplink.connected for uplink in self._uplinks.values()),
                holder={name: arbiter.lease.holder for name, arbiter in arbiters.items()},
                lease={name: arbiter.lease.epoch for name, arbiter in arbiters.items()},
                takeovers=sum(arbiter.lease.takeovers for arbiter in arbiters.values()),
                hand_backs=sum(arbiter.lease.hand_backs for arbiter in arbiters.values()),
                down_kb_per_s=self._meters.down.kb_per_s(now_ns),
                up_kb_per_s=self._meters.up.kb_per_s(now_ns),
                queued_kb={lane: round(uplink.counts()[0], 3) for lane, uplink in self._uplinks.items()},
                base_age_s={name: round(a.base_age_s(now_ns), 3) for name, a in arbiters.items()},
                dropped=dropped,
            )

    def _publish_report(self, now_ns: int) -> None:
        output = Output(LINK_REPORT, self.report(now_ns))
        self._publish([(LINK_REPORT, self._outbox.pack(output, self._service.clock.now_ns(), {}))])
