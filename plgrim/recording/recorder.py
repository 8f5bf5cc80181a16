"""The recorder: one more client of the router, which writes down every message of a robot.

Threads: one a subscription, which only queue the bytes; one that decodes, translates and writes. What the disk or the
processor cannot keep up with is lost to the recording, counted, and never felt by the robot: publishers drop.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from plgrim.logs import get_logger
from plgrim.recording.envelope import Raw
from plgrim.recording.well_known import Translator
from plgrim.recording.writer import Ring
from plgrim.registry import STAGES
from plgrim.runtime.step_log import snapshot_query_key
from plgrim.runtime.zenoh_session import Link
from schemas.base import Message
from schemas.codec import Envelope, decode
from schemas.contract import Topic
from schemas.errors import MessageError
from schemas.topics import SERVICES, TOPICS, health_topic, snapshot_topic, steps_topic

_BACKLOG_BYTES = 256 * 1024 * 1024
_ASK_S = 5.0


def recorded_topics() -> list[Topic[Message]]:
    """All topics. The snapshots come last: by them a stage learns that a recorder listens, which then has its steps."""
    health = [health_topic(service) for service in SERVICES]
    return [*TOPICS, *health, *(steps_topic(s) for s in STAGES), *(snapshot_topic(s) for s in STAGES)]


def raw_of(topic: Topic[Message], envelope: Envelope, payload: bytes) -> Raw:
    """A received message for a recording."""
    schema, version = topic.message.schema_name, topic.message.schema_version
    e = envelope
    return Raw(topic.name, schema, version, e.writer, e.epoch, e.sequence, e.sent_ns, payload)


@dataclass(slots=True)
class Recorder:
    """Records from a link into a ring until closed.

    instance: which of two instances of a service this host has (`LinkConfig.instance`): its steps are recorded. Of what
    such a service says, that of the one that is obeyed. counts, lost: messages written, and lost by reason.
    """

    link: Link
    ring: Ring
    translator: Translator | None = field(default_factory=Translator)
    instance: Callable[[str], str] = field(default=lambda _: "")
    counts: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    written_bytes: int = 0
    _queue: queue.SimpleQueue[tuple[Topic[Message], bytes] | None] = field(default_factory=queue.SimpleQueue)
    _waiting: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _newest: dict[str, tuple[int, int]] = field(default_factory=dict)
    _behind: set[str] = field(default_factory=set)
    _asked_s: dict[str, float] = field(default_factory=dict)
    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Subscribe to everything."""
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()
        own = {t.name: s for s in STAGES for t in (steps_topic(s), snapshot_topic(s))}
        for topic in recorded_topics():
            instance = self.instance(own[topic.name]) if topic.name in own else ""
            self.link.subscribe(topic, self._receive, every=True, instance=instance)
        with self._lock:  # for what another recorder has heard already
            self._behind.update(STAGES)

    def _receive(self, topic: Topic[Message], payload: bytes) -> None:
        with self._lock:
            if self._waiting + len(payload) > _BACKLOG_BYTES:
                self.lost["backlog"] += 1
                return
            self._waiting += len(payload)
        self._queue.put((topic, payload))

    def _write(self) -> None:
        while (item := self._queue.get()) is not None:
            topic, payload = item
            try:
                self._take(topic, payload)
            except MessageError as error:
                self.lost[f"{topic.name}:{error.reason}"] += 1
            except Exception as error:  # one message that cannot be shown must not end a recording
                self.lost[f"{topic.name}:failed"] += 1
                get_logger().error("not recorded", topic=topic.name, error=repr(error))
            with self._lock:
                self._waiting -= len(payload)

    def _take(self, topic: Topic[Message], payload: bytes) -> None:
        message, envelope = decode(payload, topic.message, topic.max_bytes)
        self._note_gap(topic, envelope)
        shown = self.translator(message) if self.translator is not None else []
        self.ring.add(raw_of(topic, envelope, payload), shown, message.stamp_ns)
        self.counts[topic.name] += 1
        self.written_bytes += len(payload)

    def _note_gap(self, topic: Topic[Message], envelope: Envelope) -> None:
        """Count the messages that did not come: sequences of one topic and life have no holes."""
        epoch, last = self._newest.get(topic.name, (0, 0))
        if epoch == envelope.epoch and envelope.sequence > last + 1:
            self.lost[f"{topic.name}:missing"] += envelope.sequence - last - 1
            service, _, noun = topic.name.partition("/")
            with self._lock:
                self._behind.update([service] if noun == "steps" else topic.readers)
        self._newest[topic.name] = (envelope.epoch, envelope.sequence)

    def tick(self) -> None:
        """Now and then: ask the stages whose recording has a hole for a snapshot, from which it can be replayed on."""
        now = time.monotonic()
        with self._lock:
            due = sorted(s for s in self._behind if now - self._asked_s.get(s, -_ASK_S) >= _ASK_S)
            self._behind.difference_update(due)
        for service in due:
            if service in STAGES:
                self._asked_s[service] = now
                key = snapshot_query_key(self.link.robot, service, self.instance(service))
                self.link.ask(key, 1.0)

    def close(self) -> None:
        """Write what has come, and end the segment. Close the link first."""
        self._queue.put(None)
        if self._thread is not None:
            self._thread.join(60.0)
        self.ring.close()
        if self.ring.lost:
            self.lost["disk"] += self.ring.lost
