"""The bytes of every message version: written once, the same for ever."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.base import Message, columns_of
from schemas.codec import decode
from schemas.topics import TOPICS, health_topic, recorder_topics
from tests.schemas.examples import ENVELOPE, GOLDEN, MESSAGES, encoded, example, golden_file

by_name = pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.schema_name)


@by_name
def test_encodes_to_the_golden_bytes(message: type[Message]) -> None:
    assert golden_file(message).exists(), "new message or version: run `python -m tests.schemas.examples`"
    assert encoded(message) == golden_file(message).read_bytes()


@by_name
def test_golden_bytes_decode_to_the_example(message: type[Message]) -> None:
    decoded, envelope = decode(golden_file(message).read_bytes(), message, 1 << 20)
    wanted = example(message)
    columns = columns_of(message)
    assert envelope == ENVELOPE
    assert decoded.model_dump(exclude=set(columns)) == wanted.model_dump(exclude=set(columns))
    for name in columns:
        assert getattr(decoded, name).dtype == getattr(wanted, name).dtype
        assert np.array_equal(getattr(decoded, name), getattr(wanted, name))


@by_name
def test_decoded_arrays_are_read_only_views(message: type[Message]) -> None:
    """Decoded without a copy: a reader that writes into a message is a fault."""
    decoded, _ = decode(golden_file(message).read_bytes(), message, 1 << 20)
    for name in columns_of(message):
        assert not getattr(decoded, name).flags.writeable


def test_no_golden_file_is_without_its_message() -> None:
    """Files of older versions stay; files of messages that are gone do not."""
    names = {message.schema_name for message in MESSAGES}
    assert {path.name.split(".")[0] for path in GOLDEN.glob("*.bin")} == names


def test_every_topic_has_a_golden_message() -> None:
    for topic in (*TOPICS, health_topic("lcp"), *recorder_topics("lcp")):
        assert golden_file(topic.message).exists()
        assert len(golden_file(topic.message).read_bytes()) <= topic.max_bytes
