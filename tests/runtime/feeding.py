"""Feeds one stage by hand: messages go through the real envelope, codec and mailbox, on a clock that the test owns."""

from __future__ import annotations

from typing import TypeVar

from plgrim.runtime.mailbox import Mailbox, Outbox
from schemas.base import Message
from schemas.contract import Output, Outputs, Stage, Stamp, Topic
from schemas.topics import read_by

M = TypeVar("M", bound=Message)
ROBOT = "robot"


class Feed:
    """One stage, its mailbox, and a writer for each of its topics."""

    def __init__(self, service: str, stage: Stage) -> None:
        self.stage = stage
        self.mailbox = Mailbox(ROBOT, tuple(read_by(service)))
        self._own = Outbox(ROBOT, service, 1)
        self._writers: dict[str, Outbox] = {}

    def put(self, topic: Topic[M], message: M, now: Stamp) -> None:
        """Deliver a message at `now`."""
        writer = self._writers.setdefault(topic.writer, Outbox(ROBOT, topic.writer, 1))
        payload = writer.pack(Output(topic, message), now, {})
        assert self.mailbox.accept(topic, payload, now), self.mailbox.last_refusal

    def step(self, now: Stamp) -> Outputs:
        """One step. Its outputs must fit on the wire."""
        inputs = self.mailbox.inputs(now)
        outputs = self.stage.step(now, inputs)
        for output in outputs:
            self._own.pack(output, now, inputs.consumed)
        self.mailbox.stepped()
        return outputs


def only(outputs: Outputs, topic: Topic[M]) -> M | None:
    """The one message of a topic among the outputs, None without one."""
    found = [output.message for output in outputs if output.topic.name == topic.name]
    assert len(found) <= 1
    if not found:
        return None
    assert isinstance(found[0], topic.message)
    return found[0]
