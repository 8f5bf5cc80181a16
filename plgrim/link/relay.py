"""Passes on what comes from services that run at the base alone, as their own word on the robot. Pure: no clock.

Readers on the robot get it under the epoch of the link process, as what the arbiters pass on: whatever the clock of the
base's host says, also of one that was replaced, it is neither old nor new to them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from plgrim.runtime.mailbox import Mailbox
from schemas.base import Message
from schemas.codec import Envelope, encode
from schemas.contract import Topic


@dataclass(slots=True)
class Relay:
    """Not thread safe. epoch: later than that of any life of the link before. silent_ns: a writer of which nothing was
    taken for so long may begin anew, under whatever epoch: its last life is over.
    """

    robot: str
    topics: tuple[Topic[Message], ...]
    epoch: int
    silent_ns: int
    dropped: Counter[str] = field(default_factory=Counter)
    _mailboxes: dict[str, Mailbox] = field(default_factory=dict)
    _taken_ns: dict[str, int] = field(default_factory=dict)
    _sequence: Counter[str] = field(default_factory=Counter)

    def receive(self, topic: Topic[Message], payload: bytes, now_ns: int) -> bytes | None:
        """The message as it goes to the robot's readers; None, counted, when it is refused.

        now_ns: local monotonic clock. The time of sending stays the writer's.
        """
        writer = topic.writer
        mailbox = self._mailboxes.get(writer)
        if mailbox is None or now_ns - self._taken_ns.get(writer, now_ns) > self.silent_ns:
            mine = tuple(known for known in self.topics if known.writer == writer)
            mailbox = self._mailboxes[writer] = Mailbox(self.robot, mine, self.dropped)
        if not mailbox.accept(topic, payload, now_ns):
            return None
        self._taken_ns[writer] = now_ns
        (received,) = mailbox.inputs(now_ns).messages[topic.name][-1:]
        mailbox.stepped()
        self._sequence[topic.name] += 1
        envelope = Envelope(self.robot, writer, self.epoch, self._sequence[topic.name], received.sent_ns)
        return encode(received.message, envelope)
