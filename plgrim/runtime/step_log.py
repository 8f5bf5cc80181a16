"""The live driver's side of an exact recording: tells a recorder, while one listens, of every step of the stage.

With the messages themselves this is all that a replay needs: a stage has no clock, so that the time of each step, the
order and age of what it was given, and its readings of the stopwatch decide what it says. Without a recorder it costs
one look at whether somebody listens per step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import xxhash
import zenoh

from plgrim.logs import get_logger
from plgrim.runtime.mailbox import Mailbox, Outbox
from plgrim.runtime.zenoh_session import Link
from schemas.base import Message
from schemas.contract import Output, Stage, Stamp, Topic, root_of
from schemas.recording import StageSnapshot, StepRecord
from schemas.snapshot import pack_snapshot
from schemas.topics import snapshot_topic, steps_topic

_LARGEST_SHARE = 0.02
"""Of the time that snapshots for recorders may take."""
_LONGEST_BACKLOG = 100_000
"""Arrivals noted between two steps; more are a stage that does not step, and then its next snapshot says it all."""


def snapshot_query_key(robot: str, service: str, instance: str = "") -> str:
    """Key on which a service, or one of two instances of it, takes a recorder's wish for a snapshot."""
    path = f"{instance}/{service}" if instance else service
    return f"{root_of(robot)}/{path}/snapshot_now"


class NotedStopwatch:
    """A stopwatch (seconds) that remembers what it showed."""

    def __init__(self, watch: Callable[[], float] = time.monotonic) -> None:
        self._watch = watch
        self._shown: list[float] = []

    def __call__(self) -> float:
        """Its reading, s."""
        shown = self._watch()
        self._shown.append(shown)
        return shown

    def take(self) -> list[float]:
        """The readings since the last call."""
        shown, self._shown = self._shown, []
        return shown


@dataclass(slots=True)
class _Arrival:
    topic: str
    epoch: int
    sequence: int
    received_ns: int


@dataclass(slots=True)
class StepLog:
    """Of one life of one stage. `arrived` is called under the driver's lock, the rest by the thread that steps.

    options: the stage's configuration as JSON. period_s: wall time between snapshots.
    """

    service: str
    seed: int
    options: str
    stopwatch: NotedStopwatch
    period_s: float = 30.0
    _link: Link | None = None
    _outbox: Outbox | None = None
    _listening: bool = False
    _asked: bool = False
    _step: int = 0
    _due_s: float = 0.0
    _arrived: list[_Arrival] = field(default_factory=list)
    _now: Stamp = 0
    _said: list[tuple[str, int, Stamp, int]] = field(default_factory=list)

    def attach(self, link: Link, outbox: Outbox) -> None:
        """Where to tell it. outbox: the driver's, for the counters of the stage's messages."""
        self._link, self._outbox = link, outbox
        link.declare(steps_topic(self.service))
        link.declare(snapshot_topic(self.service))
        link.answer(snapshot_query_key(link.robot, self.service, link.instance), self._ask)

    def _ask(self) -> bytes:
        """A recorder asks for a snapshot: it has missed something."""
        self._asked = True
        return b"soon"

    def arrived(self, topic: Topic[Message], mailbox: Mailbox, now: Stamp) -> None:
        """The mailbox has accepted a message of this topic."""
        if self._listening and len(self._arrived) < _LONGEST_BACKLOG:
            self._arrived.append(_Arrival(topic.name, *mailbox.newest_of(topic), now))

    def wanted(self) -> bool:
        """Whether a snapshot is wanted before this step: a recorder has come, or the last one is old."""
        heard = self._link is not None and self._link.has_readers(snapshot_topic(self.service))
        came, self._listening = heard and not self._listening, heard
        if not heard:
            self._arrived.clear()
        wanted = came or self._asked or len(self._arrived) >= _LONGEST_BACKLOG
        return heard and (wanted or time.monotonic() >= self._due_s)

    def begin(self, now: Stamp) -> list[_Arrival]:
        """A step begins, under the lock: what has arrived for it, to be handed to `end`."""
        self._step += 1
        self._now = now
        self._said = []
        self.stopwatch.take()
        arrived, self._arrived = self._arrived, []
        return arrived

    def snapshot(self, stage: Stage, mailbox_state: dict[str, object]) -> None:
        """Tell the state before the step that has begun. mailbox_state: with all that has arrived for it."""
        assert self._outbox is not None
        self._asked = False
        began = time.monotonic()
        state = {
            "stage": stage.snapshot(),
            "mailbox": mailbox_state,
            "sequence": dict(self._outbox.sequence),
        }
        message = StageSnapshot(
            stamp_ns=self._now,
            service=self.service,
            step=self._step,
            seed=self.seed,
            options=self.options,
            state=np.frombuffer(pack_snapshot(state), np.uint8),
        )
        self._tell(Output(snapshot_topic(self.service), message))
        ended = time.monotonic()
        self._due_s = ended + max(self.period_s, (ended - began) / _LARGEST_SHARE)

    def said(self, output: Output, payload: bytes, sent_ns: Stamp) -> None:
        """The step has made this output."""
        if self._listening:
            assert self._outbox is not None
            name = output.topic.name
            self._said.append((name, self._outbox.sequence[name], sent_ns, xxhash.xxh3_64_intdigest(payload)))

    def end(self, arrived: Sequence[_Arrival], error: str) -> None:
        """The step has ended. error: what it raised, or nothing."""
        if not self._listening:
            return
        topics = sorted({a.topic for a in arrived} | {name for name, *_ in self._said})
        index = {name: i for i, name in enumerate(topics)}
        record = StepRecord(
            stamp_ns=self._now,
            service=self.service,
            step=self._step,
            topics=topics,
            error=error,
            arrived_topic=np.array([index[a.topic] for a in arrived], np.uint8),
            arrived_epoch=np.array([a.epoch for a in arrived], np.int64),
            arrived_sequence=np.array([a.sequence for a in arrived], np.int64),
            arrived_ns=np.array([a.received_ns for a in arrived], np.int64),
            stopwatch_s=np.array(self.stopwatch.take(), np.float64),
            said_topic=np.array([index[name] for name, *_ in self._said], np.uint8),
            said_sequence=np.array([s[1] for s in self._said], np.int64),
            said_ns=np.array([s[2] for s in self._said], np.int64),
            said_checksum=np.array([s[3] for s in self._said], np.uint64),
        )
        self._tell(Output(steps_topic(self.service), record))

    def _tell(self, output: Output) -> None:
        """Publish; a recorder that cannot be told is no reason to stop a robot."""
        assert self._outbox is not None and self._link is not None
        try:
            self._link.publish(output.topic, self._outbox.pack(output, self._now, {}))
        except (zenoh.ZError, ValueError) as error:
            get_logger().warning("recorder not told", topic=output.topic.name, error=str(error)[:200])


def error_text(error: BaseException) -> str:
    """An error as a step record holds it."""
    return f"{type(error).__name__}: {error}"[:500]
