"""One connection from the robot to the base's router: a session, the thread that sends on it, and what it receives.

The thread alone puts on this session, and may block there as long as the link does: nothing on the robot waits for it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import zenoh
from zenoh import ext

from plgrim.config import Config, RouterConfig
from plgrim.errors import NoRouterError
from plgrim.link.budget import Bucket, Meter
from plgrim.link.lanes import Lane, Parcel
from plgrim.link.routes import COMMANDS, MAPS, down, lane_of, needs_every
from plgrim.logs import Seldom, get_logger
from plgrim.runtime.zenoh_session import Link, is_latched, open_session
from schemas.base import Message
from schemas.compact import compact
from schemas.contract import SECOND_NS, Topic
from schemas.topics import GLOBAL_IRM, LINK
from schemas.world import GlobalIrm

_LOOK_S = 0.1
_TRY_S = 10.0
_UNHEARD_NS = 5 * SECOND_NS
"""So long what must not be lost waits for a reader: after a cut the base's router tells of its readers again."""
Arrived = Callable[[str, Topic[Message], bytes], None]
Wanted = list[tuple[str, Topic[Message]]]


class Meters(NamedTuple):
    """Bytes from robot to base (down) and from base to robot (up)."""

    down: Meter
    up: Meter


def base_router(config: Config, lane: str) -> RouterConfig:
    """How this lane's session reaches the base: as the robot's own router is reached, TLS included, elsewhere."""
    link = config.link
    endpoint = link.endpoint
    if lane == MAPS:  # a deep buffer of maps in the kernel would delay whatever shares the link
        endpoint += f"{';' if '#' in endpoint else '#'}so_sndbuf={link.send_buffer_bytes}"
    update = {"endpoint": endpoint, "connect": "", "shared_memory": False, "lease_ms": link.lease_ms}
    return config.router.model_copy(update=update)


def make_lane(config: Config, name: str) -> Lane:
    """An empty lane with the budgets of the configuration."""
    link = config.link
    topics = [topic for topic in down(link) if lane_of(topic) == name]
    rate = link.commands_kb_per_s if name == COMMANDS else link.maps_kb_per_s
    return Lane(
        Bucket(1000 * rate),
        {t.name: Bucket(1000 * link.topic_kb_per_s[t.name]) for t in topics if t.name in link.topic_kb_per_s},
        frozenset(t.name for t in topics if needs_every(t, link)),
        frozenset({GLOBAL_IRM.name}),
        int(1000 * link.queue_kb),
    )


