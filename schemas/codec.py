"""Messages to bytes and back: `[checksum, {envelope, header, columns}]` in msgpack.

The first ten bytes are a msgpack array of two and an unsigned 64-bit checksum (xxh3) of all that follows, so that a
damaged message is refused before anything in it is parsed. Columns are `[dtype, shape, raw little-endian bytes]` and
decode to read-only arrays over the received bytes. What came over a radio may be in the form of `schemas.compact`;
`decode` takes both.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from typing import Any, TypeVar, get_args, get_origin

import msgpack
import numpy as np
import xxhash
from pydantic import BaseModel, ValidationError

from schemas.base import Message, columns_of
from schemas.compact import is_compact, restore_body
from schemas.errors import (
    ChecksumError,
    MalformedError,
    MessageError,
    ShapeError,
    TooLargeError,
    UnknownSchemaError,
    UnknownVersionError,
    ValueRangeError,
)

_PREFIX = b"\x92\xcf"
_PREFIX_BYTES = 10
_ENVELOPE_FIELDS = ("robot", "writer", "epoch", "sequence", "sent_ns", "consumed")
_DTYPES = frozenset(
    {"float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"}
)
_MAX_AXES = 4
_M = TypeVar("_M", bound=Message)


@dataclass(frozen=True, slots=True)
class Envelope:
    """Who sent a message, and from what it was made.

    epoch: counts the writer's lives (a restart is a new epoch). sequence: counts messages of one topic in one
    epoch, from 1. sent_ns: mission clock at sending, ns. consumed: topic name -> (epoch, sequence) of the inputs.
    """

    robot: str
    writer: str
    epoch: int
    sequence: int
    sent_ns: int
    consumed: Mapping[str, tuple[int, int]] = field(default_factory=dict)


def encode(message: Message, envelope: Envelope) -> bytes:
    """The bytes of a message. The message was validated when it was built."""
    columns = columns_of(type(message))
    body = {
        "schema": message.schema_name,
        "version": message.schema_version,
        "robot": envelope.robot,
        "writer": envelope.writer,
        "epoch": envelope.epoch,
        "sequence": envelope.sequence,
        "sent_ns": envelope.sent_ns,
        "consumed": {name: list(pair) for name, pair in sorted(envelope.consumed.items())},
        "header": message.model_dump(exclude=set(columns)),
        "columns": {name: _pack_column(getattr(message, name)) for name in columns},
    }
    packed: bytes = msgpack.packb(body, use_bin_type=True)
    return _PREFIX + struct.pack(">Q", xxhash.xxh3_64_intdigest(packed)) + packed


def _pack_column(array: np.ndarray[Any, Any]) -> list[Any]:
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return [array.dtype.name, list(array.shape), little.tobytes()]


def decode(payload: bytes, expected: type[_M], max_bytes: int) -> tuple[_M, Envelope]:
    """The message in `payload` and its envelope.

    Raises a `MessageError` that names the fault: too large, damaged, another schema or version, a missing or unknown
    field, a number that is not finite or out of range, an array of another shape or type.
    """
    body = _unpack(payload, max_bytes)
    if body.get("schema") != expected.schema_name:
        raise UnknownSchemaError(f"schema {body.get('schema')!r}, expected {expected.schema_name!r}")
    if body.get("version") != expected.schema_version:
        raise UnknownVersionError(
            f"{expected.schema_name}: version {body.get('version')!r}, this program reads {expected.schema_version}"
        )
    envelope = _envelope(body)
    fields = body.get("header")
    columns = body.get("columns")
    if not isinstance(fields, dict) or not isinstance(columns, dict):
        raise MalformedError(f"{expected.schema_name}: header or columns missing")
    arrays = {name: _unpack_column(f"{expected.schema_name}.{name}", c) for name, c in columns.items()}
    return _build(expected, {**fields, **arrays}), envelope


def _unpack(payload: bytes, max_bytes: int) -> dict[str, Any]:
    if len(payload) > max_bytes:
        raise TooLargeError(f"{len(payload)} bytes, at most {max_bytes} allowed")
    if is_compact(payload):
        return restore_body(payload, max_bytes)
    if len(payload) <= _PREFIX_BYTES or payload[:2] != _PREFIX:
        raise MalformedError("not a PLGRIM message")
    view = memoryview(payload)
    (checksum,) = struct.unpack(">Q", view[2:_PREFIX_BYTES])
    if xxhash.xxh3_64_intdigest(view[_PREFIX_BYTES:]) != checksum:
        raise ChecksumError("checksum does not match the content")
    try:
        body = msgpack.unpackb(view[_PREFIX_BYTES:], raw=False, strict_map_key=True)
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise MalformedError(f"not msgpack: {error}") from error
    if not isinstance(body, dict):
        raise MalformedError("the body is not a map")
    return body


def _envelope(body: dict[str, Any]) -> Envelope:
    robot, writer, epoch, sequence, sent_ns, consumed = (body.get(name) for name in _ENVELOPE_FIELDS)
    if not (isinstance(robot, str) and isinstance(writer, str) and isinstance(consumed, dict)):
        raise MalformedError("envelope: robot, writer or consumed missing")
    if not all(isinstance(v, int) and v >= 0 for v in (epoch, sequence, sent_ns)):
        raise MalformedError("envelope: epoch, sequence or sent_ns missing or negative")
    try:
        inputs = {str(name): (int(pair[0]), int(pair[1])) for name, pair in consumed.items()}
    except (TypeError, ValueError, OverflowError, IndexError, KeyError) as error:
        raise MalformedError("envelope: consumed is not {topic: [epoch, sequence]}") from error
    return Envelope(robot, writer, int(epoch or 0), int(sequence or 0), int(sent_ns or 0), inputs)


def _unpack_column(label: str, packed: Any) -> np.ndarray[Any, Any]:
    if not (isinstance(packed, list) and len(packed) == 3 and isinstance(packed[2], bytes)):
        raise MalformedError(f"{label}: not [dtype, shape, bytes]")
    name, shape, raw = packed
    if not isinstance(name, str) or name not in _DTYPES:
        raise ShapeError(f"{label}: type {name!r} is not allowed")
    if (
        not isinstance(shape, list)
        or len(shape) > _MAX_AXES
        or not all(isinstance(s, int) and s >= 0 for s in shape)
    ):
        raise ShapeError(f"{label}: shape {shape!r} is not allowed")
    dtype = np.dtype(name).newbyteorder("<")
    expected = dtype.itemsize
    for size in shape:
        expected *= size
    if expected != len(raw):
        raise ShapeError(f"{label}: {len(raw)} bytes, but {name} of shape {shape} needs {expected}")
    return np.frombuffer(raw, dtype=dtype).astype(np.dtype(name), copy=False).reshape(shape)


@cache
def _wire_kinds(model: type[BaseModel]) -> dict[str, tuple[str, type[Any]]]:
    """Fields that msgpack cannot carry as they are: enums (as text), tuples (as lists), models (as maps)."""
    kinds: dict[str, tuple[str, type[Any]]] = {}
    for name, info in model.model_fields.items():
        hint, inside = info.annotation, get_args(info.annotation)
        if isinstance(hint, type) and issubclass(hint, Enum):
            kinds[name] = ("enum", hint)
        elif isinstance(hint, type) and issubclass(hint, BaseModel):
            kinds[name] = ("model", hint)
        elif get_origin(hint) is tuple:
            kinds[name] = ("tuple", tuple)
        elif get_origin(hint) is list and isinstance(inside[0], type) and issubclass(inside[0], BaseModel):
            kinds[name] = ("models", inside[0])
    return kinds


def _from_wire(model: type[BaseModel], fields: dict[str, Any]) -> dict[str, Any]:
    """The fields with enums, tuples and models as strict validation wants them; what does not fit is left to it."""
    found = dict(fields)
    for name, (kind, hint) in _wire_kinds(model).items():
        value = found.get(name)
        if kind == "enum" and isinstance(value, str) and value in hint._value2member_map_:
            found[name] = hint(value)
        elif kind == "tuple" and isinstance(value, list):
            found[name] = tuple(value)
        elif kind == "model" and isinstance(value, dict):
            found[name] = _from_wire(hint, value)
        elif kind == "models" and isinstance(value, list):
            found[name] = [_from_wire(hint, item) if isinstance(item, dict) else item for item in value]
    return found


def _build(expected: type[_M], fields: dict[str, Any]) -> _M:
    try:
        return expected.model_validate(_from_wire(expected, fields), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        text = f"{expected.schema_name}.{where}: {first['msg']}"
        kind = first["type"]
        if kind.startswith(("finite", "greater", "less")):
            raise ValueRangeError(text) from error
        raise MalformedError(text) from error
    except MessageError:
        raise
