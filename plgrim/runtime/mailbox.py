"""What both drivers do with bytes: refuse or accept them, keep them, and hand them to a stage; and the way out.

The live and the lock-step driver share this file, so that they accept and refuse the same messages.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.contract import Inputs, Output, Received, Stamp, Topic
from schemas.errors import MessageError, WrongSenderError

_KEEP_ALL_LIMIT = 4096

Decoder = Callable[[bytes, type[Message], int], tuple[Message, Envelope]]


class SharedDecoder:
    """As `decode`, but several readers of the same bytes get the same (frozen, read-only) message."""

    def __init__(self) -> None:
        self._payload: bytes | None = None
        self._read: tuple[Message, Envelope] | None = None

    def __call__(self, payload: bytes, expected: type[Message], max_bytes: int) -> tuple[Message, Envelope]:
        """The message and its envelope. Raises what `decode` raises, for every reader."""
        if self._read is None or payload is not self._payload:
            self._read, self._payload = None, payload
            self._read = decode(payload, expected, max_bytes)
        return self._read


@dataclass(slots=True)
class _Held:
    message: Message
    envelope: Envelope
    received_ns: int
    fresh: bool = True


@dataclass(slots=True)
class Mailbox:
    """The inbox of one stage. Not thread safe: the driver locks around it.

    dropped counts refused messages by `topic:reason`.
    """

    robot: str
    topics: tuple[Topic[Message], ...]
    dropped: Counter[str] = field(default_factory=Counter)
    last_refusal: str = ""
    _held: dict[str, deque[_Held]] = field(default_factory=dict)

    def accept(self, topic: Topic[Message], payload: bytes, received_ns: int, read: Decoder = decode) -> bool:
        """Decode, check the sender and keep the message; False, counted and remembered when it is refused."""
        try:
            message, envelope = read(payload, topic.message, topic.max_bytes)
            self._check_sender(topic, envelope)
        except MessageError as error:
            self.dropped[f"{topic.name}:{error.reason}"] += 1
            self.last_refusal = f"{topic.name}: {error}"
            return False
        self._keep(topic, _Held(message, envelope, received_ns))
        return True

    def _check_sender(self, topic: Topic[Message], envelope: Envelope) -> None:
        if envelope.robot != self.robot:
            raise WrongSenderError(f"from robot {envelope.robot!r}, this is {self.robot!r}")
        if envelope.writer != topic.writer:
            raise WrongSenderError(f"written by {envelope.writer!r}, the topic belongs to {topic.writer!r}")
        held = self._held.get(topic.name)
        if held and envelope.epoch < held[-1].envelope.epoch:
            raise WrongSenderError(f"epoch {envelope.epoch} is over, {held[-1].envelope.epoch} has begun")
        last = held[-1].envelope if held else None
        if last and envelope.epoch == last.epoch and envelope.sequence <= last.sequence:
            raise WrongSenderError(f"sequence {envelope.sequence} is not newer than {last.sequence}")

    def _keep(self, topic: Topic[Message], held: _Held) -> None:
        queue = self._held.setdefault(topic.name, deque())
        if not topic.keep_all:
            queue.clear()
        elif len(queue) >= _KEEP_ALL_LIMIT:
            queue.popleft()
            self.dropped[f"{topic.name}:queue_full"] += 1
        queue.append(held)

    def inputs(self, now_ns: int) -> Inputs:
        """What a step may read. now_ns: the clock that `received_ns` was read from."""
        messages: dict[str, list[Received[Message]]] = {}
        for topic in self.topics:
            queue = self._held.get(topic.name)
            if queue:
                messages[topic.name] = [_received(topic, held, now_ns) for held in queue]
        return Inputs(messages)

    def stepped(self) -> None:
        """After a step: what was handed out is no longer fresh; of queues only the newest stays."""
        for queue in self._held.values():
            while len(queue) > 1:
                queue.popleft()
            queue[-1].fresh = False

    def newest(self) -> dict[str, tuple[int, int]]:
        """(epoch, sequence) of the newest message of each topic: what its owner can know by now."""
        return {
            name: (queue[-1].envelope.epoch, queue[-1].envelope.sequence)
            for name, queue in self._held.items()
            if queue
        }

    def state(self) -> dict[str, Any]:
        """For a snapshot: what is held, as the bytes that were received, and what was refused."""
        held = {
            name: [[encode(h.message, h.envelope), h.received_ns, h.fresh] for h in queue]
            for name, queue in sorted(self._held.items())
        }
        return {"held": held, "dropped": dict(self.dropped)}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot. Raises MessageError."""
        self.dropped = Counter(state["dropped"])
        self._held = {}
        for topic in self.topics:
            if topic.name not in state["held"]:
                continue
            queue = self._held[topic.name] = deque()
            for payload, received_ns, fresh in state["held"][topic.name]:
                message, envelope = decode(payload, topic.message, topic.max_bytes)
                queue.append(_Held(message, envelope, received_ns, fresh))

    def missing(self, now_ns: int) -> list[str]:
        """Periodic topics of which nothing has come, or only something stale."""
        found = []
        for topic in self.topics:
            if topic.period_ns == 0 or topic.stale_after_ns == 0:
                continue
            queue = self._held.get(topic.name)
            if not queue or now_ns - queue[-1].received_ns > topic.stale_after_ns:
                found.append(topic.name)
        return found


def _received(topic: Topic[Message], held: _Held, now_ns: int) -> Received[Message]:
    age = now_ns - held.received_ns
    stale = topic.stale_after_ns > 0 and age > topic.stale_after_ns
    e = held.envelope
    return Received(held.message, e.writer, e.epoch, e.sequence, e.sent_ns, age, held.fresh, stale)


@dataclass(slots=True)
class Outbox:
    """Gives a stage's outputs their envelopes: writer, epoch, sequence (messages of each topic so far), inputs
    consumed."""

    robot: str
    service: str
    epoch: int
    sequence: Counter[str] = field(default_factory=Counter)

    def pack(self, output: Output, now: Stamp, consumed: dict[str, tuple[int, int]]) -> bytes:
        """The bytes of one output. ValueError when the service does not own the topic or it is too large."""
        topic = output.topic
        if topic.writer != self.service:
            raise ValueError(f"{self.service} may not write {topic.name}: it belongs to {topic.writer}")
        self.sequence[topic.name] += 1
        envelope = Envelope(
            self.robot, self.service, self.epoch, self.sequence[topic.name], now, dict(consumed)
        )
        payload = encode(output.message, envelope)
        if len(payload) > topic.max_bytes:
            raise ValueError(
                f"{topic.name}: {len(payload)} bytes, the table of topics allows {topic.max_bytes}"
            )
        return payload
