"""Messages that must not be used, of every kind, from a seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from planning.randomness import stream
from schemas.base import Message
from schemas.codec import Envelope, encode
from schemas.contract import Topic
from tests.schemas.examples import example

KINDS = (
    "damaged",
    "cut short",
    "oversized",
    "foreign",
    "another robot",
    "duplicate",
    "reordered",
    "noise",
    "empty",
)


def good(topic: Topic[Message], robot: str, epoch: int, sequence: int) -> bytes:
    """A message that is accepted."""
    return encode(example(topic.message), Envelope(robot, topic.writer, epoch, sequence, 5))


def bad_messages(
    topic: Topic[Message], robot: str, epoch: int, last: int, seed: int
) -> Iterator[tuple[str, bytes]]:
    """(kind, payload) without end. epoch, last: life and sequence of the last message that was accepted."""
    rng = stream(seed, "faults", "messages")
    message, mine = example(topic.message), Envelope(robot, topic.writer, epoch, last, 5)
    whole = encode(message, replace(mine, sequence=last + 1))
    oversized = whole + bytes(topic.max_bytes + 1 - len(whole))
    while True:
        kind = KINDS[int(rng.integers(len(KINDS)))]
        match kind:
            case "damaged":
                content = np.frombuffer(whole, np.uint8).copy()
                content[rng.integers(content.size, size=1 + int(rng.integers(4)))] ^= np.uint8(
                    1 + rng.integers(255)
                )
                payload = content.tobytes()
                if payload == whole:
                    continue
            case "cut short":
                payload = whole[: int(rng.integers(1, len(whole)))]
            case "oversized":
                payload = oversized
            case "foreign":
                payload = encode(message, replace(mine, writer="stranger", sequence=last + 1))
            case "another robot":
                payload = encode(message, replace(mine, robot="other", sequence=last + 1))
            case "duplicate":
                payload = encode(message, mine)
            case "reordered":
                payload = encode(
                    message, replace(mine, epoch=epoch - 1, sequence=last + 1 + int(rng.integers(9)))
                )
            case "noise":
                payload = rng.bytes(int(rng.integers(1, 200)))
            case _:
                payload = b""
        yield kind, payload
