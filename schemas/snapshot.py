"""Snapshots of stages: nested dicts and lists of numbers, strings, bytes and numpy arrays, in msgpack."""

from __future__ import annotations

from typing import Any, TypeVar

import msgpack
import numpy as np

from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.errors import MalformedError

_ARRAY = "__array__"
_ENVELOPE = Envelope("", "", 0, 0, 0)
_M = TypeVar("_M", bound=Message)


def pack_snapshot(state: dict[str, Any]) -> bytes:
    """The bytes of a stage's state."""
    packed: bytes = msgpack.packb(state, default=_array, use_bin_type=True)
    return packed


def unpack_snapshot(payload: bytes) -> dict[str, Any]:
    """The state in a snapshot; arrays come back writable. Raises `MalformedError` when it is damaged."""
    try:
        state = msgpack.unpackb(payload, raw=False, strict_map_key=False, object_hook=_restore)
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise MalformedError(f"snapshot: {error}") from error
    if not isinstance(state, dict):
        raise MalformedError("snapshot: not a map")
    return state


def pack_message(message: Message) -> bytes:
    """A message that a stage keeps, as bytes for its snapshot."""
    return encode(message, _ENVELOPE)


def unpack_message(payload: bytes, expected: type[_M]) -> _M:
    """The message in a snapshot; its arrays are read-only, as those that were received. Raises `MessageError`."""
    return decode(payload, expected, len(payload))[0]


def _array(value: Any) -> dict[str, Any]:
    if isinstance(value, np.ndarray):
        return {_ARRAY: [value.dtype.str, list(value.shape), np.ascontiguousarray(value).tobytes()]}
    if isinstance(value, np.generic):
        return {_ARRAY: [value.dtype.str, [], value.tobytes()]}
    raise TypeError(f"a snapshot cannot hold a {type(value).__name__}")


def _restore(value: dict[str, Any]) -> Any:
    if set(value) != {_ARRAY}:
        return value
    dtype, shape, raw = value[_ARRAY]
    return np.frombuffer(raw, dtype=np.dtype(dtype)).reshape(shape).copy()
