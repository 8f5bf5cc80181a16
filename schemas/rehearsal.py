"""Inputs for a stage that warms up: messages as the wire hands them over."""

from __future__ import annotations

from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.contract import Inputs, Received, Topic


def heard(*said: tuple[Topic[Message], Message]) -> Inputs:
    """Each of these messages, new and fresh, once through the codec.

    Arrays of a decoded message are read-only: another type to numba, and so another compilation, than those of a
    message that was just built. Raises MessageError for what does not fit on the wire.
    """
    found: dict[str, list[Received[Message]]] = {}
    for sequence, (topic, message) in enumerate(said, 1):
        payload = encode(message, Envelope("robot", topic.writer, 1, sequence, message.stamp_ns))
        decoded, _ = decode(payload, topic.message, topic.max_bytes)
        received = Received(decoded, topic.writer, 1, sequence, message.stamp_ns, 0, True, False)
        found.setdefault(topic.name, []).append(received)
    return Inputs(found)
