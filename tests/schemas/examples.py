"""A small example of every message, made from its declaration alone, and its golden bytes.

Run as a program to write the golden files that are missing. An existing file is never rewritten: a message that has
gone over the wire must stay readable, so a change of its bytes needs a new `schema_version`.
"""

from __future__ import annotations

import types
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
import xxhash
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from schemas.base import ColumnSpec, Message, columns_of
from schemas.codec import Envelope, encode
from schemas.topics import TOPICS, health_topic, recorder_topics

GOLDEN = Path(__file__).parent / "golden"
ENVELOPE = Envelope("husky1", "writer", 3, 7, 11_000_000_000, {"sim/odometry": (3, 41)})
MESSAGES: list[type[Message]] = sorted(
    {topic.message for topic in (*TOPICS, health_topic("gcp"), *recorder_topics("gcp"))},
    key=lambda message: message.schema_name,
)

_CANDIDATES: dict[type, tuple[Any, ...]] = {
    bool: (True,),
    int: (2, 0, 40),
    float: (0.75, 1.5, 0.0, 20.0),
    str: ("text",),
}
_SIZES = {"n": 3, "rows": 2, "m": 2, "m1": 3, "k": 2}


def example(message: type[BaseModel]) -> Any:
    """The example of a message or header class: the same at every call."""
    columns = columns_of(message) if issubclass(message, Message) else {}
    hints = get_type_hints(message)
    values: dict[str, Any] = {
        name: _value(hints[name], field)
        for name, field in message.model_fields.items()
        if name not in columns
    }
    for name, spec in columns.items():
        values[name] = _array(spec, values)
    return message(**values)


def _value(kind: Any, field: FieldInfo | None = None) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return _value(arguments[0], field)
    if origin is list:
        return [_value(arguments[0])]
    if origin is tuple:
        return tuple(_value(argument) for argument in arguments)
    if origin is dict:
        return {"sim/cloud:bad_checksum": _value(arguments[1])}
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return example(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return list(kind)[-1]
    return _scalar(kind, field)


def _scalar(kind: type, field: FieldInfo | None) -> Any:
    checked: Any = Annotated[kind, field] if field is not None else kind
    adapter: TypeAdapter[Any] = TypeAdapter(checked)
    for candidate in _CANDIDATES[kind]:
        try:
            return adapter.validate_python(candidate)
        except ValidationError:
            continue
    raise AssertionError(f"no example for {kind} with {field}")


def _array(spec: ColumnSpec, values: dict[str, Any]) -> np.ndarray[Any, Any]:
    shape = tuple(s if isinstance(s, int) else int(values.get(s, _SIZES.get(s, 4))) for s in spec.shape)
    count = np.arange(int(np.prod(shape)))
    low = spec.minimum if spec.minimum is not None else 0
    high = spec.maximum if spec.maximum is not None else low + 7
    if np.dtype(spec.dtype).kind == "f":
        return (low + (high - low) * (count % 5) / 4).astype(spec.dtype).reshape(shape)
    return (int(low) + count % (int(high) - int(low) + 1)).astype(spec.dtype).reshape(shape)


def encoded(message: type[Message]) -> bytes:
    """The example's bytes."""
    return encode(example(message), ENVELOPE)


def golden_file(message: type[Message]) -> Path:
    """Where the golden bytes of this version of the message are kept."""
    return GOLDEN / f"{message.schema_name}.v{message.schema_version}.bin"


def body_of(payload: bytes) -> Any:
    """What is in a message, to be tampered with."""
    return msgpack.unpackb(payload[10:], raw=False)


def sign(body: Any) -> bytes:
    """A message with this body and a checksum that fits it."""
    packed = body if isinstance(body, bytes) else msgpack.packb(body)
    return b"\x92\xcf" + xxhash.xxh3_64_digest(packed) + packed


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for each in MESSAGES:
        if not golden_file(each).exists():
            golden_file(each).write_bytes(encoded(each))
            print(f"wrote {golden_file(each).name}")
