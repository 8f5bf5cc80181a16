"""The project's own messages inside an MCAP file: each as it was on the wire, in a ROS 2 message of our own.

`plgrim_msgs/msg/Envelope` in CDR, so that every MCAP and ROS 2 library decodes the channel; its `payload` is the exact
bytes of `schemas/codec.py`, which a replay needs.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ENVELOPE_TYPE = "plgrim_msgs/msg/Envelope"
ENVELOPE_DEFINITION = """\
# One PLGRIM message as it was on the wire. The payload is msgpack: [checksum, {envelope, header, columns}], the
# checksum being xxh3-64 of all that follows the first ten bytes; columns are [dtype, shape, little-endian bytes].
# What each schema holds is in the attachment schemas.json of the file.
string topic
string schema
uint32 version
string writer
uint64 epoch
uint64 sequence
uint64 sent_ns
uint8[] payload
"""
RAW_PREFIX = "/plgrim/raw/"


class Raw(NamedTuple):
    """A message on the wire: where, who, when, and its bytes. sent_ns: mission clock."""

    topic: str
    schema: str
    version: int
    writer: str
    epoch: int
    sequence: int
    sent_ns: int
    payload: bytes


@cache
def typestore() -> Any:
    """ROS 2 types with ours."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ENVELOPE_DEFINITION, ENVELOPE_TYPE))
    return store


def definition(message_type: str) -> str:
    """The text of a message type with all that it is made of, as an MCAP schema of encoding ros2msg."""
    text: str = typestore().generate_msgdef(message_type, ros_version=2)[0]
    return text


def to_cdr(message: Any) -> bytes:
    """A message of the type store as CDR."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def pack_raw(raw: Raw) -> bytes:
    """CDR of an envelope."""
    kind = typestore().types[ENVELOPE_TYPE]
    values = (*raw[:-1], np.frombuffer(raw.payload, np.uint8))
    return to_cdr(kind(*values))


def unpack_raw(data: bytes) -> Raw:
    """From CDR."""
    m = typestore().deserialize_cdr(data, ENVELOPE_TYPE)
    return Raw(m.topic, m.schema, m.version, m.writer, m.epoch, m.sequence, m.sent_ns, m.payload.tobytes())