class Uplink:
    """A lane with its session. wanted: (instance, topic) that come from the base on this session."""

    def __init__(self, name: str, config: Config, wanted: Wanted, arrived: Arrived, meters: Meters) -> None:
        self.name = name
        self.connected = False
        self._config = config
        self._wanted = wanted
        self._arrived = arrived
        self._meters = meters
        self._lane = make_lane(config, name)
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._unsent = Seldom()
        self._unheard_ns: dict[str, int] = {}
        self._publishers: dict[str, zenoh.Publisher | ext.AdvancedPublisher] = {}
        self._thread = threading.Thread(target=self._run, name=f"uplink {name}", daemon=True)

    def start(self) -> None:
        """Begin to dial the base; never waits for it."""
        self._thread.start()

    def stop(self, timeout_s: float = 8.0) -> None:
        """End the thread and close the session."""
        self._stop.set()
        with self._changed:
            self._changed.notify()
        self._thread.join(timeout_s)

    def offer(self, topic: Topic[Message], payload: bytes, message: Message) -> None:
        """Hand over a message for the base; never waits. message: what the payload says."""
        whole = isinstance(message, GlobalIrm) and message.base_version == 0
        with self._changed:
            self._lane.offer(Parcel(topic, payload, whole))
            self._changed.notify()

    def counts(self) -> tuple[float, dict[str, int]]:
        """(kB that wait, what was given up by `topic:reason`)."""
        with self._changed:
            lost = {f"{name}:link_queue_full": n for name, n in self._lane.dropped.items() if n}
            return self._lane.waiting_bytes / 1000, lost

    def _run(self) -> None:
        session = self._open()
        if session is None:
            return
        with Link(session, self._config.robot) as link:
            for instance, topic in self._wanted:
                receive = self._receiver(instance)
                link.subscribe(topic, receive, instance=instance, recover=False)
            while not self._stop.is_set():
                self.connected = bool(list(session.info.routers_zid()))
                parcel = self._next() if self.connected else None
                if parcel is not None:
                    self._send(session, parcel)
                elif not self.connected:
                    self._unheard_ns.clear()
                    self._stop.wait(_LOOK_S)
            self.connected = False

    def _open(self) -> zenoh.Session | None:
        router = base_router(self._config, self.name)
        while not self._stop.is_set():
            try:
                return open_session(router, "client", self._stop, _TRY_S, LINK)
            except NoRouterError:
                if not self._stop.is_set():
                    get_logger().warning("the base does not answer", endpoint=router.endpoint, lane=self.name)
        return None

    def _receiver(self, instance: str) -> Callable[[Topic[Message], bytes], None]:
        def receive(topic: Topic[Message], payload: bytes) -> None:
            key = f"{instance}/{topic.name}" if instance else topic.name
            self._meters.up.count(key, len(payload), time.monotonic_ns())
            self._arrived(instance, topic, payload)

        return receive

    def _next(self) -> Parcel | None:
        """The next message, waiting for it a moment; what nobody at the base listens to is left out."""
        with self._changed:
            parcel, wait_ns = self._lane.take(time.monotonic_ns())
            if parcel is None:
                self._changed.wait(_LOOK_S if wait_ns < 0 else min(_LOOK_S, wait_ns / 1e9))
            return parcel

    def _send(self, session: zenoh.Session, parcel: Parcel) -> None:
        topic = parcel.topic
        try:
            publisher = self._publishers.get(topic.name) or self._declare(session, topic)
            if isinstance(publisher, zenoh.Publisher) and not _is_heard(publisher):
                self._nobody_listens(parcel)
                return
            self._unheard_ns.pop(topic.name, None)
            small = compact(parcel.payload)
            publisher.put(small)
        except Exception as error:  # whatever is wrong with one message: the lane goes on with the next
            self._note_unsent(topic, error)
            return
        now_ns = time.monotonic_ns()
        with self._changed:
            self._lane.spent(topic.name, len(small), now_ns)
        self._meters.down.count(topic.name, len(small), now_ns)

    def _nobody_listens(self, parcel: Parcel) -> None:
        """What must not be lost waits for a reader a while, then it is counted; other things nobody misses."""
        name, now_ns = parcel.topic.name, time.monotonic_ns()
        with self._changed:
            if name not in self._lane.every or name in self._lane.differences:
                return
            if now_ns - self._unheard_ns.setdefault(name, now_ns) < _UNHEARD_NS:
                self._lane.put_back(parcel, now_ns + int(_LOOK_S * SECOND_NS))
            else:
                self._lane.dropped[name] += 1

    def _note_unsent(self, topic: Topic[Message], error: Exception) -> None:
        with self._changed:
            self._lane.dropped[topic.name] += 1
        if more := self._unsent.more(topic.name):
            get_logger().warning(
                "not sent to the base", topic=topic.name, error=repr(error)[:200], times=more
            )

    def _declare(
        self, session: zenoh.Session, topic: Topic[Message]
    ) -> zenoh.Publisher | ext.AdvancedPublisher:
        """BLOCK: this thread waits for the link, so that the lane and not Zenoh chooses what is given up."""
        key = topic.key(self._config.robot)
        block, priority = zenoh.CongestionControl.BLOCK, zenoh.Priority.DATA
        made: zenoh.Publisher | ext.AdvancedPublisher
        if is_latched(topic):
            made = ext.declare_advanced_publisher(
                session,
                key,
                cache=ext.CacheConfig(max_samples=1),
                publisher_detection=True,
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                congestion_control=block,
                priority=priority,
            )
        else:
            made = session.declare_publisher(
                key, congestion_control=block, priority=priority, express=self.name == COMMANDS
            )
        self._publishers[topic.name] = made
        return made


def _is_heard(publisher: zenoh.Publisher) -> bool:
    """Whether anybody subscribes. The stubs call this a bool; it is an object, and always true."""
    status: Any = publisher.matching_status
    return bool(status.matching)
